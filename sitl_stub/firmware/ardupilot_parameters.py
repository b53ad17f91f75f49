"""ArduCopter's parameter table: every value travels as a float, whatever its type, and is cast as C does.

Names, order, types and stock values are those of the capture (`data/ardupilot_parameters.json`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

from sitl_stub.firmware.parameters import REAL32, ParameterError, ParameterTable

INT8, INT16, INT32 = 2, 4, 6
KINDS = {"b": INT8, "h": INT16, "i": INT32, "f": REAL32}
"""Letter in the data file to MAV_PARAM_TYPE."""
BITS = {INT8: 8, INT16: 16, INT32: 32}
DATA_FILE = "ardupilot_parameters.json"
ROUNDING = 0.01
"""What ArduPilot adds before it cuts the fraction off."""


class ArduPilotParameters(ParameterTable):
    """Parameters in the order of their indices, each with its own width."""

    def __init__(self, values: Mapping[str, float], kinds: Mapping[str, int]) -> None:
        super().__init__(values)
        self._kinds = dict(kinds)

    def kind(self, name: str) -> int:
        """MAV_PARAM_TYPE of a parameter."""
        return self._kinds[name]

    def set(self, name: str, value: float) -> None:
        """Change one: integers are cut after a nudge of 0.01 and held within their width.

        Raises ParameterError for an unknown name or a number that is none.
        """
        if name in self and self._kinds[name] in BITS and math.isfinite(value):
            half = 1 << (BITS[self._kinds[name]] - 1)
            cut = math.trunc(min(max(value + math.copysign(ROUNDING, value), -half), half - 1))
            self._values[name] = cut
            self.changes += 1
            return
        if name in self and not math.isfinite(value):
            raise ParameterError(f"parameter {name} cannot be {value}: give a finite number")
        super().set(name, value)


def stock_parameters() -> ArduPilotParameters:
    """The list of the capture with stock values."""
    text = (Path(__file__).parent / "data" / DATA_FILE).read_text(encoding="utf-8")
    content = json.loads(text)
    values: dict[str, float] = content["values"]
    kinds = {name: KINDS[letter] for name, letter in zip(values, content["kinds"], strict=True)}
    return ArduPilotParameters(values, kinds)
