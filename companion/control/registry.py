"""Which control laws there are. A new law is one new file and one line here."""

from __future__ import annotations

from companion.config.gains import ControllerGains
from companion.config.profile import VehicleProfile
from companion.control.law import ControlLaw
from companion.control.structs import ControlLevel


def build_law(
    name: str, gains: ControllerGains, profile: VehicleProfile, level: ControlLevel, seed: int
) -> ControlLaw:
    """Build the law `name`. Raises KeyError naming the known laws when there is no such law."""
    raise NotImplementedError
