"""The stub's own door to numba: `@compiled` makes a function machine code, cached on disk.

Compiled functions call one another. `function.py_func` is the same source run by Python. The companion has a door of
its own: the two programs share nothing but the wire.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import stat
import sys
import tempfile
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
        place = Path(tempfile.gettempdir()) / f"sitl-stub-{os.getuid()}"
        with contextlib.suppress(FileExistsError):
            place.mkdir(mode=0o700)
        found = place.lstat()
        # numba runs what it finds there: a folder that others can write is not ours to believe
        if not (stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022):
            place = Path(tempfile.mkdtemp(prefix="sitl-stub-"))
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


def _cache_folder(source: Path) -> str | None:
    """Where machine code of functions in `source` is kept: a place for each state of it and of all it imports.

    numba notices a change in the file of a cached function, but not in the files of what it calls.
    """
    if numba_config.CACHE_DIR:  # NUMBA_CACHE_DIR, where the user set it
        root = _cache_root(numba_config.CACHE_DIR)
        return str(root) if root else None
    waiting, reached = [source], {source}
    while waiting:
        new = _file(waiting.pop())[1] - reached
        reached |= new
        waiting += new
    digest = hashlib.sha256(numba.__version__.encode())
    for one in sorted(reached):
        digest.update(_file(one)[0])
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    root = _cache_root(os.path.join(base, "sitl-stub", "numba"))
    return str(root / digest.hexdigest()[:16]) if root else None


def compiled(function: F) -> F:
    """Compile `function` with numba: no Python objects, the GIL released, IEEE arithmetic as written (no fast-math)."""
    return _jit(function, nogil=True)


def compiled_for_threads(function: F) -> F:
    """As `compiled`, with `numba.prange` loops shared out over threads: for batches, never in the loop of one flight."""
    return _jit(function, parallel=True)


def _jit(function: F, **options: Any) -> F:
    elsewhere = numba_config.CACHE_DIR
    place = _cache_folder(Path(function.__code__.co_filename))
    numba_config.CACHE_DIR = place or elsewhere
    try:
        jit = numba.njit(cache=place is not None, fastmath=False, error_model="numpy", **options)
        return cast(F, jit(function))
    finally:
        numba_config.CACHE_DIR = elsewhere
