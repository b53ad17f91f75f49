"""The stub's own door to numba: `@compiled` makes a function machine code, cached on disk.

Compiled functions call one another. `function.py_func` is the same source run by Python. The companion has a door of
its own: the two programs share nothing but the wire.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config

F = TypeVar("F", bound=Callable[..., object])


@functools.cache
def _cache_folder() -> str:
    """Where machine code is kept: a place of its own for each state of the stub's sources.

    numba notices a change in the file of a cached function, but not in the files of what it calls.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.parent.glob("*/*.py")):
        digest.update(source.read_bytes())
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return str(Path(base) / "sitl-stub" / "numba" / digest.hexdigest()[:16])


def compiled(function: F) -> F:
    """Compile `function` with numba: no Python objects, the GIL released, IEEE arithmetic as written (no fast-math)."""
    return _jit(function, nogil=True)


def compiled_for_threads(function: F) -> F:
    """As `compiled`, with `numba.prange` loops shared out over threads: for batches, never in the loop of one flight."""
    return _jit(function, parallel=True)


def _jit(function: F, **options: Any) -> F:
    elsewhere = numba_config.CACHE_DIR  # NUMBA_CACHE_DIR, where the user set it
    numba_config.CACHE_DIR = elsewhere or _cache_folder()
    try:
        jit = numba.njit(cache=True, fastmath=False, error_model="numpy", **options)
        return cast(F, jit(function))
    finally:
        numba_config.CACHE_DIR = elsewhere
