"""How a flight is flown and what ends it: everything that is neither the vehicle nor a gain.

Every field can be set with `--set flight.NAME=VALUE` or in a settings file's `[flight]` table.
"""

from __future__ import annotations

import math

from pydantic import BaseModel, ConfigDict, Field


class SafetyLimits(BaseModel):
    """Limits of the supervisor; each ends our control and lets the autopilot land."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tilt_deg: float = Field(50.0, gt=5, le=80, description="tilt of the vehicle")
    tilt_duration_s: float = Field(0.3, ge=0, description="for how long the tilt may be exceeded")
    position_error_m: float = Field(1.5, gt=0, description="distance from the reference")
    position_error_duration_s: float = Field(0.5, ge=0, description="for how long the error may be exceeded")
    fence_radius_m: float = Field(30.0, gt=0, description="horizontal distance from the place of take-off")
    fence_height_m: float = Field(20.0, gt=0, description="height above the place of take-off")
    position_age_s: float = Field(0.4, gt=0, le=0.5, description="age of the newest position message")
    silence_s: float = Field(3.0, gt=0, description="silence of the whole link, our clock, before we give up on it")


class FlightSettings(BaseModel):
    """One flight, apart from controller, trajectory and vehicle."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    control_rate_hz: dict[str, float] = Field(
        default={"attitude": 100.0, "body_rate": 200.0, "actuator": 250.0},
        description="rate of state and setpoints for each control level; whole milliseconds, as ArduPilot needs",
    )
    connect_timeout_s: float = Field(30.0, gt=0, description="for the autopilot's first HEARTBEAT, our clock")
    ready_timeout_s: float = Field(120.0, gt=0, description="until the autopilot can be armed, its clock")
    pilot_timeout_s: float = Field(600.0, gt=0, description="for the pilot to arm, when we may not")
    prove_s: float = Field(1.5, ge=1.0, description="idle setpoints before the mode change; PX4 wants 1 s")
    takeoff_height_m: float = Field(1.0, gt=0.2, description="above the ground, before going to the start")
    hold_s: float = Field(5.0, ge=0, description="standing still before the run-in")
    lift_off_rate: float = Field(0.5, gt=0, description="rise of thrust at lift-off, in hover thrusts per second")
    lift_off_start: float = Field(0.3, ge=0, lt=1, description="thrust the rise begins at, in hover thrusts")
    lift_off_limit: float = Field(0.9, gt=0, le=1, description="normalised thrust at which lift-off is given up")
    lift_off_height_m: float = Field(0.08, gt=0, description="above the ground: in the air")
    lift_off_speed_m_s: float = Field(0.15, gt=0, description="upwards, together with that height")
    transit_speed_m_s: float = Field(0.8, gt=0)
    transit_acceleration_m_s2: float = Field(0.8, gt=0)
    transit_jerk_m_s3: float = Field(2.0, gt=0)
    land_timeout_s: float = Field(60.0, gt=0, description="for the autopilot to land and disarm")
    duration_s: float = Field(40.0, gt=0, le=math.inf, description="tracking time of a trajectory without an end")
    limits: SafetyLimits = SafetyLimits()
