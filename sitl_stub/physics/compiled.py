"""The stub's own door to numba: `@compiled` makes a function machine code, cached on disk.

Compiled functions call one another. `function.py_func` is the same source run by Python. The companion has a door of
its own: the two programs share nothing but the wire.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile `function` with numba: no Python objects, the GIL released, IEEE arithmetic as written (no fast-math)."""
    return numba.njit(cache=True, fastmath=False, error_model="numpy", nogil=True)(function)  # type: ignore[no-any-return]


def compiled_for_threads(function: F) -> F:
    """As `compiled`, with `numba.prange` loops shared out over threads: for batches, never in the loop of one flight."""
    return numba.njit(cache=True, parallel=True, fastmath=False, error_model="numpy")(function)  # type: ignore[no-any-return]
