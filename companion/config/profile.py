"""What is known of a vehicle: mass, inertia, rotors, how its autopilot responds, and the gains found for it.

A `VehicleProfile` is complete. A profile's file need not be, and may be empty: what it leaves out comes from the
autopilot's parameters, from what else is known, or from the common gains (`resolve.py`).
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from companion.config.gains import ControllerGains
from companion.config.model import NotNegative, NotNegative3, Number, Positive, Positive3, SettingsModel
from companion.control.structs import ControlLevel, Vector

Autopilot = Literal["px4", "ardupilot"]
LevelName = Literal["attitude", "body_rate", "actuator"]


class Rotor(SettingsModel):
    """One rotor, seen from the centre of mass, body FLU."""

    x_m: Number
    """Forward, m."""
    y_m: Number
    """To the left, m."""
    spin: Literal["ccw", "cw"]
    """Direction of turning seen from above; the reaction torque on the vehicle is the other way round."""


class Rotors(SettingsModel):
    """All rotors; they are alike."""

    layout: tuple[Rotor, ...] = Field(min_length=4, max_length=8)
    """In the order of the autopilot's actuator outputs."""
    thrust_max_newton: Positive
    """Thrust of one rotor at full throttle, N."""
    thrust_min_newton: NotNegative = 0.0
    """Thrust of one rotor at idle, N."""
    torque_per_newton_m: Positive
    """kτ: reaction torque per thrust, m."""
    lag_rad_s: Positive
    """Bandwidth of the rotors' first-order lag, rad/s."""

    @property
    def arms_m(self) -> Vector:
        """Rotor positions (n, 2), m, x forward, y left."""
        return np.array([(rotor.x_m, rotor.y_m) for rotor in self.layout])

    @property
    def spins(self) -> Vector:
        """Sign of each rotor's reaction torque about z up, (n,)."""
        return np.array([1.0 if rotor.spin == "cw" else -1.0 for rotor in self.layout])


class SecondOrder(SettingsModel):
    """A second-order response with dead time: y(t + dead_time) follows ω²/(s² + 2ζωs + ω²)."""

    natural_frequency_rad_s: Positive
    """ω, rad/s."""
    damping: Positive
    """ζ."""

    @property
    def lag_s(self) -> float:
        """2ζ/ω: the lag behind a ramp, s; first coefficient of the inverse."""
        return 2.0 * self.damping / self.natural_frequency_rad_s

    @property
    def lag_squared_s2(self) -> float:
        """1/ω²: second coefficient of the inverse, s²."""
        return 1.0 / self.natural_frequency_rad_s**2


class AutopilotResponse(SettingsModel):
    """How one autopilot's own loops follow setpoints on this vehicle. `companion identify LOG` finds these."""

    dead_time_s: NotNegative = 0.07
    """From sending an attitude setpoint to the first motion, s, link included. Made up for by prediction."""
    rate_dead_time_s: NotNegative = 0.05
    """The same for a body-rate setpoint, s."""
    actuator_dead_time_s: NotNegative = 0.0
    """The same for thrust and torque at the actuator level, s."""
    thrust_dead_time_s: NotNegative = 0.01
    """From sending an attitude or body-rate setpoint to the first change of its thrust, before the rotors' lag, s: it
    passes by the autopilot's loops, so it is shorter than the attitude's."""
    tilt: SecondOrder = SecondOrder(natural_frequency_rad_s=12.0, damping=1.0)
    """Roll and pitch behind an attitude setpoint."""
    yaw: SecondOrder = SecondOrder(natural_frequency_rad_s=4.6, damping=0.6)
    """Yaw behind an attitude setpoint."""
    rate_lag_s: NotNegative3 = (0.034, 0.034, 0.2)
    """Roll, pitch and yaw rate behind a body-rate setpoint: first-order time constants, s."""

    def thrust_dead_time(self, level: ControlLevel) -> float:
        """Dead time of the thrust in setpoints at `level`, s."""
        return self.actuator_dead_time_s if level is ControlLevel.ACTUATOR else self.thrust_dead_time_s

    def dead_time(self, level: ControlLevel) -> float:
        """Dead time of setpoints at `level`, s; of their thrust, see `thrust_dead_time`."""
        if level is ControlLevel.ATTITUDE:
            return self.dead_time_s
        return self.rate_dead_time_s if level is ControlLevel.BODY_RATE else self.actuator_dead_time_s


