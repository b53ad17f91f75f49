"""The one door to numba: `@compiled` marks a function that is machine code in flight, plain Python in tests.

The same source serves both. `python_twin(function)` is the uncompiled one, down to the last function
it calls; tests hold the two together to 1e-12. Compilation is cached on disk; `companion.flight` warms every
law up before arming, so that nothing is ever compiled in the air.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import stat
import sys
import tempfile
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config

F = TypeVar("F", bound=Callable[..., object])


@functools.cache
def _cache_root(wish: str) -> Path | None:
    """`wish` where files can be made in it, else a temporary folder of this user's and a line that says so.

    numba gives up where it finds no place ("no locator available"): a home or a tree that is read-only, a user without
    a home, a full disk. None where there is no temporary folder either: then nothing is kept.
    """
    if _takes_files(wish):
        return Path(wish)
    place = None
    with contextlib.suppress(OSError):
        place = Path(tempfile.gettempdir()) / f"dtlannc-companion-{os.getuid()}"
        with contextlib.suppress(FileExistsError):
            place.mkdir(mode=0o700)
        found = place.lstat()
        # numba runs what it finds there: a folder that others can write is not ours to believe
        if not (stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022):
            place = Path(tempfile.mkdtemp(prefix="dtlannc-companion-"))
        if not _takes_files(str(place)):
            place = None
    kept = f"is kept in {place} for now" if place else "is compiled anew every time"
    with contextlib.suppress(OSError):
        print(
            f"warning: {wish} cannot be written, so machine code {kept}; "
            "set XDG_CACHE_HOME or NUMBA_CACHE_DIR to a folder that can",
            file=sys.stderr,
        )
    return place


def _takes_files(folder: str) -> bool:
    try:
        if folder.startswith("~"):  # nobody's home
            return False
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(1 << 16))  # a full disk makes files, but takes nothing
        return True
    except OSError:
        return False


@functools.cache
def _cache_folder(folder: Path) -> str | None:
    """Where the machine code of the sources in `folder` is kept: one place per state of those sources.

    numba compares a cached function with the file it stands in, not with the files of the functions it
    calls, and would go on flying yesterday's gains after a change in a file below. Hence the digest.
    """
    if numba_config.CACHE_DIR:  # NUMBA_CACHE_DIR, where the user set it
        root = _cache_root(numba_config.CACHE_DIR)
        return str(root) if root else None
    digest = hashlib.sha256(numba.__version__.encode())
    for room in sorted({folder, Path(__file__).parent}):
        for source in sorted(room.glob("*.py")):
            digest.update(source.read_bytes())
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    root = _cache_root(os.path.join(base, "dtlannc-companion", "numba"))
    return str(root / digest.hexdigest()[:16]) if root else None


def compiled(function: F) -> F:
    """Compile `function` with numba (no Python objects, cached, IEEE arithmetic as written: no fast-math)."""
    ours = numba_config.CACHE_DIR
    place = _cache_folder(Path(function.__code__.co_filename).parent)
    numba_config.CACHE_DIR = place or ours
    try:
        return cast(
            F, numba.njit(cache=place is not None, fastmath=False, error_model="numpy", nogil=True)(function)
        )
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
