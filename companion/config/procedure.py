"""How a flight is conducted and what ends it: everything that is neither the vehicle nor a gain nor a trajectory."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from companion.config.model import NotNegative, Positive, SettingsModel


class Procedure(SettingsModel):
    """Waiting times, lift-off, and the way to the trajectory and back."""

    connect_timeout_s: Positive = 30.0
    """For the autopilot's first HEARTBEAT, our clock, s."""
    ready_timeout_s: Positive = 120.0
    """Until the autopilot can be armed, its clock, s; ArduPilot takes 42 s from power-up."""
    pilot_timeout_s: Positive = 600.0
    """For the pilot to arm or to switch, where that is theirs, s."""
    prove_s: float = Field(default=1.5, ge=1.0)
    """Idle setpoints before the mode change, s; PX4 wants to have seen them for 1 s."""
    engage_speed_m_s: Positive = 3.0
    """Speed beyond which we do not engage in the air, m/s."""
    engage_tilt_deg: Positive = 20.0
    """Tilt beyond which we do not engage in the air, degrees."""
    lift_off_start: float = Field(default=0.3, ge=0.0, lt=1.0)
    """Thrust at which the rise to lift-off begins, in hover thrusts."""
    lift_off_rate: Positive = 0.5
    """Rise of thrust at lift-off, hover thrusts per second."""
    lift_off_limit: float = Field(default=0.9, gt=0.0, le=1.0)
    """Normalised thrust at which lift-off is given up."""
    lift_off_least: float = Field(default=0.6, ge=0.0, le=1.0)
    """Thrust below which no vehicle is believed to fly, in hover thrusts (the parameter may be too high)."""
    lift_off_height_m: Positive = 0.05
    """Height gained within half a second that, with `lift_off_speed_m_s`, means the vehicle flies, m."""
    lift_off_speed_m_s: Positive = 0.25
    """Upward speed gained in the same time, m/s."""
    hold_s: NotNegative = 5.0
    """Standing still before the run-in, s."""
    transit_speed_m_s: Positive = 0.8
    """Speed limit of everything but the trajectory itself, m/s."""
    transit_acceleration_m_s2: Positive = 0.8
    """Acceleration limit likewise, m/s²."""
    transit_jerk_m_s3: Positive = 2.0
    """Jerk limit likewise, m/s³."""
    land_timeout_s: Positive = 60.0
    """For the autopilot to land and disarm, s."""


class LiveReferences(SettingsModel):
    """Following references that another program sends (`--trajectory live:…`)."""

    silence_s: float = Field(default=0.2, ge=0.05, le=2.0)
    """Without a point for so long, the motion is brought to rest and held, autopilot's time, s."""
    lost_s: Positive = 3.0
    """Without a point for so long, nobody is there any more, autopilot's time, s."""
    lost: Literal["land", "hand_back"] = "land"
    """What follows then: the vehicle is landed where it is, or handed back to the autopilot, which holds."""
