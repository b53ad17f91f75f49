"""Setpoints over MAVLink as PX4 takes them: what each type_mask means, and how fresh they are."""

from __future__ import annotations

import math
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.common.wire_values import NAN
from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.core import CONTROL_PERIOD_US
from sitl_stub.firmware.px4.modes import Mode
from sitl_stub.firmware.px4.state import Px4State
from sitl_stub.mavlink.codec import Received

CONTROL_MODE_PERIOD_US = 500_000
ESTIMATE_PERIOD_US = 4000
"""How often PX4's attitude loop runs on the estimate of its simulator (250 Hz)."""

# ATTITUDE_TARGET_TYPEMASK
IGNORE_RATES = 0b111
IGNORE_THROTTLE = 64
IGNORE_ATTITUDE = 128
# POSITION_TARGET_TYPEMASK
IGNORE_YAW = 1024
IGNORE_YAW_RATE = 2048
IS_FORCE = 512
LOCAL_NED = 1
BODY_NED_FRAMES = (8, 12)  # velocities and accelerations in the heading's frame


def finite_or_nan(number: float) -> float:
    """An infinite number controls nothing, as NaN does."""
    return number if math.isfinite(number) else NAN


class OffboardKind(Enum):
    """What the last offboard setpoint controlled."""

    NONE = "none"
    """No setpoint yet."""
    POSITION = "position"
    """Position or velocity: needs a local position estimate."""
    VELOCITY = "velocity"
    """Velocity only."""
    ACCELERATION = "acceleration"
    """Acceleration only."""
    ATTITUDE = "attitude"
    """Attitude and thrust."""
    RATES = "rates"
    """Body rates and thrust."""
    ACTUATORS = "actuators"
    """Torques and thrust straight to the mixer (PX4 up to 1.13)."""

    @property
    def controllers(self) -> str:
        """Which controllers it needs: the three kinds of trajectory setpoint share theirs."""
        return "trajectory" if self.value in ("position", "velocity", "acceleration") else self.value


class OffboardSetpoint:
    """The last setpoint, packed as the control loops want it, and when it came."""

    def __init__(self, takes_actuators: bool) -> None:
        self.takes_actuators = takes_actuators
        self.kind = OffboardKind.NONE
        self.last_us = -(10**12)
        self.packed: NDArray[np.float64] = np.zeros(at.SETPOINT_SIZE)
        self.count = 0

    def fresh(self, time_us: int, timeout_s: float) -> bool:
        """Whether the last setpoint is younger than COM_OF_LOSS_T."""
        return self.kind is not OffboardKind.NONE and time_us - self.last_us < timeout_s * 1e6

    def _accept(self, kind: OffboardKind, time_us: int) -> bool:
        self.kind = kind
        self.last_us = time_us
        self.count += 1
        return True

    def take_attitude(self, message: Received, time_us: int) -> bool:
        """SET_ATTITUDE_TARGET; returns whether it was usable.

        Attitude with rates (mask 0) lets the rates override the attitude loop, throttle ignored (64) is zero
        thrust, a quaternion off unit length is normalised, one that is none refuses the message.
        """
        v: dict[str, Any] = message.values
        mask = v["type_mask"]
        attitude = not mask & IGNORE_ATTITUDE
        w, x, y, z = v["q"]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        thrust = 0.0 if mask & IGNORE_THROTTLE else v["thrust"]
        if not math.isfinite(thrust) or not (attitude or (mask & IGNORE_RATES) != IGNORE_RATES):
            return False
        if attitude and not 1e-6 <= norm < math.inf:
            return False
        rates = [
            0.0 if mask & bit or not math.isfinite(v[name]) else v[name]
            for bit, name in ((1, "body_roll_rate"), (2, "body_pitch_rate"), (4, "body_yaw_rate"))
        ]
        thrust = min(max(thrust, 0.0), 1.0)
        packed = self.packed
        if attitude:
            packed[at.QUATERNION : at.QUATERNION + 4] = (w / norm, x / norm, y / norm, z / norm)
        packed[at.RATES : at.RATES + 3] = packed[at.OVERRIDE_RATES : at.OVERRIDE_RATES + 3] = rates
        packed[at.THRUST] = packed[at.OVERRIDE_THRUST] = thrust
        packed[at.YAW_RATE] = rates[2] if attitude and mask & IGNORE_RATES == 0b011 else 0.0
        packed[at.OVERRIDE_PERIODS] = at.ALWAYS if attitude and mask & IGNORE_RATES == 0 else 0.0
        packed[at.KIND] = at.KIND_ATTITUDE if attitude else at.KIND_RATES
        return self._accept(OffboardKind.ATTITUDE if attitude else OffboardKind.RATES, time_us)

    def take_position(self, message: Received, yaw: float, time_us: int) -> bool:
        """SET_POSITION_TARGET_LOCAL_NED; `yaw` is the present heading, for frames that turn with it."""
        v = message.values
        frame = v["coordinate_frame"]
        if frame != LOCAL_NED and frame not in BODY_NED_FRAMES:
            return False
        mask = v["type_mask"]
        if mask & IS_FORCE:
            return False
        fields = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz")
        values = [NAN if mask >> bit & 1 else finite_or_nan(v[name]) for bit, name in enumerate(fields)]
        position, velocity, acceleration = values[:3], values[3:6], values[6:]
        if frame in BODY_NED_FRAMES:
            position = [NAN] * 3
            velocity = self._turned(velocity, yaw)
            acceleration = self._turned(acceleration, yaw)
        kinds = (
            (position, OffboardKind.POSITION),
            (velocity, OffboardKind.VELOCITY),
            (acceleration, OffboardKind.ACCELERATION),
        )
        controlled = [kind for vector, kind in kinds if any(math.isfinite(number) for number in vector)]
        if not controlled:
            return False
        packed = self.packed
        packed[at.POSITION : at.POSITION + 3] = position
        packed[at.VELOCITY : at.VELOCITY + 3] = velocity
        packed[at.ACCELERATION : at.ACCELERATION + 3] = acceleration
        packed[at.YAW] = NAN if mask & IGNORE_YAW else finite_or_nan(v["yaw"])
        yaw_rate = 0.0 if mask & IGNORE_YAW_RATE else float(v["yaw_rate"])
        packed[at.YAW_RATE] = yaw_rate if math.isfinite(yaw_rate) else 0.0
        packed[at.OVERRIDE_PERIODS] = 0.0
        packed[at.KIND] = at.KIND_TRAJECTORY
        return self._accept(controlled[0], time_us)

    @staticmethod
    def _turned(vector: list[float], yaw: float) -> list[float]:
        """A vector of the heading's frame in NED."""
        if any(math.isnan(number) for number in vector[:2]):
            return [NAN, NAN, vector[2]]
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        return [
            cos_yaw * vector[0] - sin_yaw * vector[1],
            sin_yaw * vector[0] + cos_yaw * vector[1],
            vector[2],
        ]

    def take_actuators(self, message: Received, time_us: int) -> bool:
        """SET_ACTUATOR_CONTROL_TARGET, group 0: roll, pitch, yaw, thrust. Arrives and does nothing from PX4 1.14 on."""
        v = message.values
        if not self.takes_actuators or v["group_mlx"] != 0:
            return False
        controls = [float(number) for number in v["controls"][:4]]
        if not all(math.isfinite(number) for number in controls):
            return False
        self.packed[at.ACTUATORS : at.ACTUATORS + 4] = controls
        self.packed[at.OVERRIDE_PERIODS] = 0.0
        self.packed[at.KIND] = at.KIND_ACTUATORS
        return self._accept(OffboardKind.ACTUATORS, time_us)


