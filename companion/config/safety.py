"""The supervisor's limits: what is watched, from which value on, for how long, and what then happens.

Every watched quantity has a ladder of reactions from soft to hard; each rung is `[threshold, seconds]` or "off", and
any of them can be changed: `--set flight.safety.position_error_m.land=[1.4, 0.3]`. A rung that is harder may not
come before a softer one of the same quantity; such settings are refused.
"""

from __future__ import annotations

import enum
import itertools
import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from companion.config.model import Number, Positive, SettingsModel


class Reaction(enum.IntEnum):
    """What the supervisor does, from soft to hard; of several wanted the hardest is done."""

    NONE = 0
    """Fly on."""
    WARN = 1
    """Fly on; the pilot and the log are told."""
    FREEZE = 2
    """Fly on; integrals and network weights keep their values."""
    NON_ADAPTIVE = 3
    """Fly on with the same loops, but the networks' share handed to the integrals and no adaptation."""
    HOLD = 4
    """The reference comes to rest smoothly and our law holds the place; after `hold_s` the vehicle is landed."""
    LAND = 5
    """The autopilot is asked to land (PX4 AUTO.LAND, ArduPilot LAND) until it does; level setpoints go on until then."""
    HAND_BACK = 6
    """The same with a hold (AUTO.LOITER, BRAKE), where it takes none with a landing; then we are gone."""
    DISARM = 7
    """Motors off, in the air too. Only where it is configured and `allow_disarm` is set."""

    @property
    def setting(self) -> str:
        """Name of the rung in the settings."""
        return self.name.lower()


RUNGS = tuple(reaction for reaction in Reaction if reaction is not Reaction.NONE)


def _as_rung(given: Any) -> Any:
    if given == "off":
        return given
    if isinstance(given, list | tuple) and len(given) == 2:
        numbers = [float(value) for value in given if isinstance(value, int | float)]
        if len(numbers) == 2 and all(map(math.isfinite, numbers)) and numbers[1] >= 0.0:
            return tuple(numbers)
    raise ValueError('write [threshold, seconds], for example [1.5, 0.5], or "off"')


Rung = Annotated[tuple[float, float] | Literal["off"], BeforeValidator(_as_rung)]
"""`[threshold, seconds]`: beyond the threshold for that long the reaction follows; 0 s is at once."""


class Ladder(SettingsModel):
    """The rungs of one quantity."""

    warn: Rung = "off"
    freeze: Rung = "off"
    non_adaptive: Rung = "off"
    hold: Rung = "off"
    land: Rung = "off"
    hand_back: Rung = "off"
    disarm: Rung = "off"

    def rungs(self) -> list[tuple[Reaction, float, float]]:
        """(reaction, threshold, seconds) of every rung in use, softest first."""
        found = []
        for reaction in RUNGS:
            rung = getattr(self, reaction.setting)
            if rung != "off":
                found.append((reaction, float(rung[0]), float(rung[1])))
        return found


@dataclass(frozen=True, slots=True)
class Quantity:
    """What a watched number is."""

    unit: str  # empty for a ratio or a count
    below: bool = False  # whether small values are the bad ones
    ends_by: float | None = None  # LAND or a harder rung has to be in use, with a threshold not beyond this


