"""How a log is doing, and whether it can be begun at all."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from companion.config.errors import UserError


@dataclass(frozen=True, slots=True)
class LogHealth:
    """How the log is doing, for the supervisor and the last line of a flight."""

    written: int  # records in the file
    waiting: int  # records in the queue
    dropped: int  # records lost because the queue was full
    rejected: int  # records lost because they did not fit their channel: a defect of the caller
    lost: int  # records lost because the file could not take them
    free_bytes: int  # room left on the disk, -1 where unknown
    trouble: str  # what went wrong last, empty if nothing did

    @property
    def complete(self) -> bool:
        """Whether every record reached the file or still waits for it."""
        return self.dropped == self.rejected == self.lost == 0


def free_bytes(path: Path) -> int:
    """Return the room left on the disk of `path`, -1 where unknown."""
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:
        return -1


def open_for_writing(path: Path, overwrite: bool, minimum_free_bytes: int) -> int:
    """Open the log for writing. Raises UserError that says what to do."""
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise NotADirectoryError(error.errno, f"{path.parent} is not a folder") from error
        free = shutil.disk_usage(path.parent).free
        if free < minimum_free_bytes:
            raise UserError(
                f"no room for log {path}: {free / 1e6:.0f} MB free, {minimum_free_bytes / 1e6:.0f} needed; "
                "make room or choose another disk with --log"
            )
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | (os.O_TRUNC if overwrite else os.O_EXCL)
        return os.open(path, flags, 0o644)
    except FileExistsError as error:
        raise UserError(f"the log {path} exists already; name another one with --log or remove it") from error
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"cannot write the log {path}: {reason}; choose a folder you may write, with --log"
        ) from error
