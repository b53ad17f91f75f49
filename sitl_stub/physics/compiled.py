"""The stub's own door to numba: `@compiled` makes a function machine code, cached on disk.

Compiled functions call one another. `function.py_func` is the same source run by Python. The companion has a door of
its own: the two programs share nothing but the wire.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config

F = TypeVar("F", bound=Callable[..., object])


IMPORTED = re.compile(rb"^ *from (sitl_stub[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
HERE = Path(__file__).parent.parent


@functools.cache
def _file(source: Path) -> tuple[bytes, frozenset[Path]]:
    """Digest of a source file, and the stub's own files that it imports."""
    text = source.read_bytes()
    imported: set[Path] = set()
    for module, names in IMPORTED.findall(text):
        place = HERE.parent.joinpath(*module.decode().split("."))
        parts = [place, *(place / name for name in re.findall(r"\w+", names.decode()))]
        imported.update(path for path in (part.with_suffix(".py") for part in parts) if path.exists())
    return hashlib.sha256(text).digest(), frozenset(imported)


def _cache_folder(source: Path) -> str:
    """Where machine code of functions in `source` is kept: a place for each state of it and of all it imports.

    numba notices a change in the file of a cached function, but not in the files of what it calls.
    """
    waiting, reached = [source], {source}
    while waiting:
        new = _file(waiting.pop())[1] - reached
        reached |= new
        waiting += new
    digest = hashlib.sha256(numba.__version__.encode())
    for one in sorted(reached):
        digest.update(_file(one)[0])
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
    numba_config.CACHE_DIR = elsewhere or _cache_folder(Path(function.__code__.co_filename))
    try:
        jit = numba.njit(cache=True, fastmath=False, error_model="numpy", **options)
        return cast(F, jit(function))
    finally:
        numba_config.CACHE_DIR = elsewhere
