"""The one door to numba: `@compiled` marks a function that is machine code in flight, plain Python in tests.

The same source serves both. `python_twin(function)` is the uncompiled one, down to the last function
it calls; tests hold the two together to 1e-12. Compilation is cached on disk; `companion.flight` warms every
law up before arming, so that nothing is ever compiled in the air.
"""

from __future__ import annotations

import functools
import hashlib
import os
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config

F = TypeVar("F", bound=Callable[..., object])


@functools.cache
def _cache_folder(folder: Path) -> str:
    """Where the machine code of the sources in `folder` is kept: one place per state of those sources.

    numba compares a cached function with the file it stands in, not with the files of the functions it
    calls, and would go on flying yesterday's gains after a change in a file below. Hence the digest.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for room in sorted({folder, Path(__file__).parent}):
        for source in sorted(room.glob("*.py")):
            digest.update(source.read_bytes())
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return str(Path(base) / "dtlannc-companion" / "numba" / digest.hexdigest()[:16])


def compiled(function: F) -> F:
    """Compile `function` with numba (no Python objects, cached, IEEE arithmetic as written: no fast-math)."""
    ours = numba_config.CACHE_DIR
    numba_config.CACHE_DIR = ours or _cache_folder(Path(function.__code__.co_filename).parent)
    try:
        return cast(F, numba.njit(cache=True, fastmath=False, error_model="numpy", nogil=True)(function))
    finally:
        numba_config.CACHE_DIR = ours


def python_twin(function: F) -> F:
    """`function` as plain Python, every `@compiled` function that it reaches included."""
    return cast(F, _twin(function, {}))


def _twin(function: Any, known: dict[Any, Any]) -> Any:
    source = getattr(function, "py_func", function)
    if source in known:
        return known[source]
    scope = dict(source.__globals__)
    twin = types.FunctionType(
        source.__code__, scope, source.__name__, source.__defaults__, source.__closure__
    )
    known[source] = twin
    for name in source.__code__.co_names:
        if hasattr(scope.get(name), "py_func"):
            scope[name] = _twin(scope[name], known)
    return twin
