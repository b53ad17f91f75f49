"""Everything a flight is told beforehand: flight, vehicle, and the gains that follow from both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from companion.config.errors import UserError
from companion.config.gains import ControllerGains
from companion.config.load import apply_overrides, find_profile, nearest, parse_override, read_toml, validated
from companion.config.model import Positive, SettingsModel
from companion.config.procedure import Procedure
from companion.config.profile import LevelName, VehicleProfile
from companion.config.safety import SafetyLimits
from companion.control.structs import ControlLevel

DEFAULT_RATE_HZ: dict[LevelName, float] = {"attitude": 100.0, "body_rate": 250.0, "actuator": 250.0}
"""Control rates whose periods are whole milliseconds, as ArduPilot wants them, and multiples of PX4's 4 ms (simulated)."""


GAINS_OF: dict[str, str] = {}
"""Laws of one's own (`companion.register_law`) → the law whose gains they take where a profile has none for them."""


class FlightSettings(SettingsModel):
    """What is flown, and how often the law runs."""

    controller: str = "dtlannc"
    """A law of `companion.control.registry`."""
    level: LevelName = "attitude"
    """What is sent to the autopilot."""
    trajectory: str = "lemniscate"
    """A trajectory of `companion.reference`, or a file of one."""
    layout: Literal["takeoff", "local"] = "takeoff"
    """Trajectories start from the position and heading at take-off, or stand in the autopilot's local frame."""
    control_rate_hz: float | None = Field(default=None, ge=20.0, le=500.0)
    """Rate of state and setpoints asked for, Hz; by default `DEFAULT_RATE_HZ` of the level."""
    seed: int = Field(default=1, ge=0)
    """Draws the networks' input matrices."""
    duration_s: Positive = 40.0
    """Length of tracking."""
    takeoff_height_m: float = Field(default=1.0, ge=0.3, le=30.0)
    """Height above the take-off point before tracking."""
    procedure: Procedure = Procedure()
    """Waiting times, lift-off, the way to the trajectory and back."""
    safety: SafetyLimits = SafetyLimits()
    """What the supervisor watches, and what it does."""

    @property
    def rate_hz(self) -> float:
        """Control rate, Hz: the one given, or the level's default."""
        return self.control_rate_hz or DEFAULT_RATE_HZ[self.level]


@dataclass(frozen=True, slots=True)
class Settings:
    """A flight's settings, resolved: the gains are those of its controller at its level."""

    flight: FlightSettings
    profile: VehicleProfile
    gains: ControllerGains
    overrides: tuple[str, ...]  # as given, for the log

    @property
    def level(self) -> ControlLevel:
        """Output level."""
        return ControlLevel(self.flight.level)

    def as_tables(self) -> dict[str, Any]:
        """Everything as plain tables, for the log's metadata; `settings_from_tables` reads it back."""
        return {
            "flight": self.flight.model_dump(mode="json"),
            "profile": self.profile.model_dump(mode="json"),
            "gains": self.gains.model_dump(mode="json"),
            "overrides": list(self.overrides),
        }


def load_profile(name: str, overrides: Sequence[str] = ()) -> VehicleProfile:
    """The profile `name` (shipped, or a .toml path) with `key=value` overrides. Raises UserError."""
    path = find_profile(name)
    values = read_toml(path)
    parsed = [parse_override(text) for text in overrides]
    texts = {".".join(key): text for (key, _), text in zip(parsed, overrides, strict=True)}
    return validated(VehicleProfile, apply_overrides(VehicleProfile, values, parsed), str(path), texts)


def select_gains(profile: VehicleProfile, controller: str, level: str) -> ControllerGains:
    """The gains of `controller` at `level`. Raises UserError that says what the profile has instead."""
    if controller not in profile.controllers:
        controller = GAINS_OF.get(controller, controller)
    if controller not in profile.controllers:
        raise UserError(
            f"profile {profile.name!r} has no gains for controller {controller!r}"
            f"{nearest(controller, profile.controllers)}; it has {', '.join(profile.controllers)}"
        )
    gains = getattr(profile.controllers[controller], level)
    if gains is None:
        raise UserError(
            f"profile {profile.name!r} has no gains for {controller} at level {level}; "
            f"add [controllers.{controller}.{level}.position_loop] to it"
        )
    return gains  # type: ignore[no-any-return]


def load_settings(
    profile: str = "qball2", flight: dict[str, Any] | None = None, overrides: Iterable[str] = ()
) -> Settings:
    """Settings from a profile, the flight's own values and `--set` overrides.

    Override keys start with `flight.`, `profile.` or `gains.`; the last means the gains of the controller and
    level that are flown, e.g. `gains.position_loop.K_U=[2, 2, 12]`. Raises UserError with all that is wrong.
    """
    rooms: dict[str, list[tuple[list[str], Any]]] = {"flight": [], "profile": [], "gains": []}
    texts: dict[str, dict[str, str]] = {"flight": {}, "profile": {}, "gains": {}}
    given = tuple(overrides)
    for text in given:
        path, value = parse_override(text)
        if path[0] not in rooms or len(path) < 2:
            raise UserError(
                f"--set {text}: keys start with flight., profile. or gains."
                f"{nearest(path[0], rooms)}, for example --set gains.position_loop.alpha=0.5"
            )
        rooms[path[0]].append((path[1:], value))
        texts[path[0]][".".join(path[1:])] = text
    flown = validated(
        FlightSettings,
        apply_overrides(FlightSettings, flight or {}, rooms["flight"]),
        "flight settings",
        texts["flight"],
    )
    path = find_profile(profile)
    values = apply_overrides(VehicleProfile, read_toml(path), rooms["profile"])
    vehicle = validated(VehicleProfile, values, str(path), texts["profile"])
    gains = select_gains(vehicle, flown.controller, flown.level)
    changed = apply_overrides(ControllerGains, gains.model_dump(), rooms["gains"])
    gains = validated(
        ControllerGains, changed, f"gains of {flown.controller} at level {flown.level}", texts["gains"]
    )
    return Settings(flown, vehicle, gains, given)


def settings_from_tables(tables: dict[str, Any]) -> Settings:
    """Settings as a log holds them (`Settings.as_tables`). Raises UserError where they do not fit this version."""
    return Settings(
        validated(FlightSettings, tables["flight"], "logged flight settings"),
        validated(VehicleProfile, tables["profile"], "logged profile"),
        validated(ControllerGains, tables["gains"], "logged gains"),
        tuple(tables.get("overrides", ())),
    )
