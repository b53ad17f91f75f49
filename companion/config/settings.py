"""Everything a flight is told beforehand: flight, vehicle, and the gains that follow from both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import Field

from companion.config.errors import UserError
from companion.config.gains import ControllerGains
from companion.config.load import apply_overrides, find_profile, nearest, parse_override, read_toml, validated
from companion.config.model import Positive, SettingsModel
from companion.config.procedure import LiveReferences, Procedure
from companion.config.profile import LevelName, VehicleProfile
from companion.config.resolve import Override, profile_values, require_torque_numbers
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
    live: LiveReferences = LiveReferences()
    """What becomes of references that stop coming."""
    safety: SafetyLimits = SafetyLimits()
    """What the supervisor watches, and what it does."""

    @property
    def rate_hz(self) -> float:
        """Control rate, Hz: the one given, or the level's default."""
        return self.control_rate_hz or DEFAULT_RATE_HZ[self.level]


@dataclass(frozen=True, slots=True)
class Given:
    """What somebody wrote or set, apart from what was made of it: to resolve it anew once more is known."""

    profile: dict[str, Any] = field(default_factory=dict)  # the file's tables
    origin: str = "no profile"
    profile_overrides: tuple[Override, ...] = ()
    gains_overrides: tuple[Override, ...] = ()
    texts: dict[str, dict[str, str]] = field(default_factory=lambda: {"profile": {}, "gains": {}})


@dataclass(frozen=True, slots=True)
class Settings:
    """A flight's settings, resolved: the gains are those of its controller at its level."""

    flight: FlightSettings
    profile: VehicleProfile
    gains: ControllerGains
    overrides: tuple[str, ...]  # as given, for the log
    given: Given | None = field(default=None, compare=False)  # None: read from a log

    @property
    def level(self) -> ControlLevel:
        """Output level."""
        return ControlLevel(self.flight.level)

    def as_tables(self) -> dict[str, Any]:
        """Everything as plain tables, for the log; `settings_from_tables` reads it back."""
        return {
            "flight": self.flight.model_dump(mode="json"),
            "profile": self.profile.model_dump(mode="json"),
            "gains": self.gains.model_dump(mode="json"),
            "overrides": list(self.overrides),
        }


def load_profile(name: str | None, overrides: Sequence[str] = ()) -> VehicleProfile:
    """The complete profile `name` (shipped, or a .toml path; None: nothing known) with `key=value` overrides.

    Raises UserError.
    """
    values, origin = _written(name)
    parsed = [parse_override(text) for text in overrides]
    texts = {".".join(key): text for (key, _), text in zip(parsed, overrides, strict=True)}
    return validated(VehicleProfile, profile_values(values, parsed), origin, texts)


def _written(name: str | None) -> tuple[dict[str, Any], str]:
    if name is None:
        return {}, "no profile"
    path = find_profile(name)
    return read_toml(path), str(path)


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
    profile: str | None = "qball2", flight: dict[str, Any] | None = None, overrides: Iterable[str] = ()
) -> Settings:
    """Settings from a profile (None: everything from the autopilot), the flight's own values and `--set` overrides.

    Override keys start with `flight.`, `profile.` or `gains.`; the last means the gains of the controller and
    level that are flown, e.g. `gains.position_loop.K_U=[2, 2, 12]`. Raises UserError with all that is wrong.
    """
    rooms: dict[str, list[Override]] = {"flight": [], "profile": [], "gains": []}
    texts: dict[str, dict[str, str]] = {"flight": {}, "profile": {}, "gains": {}}
    all_given = tuple(overrides)
    for text in all_given:
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
    values, origin = _written(profile)
    given = Given(values, origin, tuple(rooms["profile"]), tuple(rooms["gains"]), texts)
    settings = resolved(flown, given, all_given)
    if settings.level is ControlLevel.ACTUATOR:
        require_torque_numbers(values, given.profile_overrides, origin)
    return settings


def resolved(
    flown: FlightSettings,
    given: Given,
    overrides: tuple[str, ...],
    read: Mapping[str, Any] | None = None,
    autopilot: str | None = None,
) -> Settings:
    """Settings from what was given and, below it, the tables that `autopilot` told. Raises UserError."""
    values = profile_values(given.profile, given.profile_overrides, read, autopilot)
    vehicle = validated(VehicleProfile, values, given.origin, given.texts["profile"])
    gains = select_gains(vehicle, flown.controller, flown.level)
    changed = apply_overrides(ControllerGains, gains.model_dump(), given.gains_overrides)
    gains = validated(
        ControllerGains, changed, f"gains of {flown.controller} at level {flown.level}", given.texts["gains"]
    )
    return Settings(flown, vehicle, gains, overrides, given)


def settings_from_tables(tables: dict[str, Any]) -> Settings:
    """Settings as a log holds them (`Settings.as_tables`). Raises UserError where they do not fit this version."""
    return Settings(
        validated(FlightSettings, tables["flight"], "logged flight settings"),
        validated(VehicleProfile, tables["profile"], "logged profile"),
        validated(ControllerGains, tables["gains"], "logged gains"),
        tuple(tables.get("overrides", ())),
    )