class OffboardControl:
    """Gives the setpoint to the loops, as far as the controllers that run let it."""

    def __init__(self, state: Px4State, setpoint: OffboardSetpoint) -> None:
        self.state = state
        self.setpoint = setpoint
        self._latched_kind = OffboardKind.NONE
        self.latched_us = 0
        self._latched_state = (state.armed, state.mode)

    def latch(self) -> bool:
        """Every 10 ms: look which controllers run; whether that has just been decided.

        PX4's commander publishes it when the mode or arming changes, and else twice a second. Until then a setpoint of
        another kind meets the controllers of the old one (seen in the capture).
        """
        state, now = (self.state.armed, self.state.mode), self.state.clock.time_us
        if state != self._latched_state or now - self.latched_us >= CONTROL_MODE_PERIOD_US:
            self._latched_state = state
            self.latched_us = now
            self._latched_kind = self.setpoint.kind
            return True
        return False

    @property
    def attitude_loop_runs(self) -> bool:
        """Whether the setpoints in force use the attitude loop (HEARTBEAT's stabilise bit in OFFBOARD)."""
        return self._latched_kind not in (OffboardKind.NONE, OffboardKind.RATES, OffboardKind.ACTUATORS)

    def apply(self) -> None:
        """Let the loops follow the setpoint, where OFFBOARD flies."""
        if not (self.state.armed and self.state.mode is Mode.OFFBOARD) or self.state.killed:
            return
        new, old = self.setpoint.kind, self._latched_kind
        packed, setpoint = self.setpoint.packed, self.state.core.setpoint
        if setpoint[at.KIND] == at.KIND_IDLE or new.controllers == old.controllers:
            setpoint[:] = packed
        elif old is OffboardKind.ATTITUDE and new is OffboardKind.RATES:
            # the attitude loop still runs and overwrites each rate setpoint with its own, one estimate later
            setpoint[at.OVERRIDE_RATES : at.OVERRIDE_RATES + 3] = packed[at.RATES : at.RATES + 3]
            setpoint[at.OVERRIDE_THRUST] = packed[at.THRUST]
            setpoint[at.OVERRIDE_PERIODS] = ESTIMATE_PERIOD_US // CONTROL_PERIOD_US