class Limits(SettingsModel):
    """What the law may ask of this vehicle, and where it refuses to go on."""

    tilt_max_deg: float = Field(default=35.0, gt=0.0, le=60.0)
    """Bound on the desired tilt."""
    tilt_abort_deg: float = Field(default=75.0, gt=0.0, le=80.0)
    """A vehicle tilted further gets no setpoint: Φ is singular at 90° of pitch."""
    thrust_min_ratio: NotNegative = 0.05
    """Least total thrust, as a share of all rotors at full throttle."""
    thrust_max_ratio: float = Field(default=0.9, gt=0.0, le=1.0)
    """Greatest total thrust, as a share of all rotors at full throttle; the rest is kept for torque."""
    force_z_min_ratio: float = Field(default=0.2, gt=0.0, lt=1.0)
    """Floor under f_z, as a share of the weight m̂g."""
    body_rate_max_deg_s: Positive3 = (220.0, 220.0, 120.0)
    """Bounds on the desired body rates."""

    @model_validator(mode="after")
    def _ordered(self) -> Limits:
        if self.tilt_abort_deg < self.tilt_max_deg + 10.0:
            raise ValueError(
                f"tilt_abort_deg ({self.tilt_abort_deg:g}) must be at least 10° above tilt_max_deg "
                f"({self.tilt_max_deg:g}), or an ordinary overshoot ends the flight"
            )
        if self.thrust_max_ratio <= self.thrust_min_ratio:
            raise ValueError("thrust_max_ratio must be above thrust_min_ratio")
        return self


class LevelGains(SettingsModel):
    """Gains of one controller, by output level. A level that is missing cannot be flown with this profile."""

    attitude: ControllerGains | None = None
    """Thrust and attitude."""
    body_rate: ControllerGains | None = None
    """Thrust and body rates."""
    actuator: ControllerGains | None = None
    """Thrust and torque."""


class VehicleProfile(SettingsModel):
    """One vehicle. Shipped ones are TOML files in `companion/config/profiles`."""

    name: str = Field(default="this vehicle", min_length=1)
    """Shown and logged."""
    description: str = ""
    """One line on what it is."""
    mass_kg: Positive = 1.0
    """m, true mass with battery and payload, kg. Where it is left out, forces are simply counted per kilogram."""
    mass_ratio: float = Field(default=1.0, ge=0.3, le=2.0)
    """m̂/m: the share of the mass the law is told; 0.7 in the report's experiment."""
    gravity_m_s2: float = Field(default=9.81, gt=9.7, lt=9.9)
    """g."""
    inertia_kg_m2: Positive3
    """Diagonal of I about x, y, z. Flies at the actuator level only."""
    drag_kg_s: NotNegative3 = (0.0, 0.0, 0.0)
    """Diagonal of D_p in Eq. (1)."""
    rotational_drag_kg_m2_s: NotNegative3 = (0.0, 0.0, 0.0)
    """Diagonal of D_η in Eq. (1)."""
    rotors: Rotors
    """Geometry and thrust."""
    hover_thrust: float = Field(gt=0.0, lt=1.0)
    """The autopilot's normalised thrust (0..1) in hover: first guess for the estimator."""
    estimator_delay_s: NotNegative = 0.0
    """Age of the autopilot's estimate beyond its time stamp, s."""
    responses: dict[Autopilot, AutopilotResponse] = Field(min_length=1)
    """By autopilot."""
    lag_margin: float = Field(default=1.0, ge=1.0, le=3.0)
    """The common gains are chosen for a response so many times as slow: above 1 where it is not known well."""
    limits: Limits = Limits()
    """Bounds on the commands."""
    controllers: dict[str, LevelGains] = Field(min_length=1)
    """Gains by controller's name."""

    @model_validator(mode="after")
    def _can_hover(self) -> VehicleProfile:
        weight = self.mass_kg * self.gravity_m_s2
        available = self.limits.thrust_max_ratio * self.thrust_available_newton
        if available < 1.2 * weight:
            raise ValueError(
                f"{len(self.rotors.layout)} rotors of {self.rotors.thrust_max_newton:g} N give {available:.1f} N within "
                f"limits.thrust_max_ratio; flying {self.mass_kg:g} kg takes at least 1.2 times its weight, "
                f"{1.2 * weight:.1f} N"
            )
        return self

    @property
    def mass_estimate_kg(self) -> float:
        """m̂, kg."""
        return self.mass_kg * self.mass_ratio

    @property
    def thrust_available_newton(self) -> float:
        """All rotors at full throttle, N."""
        return len(self.rotors.layout) * self.rotors.thrust_max_newton

    @property
    def tilt_max_rad(self) -> float:
        """Bound on the desired tilt, rad."""
        return math.radians(self.limits.tilt_max_deg)

    def response(self, autopilot: str | None = None) -> AutopilotResponse:
        """Return the response of `autopilot`, or the first in the file where it is unknown or None."""
        found = self.responses.get(autopilot) if autopilot else None  # type: ignore[call-overload]
        return found if found is not None else next(iter(self.responses.values()))
