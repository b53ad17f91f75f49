"""Parameters that a flight has changed, kept on disk until they are put back: a killed process must not forget them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass

from companion.config.errors import UserError
from companion.config.places import state_folder
from companion.flight.vehicle import Vehicle

RESTORE = "companion check --restore"


@dataclass(frozen=True, slots=True)
class Changed:
    """One parameter: its value before, and the one that was set."""

    name: str
    before: float
    value: float


class ChangedParameters:
    """Of one vehicle at one address; `vehicle` is connected, and its parameters have been read."""

    def __init__(self, vehicle: Vehicle, say: Callable[[str], None]) -> None:
        self._vehicle = vehicle
        self._say = say
        named = f"{vehicle.identity} {vehicle.link.target_system} {vehicle.address}"
        self.path = state_folder() / f"parameters-{hashlib.sha256(named.encode()).hexdigest()[:16]}.json"
        self._kept: dict[str, Changed] = {}
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            self._kept = self._read()

    def pending(self) -> list[Changed]:
        """What has not been put back, by this run or one before."""
        return list(self._kept.values())

    def set(self, name: str, value: float) -> bool:
        """Set a parameter that was read before; its old value is on disk first. True when the new one is confirmed.

        Raises UserError where nothing can be kept: then nothing is set.
        """
        before = self._kept[name].before if name in self._kept else self._vehicle.parameters.values[name]
        self._kept[name] = Changed(name, before, value)
        self._write()
        return self._vehicle.set_parameter(name, value)

    def put_back(self) -> list[Changed]:
        """Put back what is still as we set it; returns what could not be. Somebody else's later change is left alone."""
        vehicle = self._vehicle
        vehicle.read_parameters(tuple(self._kept))
        for changed in reversed(self.pending()):
            now = vehicle.parameters.values.get(changed.name)
            if now is None:
                continue
            if math.isclose(now, changed.value, rel_tol=1e-6):
                if not vehicle.set_parameter(changed.name, changed.before):
                    continue
                self._say(f"put {changed.name} back to {changed.before:g}")
            del self._kept[changed.name]
            self._write()
        return self.pending()

    def in_words(self) -> str:
        """What stays changed, and what to do; empty when nothing does."""
        if not self._kept:
            return ""
        values = ", ".join(f"{c.name} stays {c.value:g} (was {c.before:g})" for c in self.pending())
        return f"{values}: the next flight from here puts it back, or {RESTORE}"

    def _read(self) -> dict[str, Changed]:
        try:
            return {
                item["name"]: Changed(**item) for item in json.loads(self.path.read_text(encoding="utf-8"))
            }
        except (ValueError, TypeError, KeyError, UnicodeDecodeError, OSError) as error:
            if isinstance(error, (FileNotFoundError, NotADirectoryError)):
                raise
            raise UserError(
                f"{self.path}: what parameters were before an earlier flight cannot be read ({error}); compare them by "
                "hand, then remove this file"
            ) from None

    def _write(self) -> None:
        """Whole or not at all."""
        try:
            if not self._kept:
                self.path.unlink(missing_ok=True)
                return
            self.path.parent.mkdir(parents=True, exist_ok=True)
            new = self.path.with_suffix(".new")
            with new.open("w", encoding="utf-8") as file:
                json.dump([asdict(changed) for changed in self.pending()], file)
                file.flush()
                os.fsync(file.fileno())
            new.replace(self.path)
        except OSError as error:
            raise UserError(
                f"{self.path}: old values of parameters cannot be kept there ({error.strerror}), so none is changed: "
                "set XDG_STATE_HOME to a folder that can be written, or set the parameters yourself"
            ) from None