QUANTITIES: dict[str, Quantity] = {
    "attitude_age_s": Quantity("s", ends_by=0.5),
    "position_age_s": Quantity("s", ends_by=0.5),
    "position_stuck_s": Quantity("s"),
    "mode_age_s": Quantity("s"),
    "estimator_age_s": Quantity("s"),
    "sys_status_age_s": Quantity("s"),
    "estimator_lost": Quantity("parts", ends_by=0.9),
    "innovation_ratio": Quantity(""),
    "sensors_unhealthy": Quantity("sensors"),
    "position_jump_m": Quantity("m"),
    "yaw_jump_deg": Quantity("°"),
    "velocity_mismatch": Quantity(""),
    "pose_tilt_deg": Quantity("°"),
    "pose_heading_deg": Quantity("°"),
    "pose_motion": Quantity(""),
    "position_error_m": Quantity("m", ends_by=20.0),
    "velocity_error_m_s": Quantity("m/s"),
    "attitude_error_deg": Quantity("°"),
    "yaw_error_deg": Quantity("°"),
    "tilt_deg": Quantity("°", ends_by=80.0),
    "body_rate_deg_s": Quantity("°/s"),
    "thrust_margin": Quantity("", below=True),
    "fence_margin_m": Quantity("m", below=True, ends_by=0.0),
    "ceiling_margin_m": Quantity("m", below=True, ends_by=0.0),
    "floor_margin_m": Quantity("m", below=True),
    "ground_support": Quantity(""),
    "battery_remaining": Quantity("", below=True),
    "battery_voltage_v": Quantity("V", below=True),
    "round_trip_s": Quantity("s"),
    "link_loss": Quantity(""),
    "overrun_share": Quantity(""),
    "setpoint_gap_s": Quantity("s"),
    "refused_setpoints": Quantity("in a row", ends_by=10.0),
    "weight_norm": Quantity(""),
    "network_share": Quantity(""),
    "lyapunov_rise": Quantity(""),
    "log_lost": Quantity("records"),
    "disk_free_mb": Quantity("MB", below=True),
}
"""By their names in the settings, in the order in which they are judged."""


class Fence(SettingsModel):
    """Where the vehicle may be, about the place of take-off, in the local frame's axes (x east, y north)."""

    shape: Literal["cylinder", "box", "polygon"] = "cylinder"
    """Which of the following bounds the horizontal position."""
    radius_m: Positive = 30.0
    """Of the cylinder, m."""
    box_m: tuple[Number, Number, Number, Number] = (-30.0, -30.0, 30.0, 30.0)
    """West, south, east and north side of the box, from the place of take-off, m."""
    polygon_m: tuple[tuple[Number, Number], ...] = ()
    """Corners [east, north] of the polygon in order, from the place of take-off, m."""
    height_max_m: Positive = 20.0
    """Height above the place of take-off, m."""
    height_min_m: Number = 0.1
    """Height above the place of take-off, m; counts from 0.2 m above it on."""

    @model_validator(mode="after")
    def _sensible(self) -> Fence:
        west, south, east, north = self.box_m
        if not (west < 0.0 < east and south < 0.0 < north):
            raise ValueError(
                "box_m is [west, south, east, north] and has to hold the place of take-off, [0, 0]"
            )
        if self.shape == "polygon" and len(self.polygon_m) < 3:
            raise ValueError("polygon_m needs at least three corners")
        if self.height_min_m >= self.height_max_m:
            raise ValueError("height_min_m must be below height_max_m")
        return self


