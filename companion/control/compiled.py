"""The one door to numba: `@compiled` marks a function that is machine code in flight and plain Python in tests.

The same source serves both. Tests call `function.py_func` and compare with the compiled result
(they agree to 1e-12). Compilation is cached on disk; `companion.flight` warms every law up before
arming, so that nothing is ever compiled in the air.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile `function` with numba (no Python objects, cached, IEEE arithmetic as written: no fast-math)."""
    return numba.njit(cache=True, fastmath=False, error_model="numpy")(function)  # type: ignore[no-any-return]