class SafetyLimits(SettingsModel):
    """What the supervisor watches; see `QUANTITIES` for units."""

    attitude_age_s: Ladder = Ladder(warn=(0.1, 0.0), freeze=(0.15, 0.0), land=(0.4, 0.0))
    """Since the newest attitude: gaps between states, and in real time how late they are dealt with."""
    position_age_s: Ladder = Ladder(warn=(0.15, 0.0), freeze=(0.2, 0.0), land=(0.4, 0.0))
    """Age of the position that the newest attitude goes with."""
    position_stuck_s: Ladder = Ladder(warn=(0.2, 0.0), freeze=(0.3, 0.0), land=(1.0, 0.0))
    """How long fresh messages have repeated one position although they say that it moves."""
    mode_age_s: Ladder = Ladder(warn=(2.0, 0.0), land=(5.0, 0.0))
    """Since the autopilot last told its mode (HEARTBEAT, CURRENT_MODE): whether the pilot has taken over is not known."""
    estimator_age_s: Ladder = Ladder(warn=(1.0, 0.0), land=(3.0, 0.0))
    """Since the estimator's state was last told (ESTIMATOR_STATUS; EKF_STATUS_REPORT or its bit in SYS_STATUS); where it
    was told before the flight, for without it none begins."""
    sys_status_age_s: Ladder = Ladder(warn=(2.0, 0.0), land=(10.0, 0.0))
    """The same for SYS_STATUS: sensors and battery."""
    estimator_lost: Ladder = Ladder(warn=(0.0, 0.0), land=(0.0, 0.3))
    """What the estimator says it no longer knows: attitude, velocities, position (ESTIMATOR_STATUS, EKF_STATUS_REPORT)."""
    innovation_ratio: Ladder = Ladder(warn=(0.8, 1.0), freeze=(1.0, 0.5), land=(2.0, 2.0))
    """Largest innovation test ratio of the estimator; above 1 it rejects what it measures."""
    sensors_unhealthy: Ladder = Ladder(warn=(0.0, 0.0), land=(0.0, 2.0))
    """Gyroscope, accelerometer or attitude estimate enabled but not healthy (SYS_STATUS)."""
    position_jump_m: Ladder = Ladder(warn=(0.0, 0.0), hold=(1.5, 0.0), land=(5.0, 0.0))
    """An estimator reset; plan and fence are moved along with it, so that the vehicle is not kicked."""
    yaw_jump_deg: Ladder = Ladder(warn=(0.0, 0.0), hold=(20.0, 0.0), land=(60.0, 0.0))
    """The same for the heading."""
    velocity_mismatch: Ladder = Ladder(warn=(0.8, 1.0), land=(1.3, 0.5))
    """The autopilot's positions against its own velocities over 1 s: the displacements' difference over the longer of
    them, once that is 1 m. 1 is one that stands still, 1.4 a turn by 90°, 2 an axis with the wrong sign."""
    pose_tilt_deg: Ladder = Ladder(warn=(10.0, 0.5), land=(25.0, 0.5))
    """Angle between the vertical of poses from outside and that of the autopilot's estimate; only where it uses them."""
    pose_heading_deg: Ladder = Ladder(warn=(20.0, 0.5), land=(45.0, 0.5))
    """The same for the heading."""
    pose_motion: Ladder = Ladder(warn=(0.5, 0.5), land=(0.8, 0.5))
    """The same for the movement of the last second, measured as in `velocity_mismatch`, from 0.3 m on."""
    position_error_m: Ladder = Ladder(
        warn=(0.8, 0.5), non_adaptive=(1.0, 0.5), hold=(1.25, 0.5), land=(1.5, 0.5)
    )
    """Distance from the reference."""
    velocity_error_m_s: Ladder = Ladder(
        warn=(1.5, 0.3), non_adaptive=(2.0, 0.3), hold=(2.5, 0.3), land=(4.0, 0.3)
    )
    """Length of the velocity's difference from the reference."""
    attitude_error_deg: Ladder = Ladder(
        warn=(30.0, 0.3), freeze=(35.0, 0.3), hold=(45.0, 0.4), land=(60.0, 0.3)
    )
    """Angle between the vehicle's thrust axis and the one last asked for."""
    yaw_error_deg: Ladder = Ladder(warn=(30.0, 1.0), hold=(60.0, 1.0), land=(120.0, 1.0))
    """Heading away from the reference."""
    tilt_deg: Ladder = Ladder(warn=(40.0, 0.2), freeze=(45.0, 0.2), land=(50.0, 0.3))
    """Angle between the vehicle's thrust axis and the vertical."""
    body_rate_deg_s: Ladder = Ladder(warn=(230.0, 0.1), freeze=(280.0, 0.1), land=(400.0, 0.2))
    """Length of the body rate."""
    thrust_margin: Ladder = Ladder(warn=(0.02, 0.3), freeze=(0.01, 0.5), hold=(0.01, 2.0), land=(0.01, 4.0))
    """Distance of the thrust asked for from the nearer of its bounds, as a share of the range between them."""
    fence_margin_m: Ladder = Ladder(warn=(0.5, 0.0), hold=(0.25, 0.0), land=(0.0, 0.0))
    """Horizontal distance to the fence, negative outside."""
    ceiling_margin_m: Ladder = Ladder(warn=(0.5, 0.0), hold=(0.25, 0.0), land=(0.0, 0.0))
    """Distance below the greatest height, negative above it."""
    floor_margin_m: Ladder = Ladder(land=(0.0, 0.2))
    """Distance above the least height, negative below it."""
    ground_support: Ladder = Ladder(warn=(0.2, 0.3), land=(0.3, 0.4))
    """Share of the weight that neither thrust nor acceleration accounts for over 0.5 s, below 2 m and from 5 s after
    lift-off: what the ground carries. 1 where the land detector says ground, or it does not turn towards what is asked."""
    battery_remaining: Ladder = Ladder(warn=(0.25, 5.0), land=(0.12, 5.0))
    """Share of the charge that is left (SYS_STATUS); unknown counts as full."""
    battery_voltage_v: Ladder = Ladder()
    """Voltage under load (SYS_STATUS); off, since it depends on the pack."""
    round_trip_s: Ladder = Ladder(warn=(0.05, 2.0), freeze=(0.1, 1.0), land=(0.15, 1.0))
    """TIMESYNC round trip, median of 32; on the autopilot's clock where that does not run like ours. The prediction
    reaches across 0.1 s of it; what lies beyond makes the shipped gains swing, and 0.15 s tipped a vehicle over."""
    link_loss: Ladder = Ladder(warn=(0.02, 1.0), freeze=(0.2, 1.0), land=(0.5, 3.0))
    """Share of the autopilot's frames of the last 2 s that never came, by sequence numbers."""
    overrun_share: Ladder = Ladder(warn=(0.05, 1.0), freeze=(0.3, 1.0), land=(0.8, 2.0))
    """Share of control steps that took longer than a control period, over 1 s; in real time only."""
    setpoint_gap_s: Ladder = Ladder(warn=(0.1, 0.0), hand_back=(0.5, 0.0))
    """Since a setpoint last went out, while states keep coming."""
    refused_setpoints: Ladder = Ladder(warn=(0.0, 0.0), land=(2.0, 0.0))
    """Setpoints in a row that the law made and the last gate refused: not finite, off bounds."""
    weight_norm: Ladder = Ladder(warn=(0.9, 1.0), freeze=(0.98, 1.0), non_adaptive=(0.98, 3.0))
    """Larger of both networks' weight norms, as a share of its bound."""
    network_share: Ladder = Ladder(
        warn=(0.75, 0.5), freeze=(0.85, 0.5), non_adaptive=(0.92, 0.5), land=(0.98, 2.0)
    )
    """The position network's force as a share of the whole force: its authority limit. NNSMC has no integral, so its
    network carries the weight that m̂ does not know of: 0.67 of it at m̂ = 70 %."""
    lyapunov_rise: Ladder = Ladder(
        warn=(3.0, 0.5), freeze=(4.0, 0.5), non_adaptive=(5.0, 0.5), hold=(6.5, 0.5)
    )
    """Error part of V, Eq. (20), over 0.5 s against the same over 5 s, 0.1 J added to both. A V that grows like e^rt
    settles at (1 + 5r) / (1 + r/2): 3 means r = 0.6 /s, 4 means 1 /s, 6.5 means 3 /s; 10 is the most there can be."""
    log_lost: Ladder = Ladder(warn=(0.0, 0.0))
    """Records of the log that were lost."""
    disk_free_mb: Ladder = Ladder(warn=(200.0, 0.0))
    """Room for the log."""

    fence: Fence = Fence()
    """Where the vehicle may be; a plan that leaves it is refused before take-off."""
    hold_s: Positive = 10.0
    """How long HOLD lasts before the vehicle is landed, coming to rest included, s."""
    recovery_s: Positive = 2.0
    """How long a quantity has to be well within a rung before that rung is let go of, s."""
    recovery_share: float = Field(default=0.9, gt=0.0, le=1.0)
    """Well within: beyond this share of the threshold (for quantities that are bad below it, of its inverse)."""
    unproven: Literal["warn", "refuse"] = "warn"
    """What follows where the gains break a condition of Proposition 1 or 2: the flight is flown with a warning, or not."""
    allow_disarm: bool = False
    """Whether `disarm` rungs may be used: they stop the motors in the air."""
    lift_off_tilt_deg: float = Field(default=20.0, ge=5.0, le=60.0)
    """Tilt at which a lift-off is given up: the vehicle is tipping over."""
    stall_s: Positive = 0.3
    """Our clock, in real time: a loop that has not come round for so long sends nothing more and lands, s."""
    stick_share: float = Field(default=0.15, gt=0.0, le=1.0)
    """Travel of a stick, as a share of 1000 µs, that means that the pilot takes over (RC_CHANNELS 1 to 4)."""
    rc_lost: Literal["land", "fly_on"] = "land"
    """What follows where the pilot's transmitter was there and is lost (RC_CHANNELS, SYS_STATUS): that is no pilot."""
    hand_over_s: Positive = 10.0
    """After sticks took the vehicle from us: without a mode change or a movement of the sticks for so long nobody has it,
    and it is landed, s."""
    silence_s: Positive = 3.0
    """Silence of the whole link, on our clock, before it is given up, s."""

    @model_validator(mode="before")
    @classmethod
    def _keep_other_rungs(cls, given: Any) -> Any:
        """A table that names some rungs changes those and keeps the others."""
        if not isinstance(given, dict):
            return given
        merged = dict(given)
        for name, rungs in given.items():
            field = cls.model_fields.get(name)
            if name in QUANTITIES and field is not None and isinstance(rungs, dict):
                merged[name] = {**field.default.model_dump(), **rungs}
        return merged

    @model_validator(mode="after")
    def _ordered(self) -> SafetyLimits:
        wrong = [text for name in QUANTITIES for text in self._wrong_with(name)]
        if wrong:
            raise ValueError("; ".join(wrong))
        return self

    def ladder(self, name: str) -> Ladder:
        """The ladder of a quantity."""
        return getattr(self, name)  # type: ignore[no-any-return]

    def _wrong_with(self, name: str) -> list[str]:
        quantity, rungs = QUANTITIES[name], self.ladder(name).rungs()
        sign = -1.0 if quantity.below else 1.0
        wrong = []
        for (soft, soft_at, soft_s), (hard, hard_at, hard_s) in itertools.pairwise(rungs):
            if sign * hard_at < sign * soft_at:
                wrong.append(
                    f"{name}: {hard.setting} at {hard_at:g} would come before {soft.setting} at {soft_at:g}"
                )
            elif hard_at == soft_at and hard_s < soft_s:
                wrong.append(
                    f"{name}: {hard.setting} after {hard_s:g} s would come before {soft.setting} after {soft_s:g} s"
                )
        if quantity.ends_by is not None:
            ends = [at for reaction, at, _ in rungs if reaction >= Reaction.LAND]
            if not ends or sign * ends[0] > sign * quantity.ends_by:
                word = "above" if quantity.below else "up to"
                wrong.append(
                    f"{name}: land or a harder rung has to be in use, with a threshold {word} {quantity.ends_by:g}"
                )
        if not self.allow_disarm and self.ladder(name).disarm != "off":
            wrong.append(
                f"{name}: disarm stops the motors in the air; set flight.safety.allow_disarm=true to use it"
            )
        return wrong
