"""What of a flight goes into its log, and where it is made. Between the flight and `companion.flightlog`."""

from __future__ import annotations

import math

import numpy as np

from companion.autopilot.adapter import VehicleStatus
from companion.control.law import StepResult
from companion.control.packing import Memory
from companion.control.structs import ControlLevel, Reference, Setpoint, Vector, VehicleState
from companion.flightlog.channels import (
    ESTIMATES,
    REFERENCE,
    SETPOINT,
    STATE,
    STREAMS,
    TIMING,
    TRUTH,
)
from companion.flightlog.law_channels import input_channel, law_terms_channel, memory_channel
from companion.flightlog.writer import FlightLog
from companion.mavlink.frames import (
    enu_from_global,
    enu_from_ned,
    flu_from_frd,
    quaternion_enu_flu_from_ned_frd,
)
from companion.mavlink.link import Message, mav
from companion.mavlink.stream_timing import StreamFigures

LEVEL_NUMBER = {ControlLevel.ATTITUDE: 0.0, ControlLevel.BODY_RATE: 1.0, ControlLevel.ACTUATOR: 2.0}


class Recorder:
    """Writes one flight into one log. All times are the autopilot's."""

    def __init__(self, log: FlightLog) -> None:
        self.log = log
        self._state = log.define(STATE)
        self._reference = log.define(REFERENCE)
        self._setpoint = log.define(SETPOINT)
        self._truth = log.define(TRUTH)
        self._timing = log.define(TIMING)
        self._estimates = log.define(ESTIMATES)
        self._streams = log.define(STREAMS)
        self._latest_enu: Vector | None = None
        self._ground_place: tuple[float, float, float] | None = None
        self._ground_samples = 0
        self._origin_offset_enu: Vector = np.zeros(3)
        self._origin_told = False

    def define_law(self, neurons: int) -> None:
        """Open the channels of the law: inputs, memory (both networks' weights, `neurons` each) and terms."""
        log = self.log
        self._input = log.define(input_channel())
        self._memory = log.define(memory_channel(neurons))
        self._terms = log.define(law_terms_channel())

    def frame(self, outgoing: bool, autopilot_time_s: float, frame: bytes) -> None:
        """One MAVLink frame; the link's tap."""
        self.log.mavlink("out" if outgoing else "in", autopilot_time_s, frame)

    def state(self, state: VehicleState, position_age_s: float) -> None:
        """The state as assembled, at its own time."""
        self._latest_enu = state.position_enu
        self.log.record(
            self._state,
            state.time_s,
            state.position_enu,
            state.velocity_enu,
            state.quaternion_wxyz,
            state.body_rate_flu,
            position_age_s,
        )

    def reference(self, time_s: float, reference: Reference, tracking_s: float) -> None:
        """The reference at `time_s`."""
        self.log.record(
            self._reference,
            time_s,
            reference.position_enu,
            reference.velocity_enu,
            reference.acceleration_enu,
            reference.jerk_enu,
            reference.snap_enu,
            reference.yaw_rad,
            reference.yaw_rate_rad_s,
            reference.yaw_acceleration_rad_s2,
            tracking_s,
        )

    def setpoint(self, time_s: float, setpoint: Setpoint, thrust_normalised: float) -> None:
        """The setpoint as sent."""
        self.log.record(
            self._setpoint,
            time_s,
            LEVEL_NUMBER[setpoint.level],
            setpoint.thrust_newton,
            thrust_normalised,
            setpoint.quaternion_wxyz,
            setpoint.body_rate_flu,
            setpoint.torque_flu,
        )

    def step(self, time_s: float, memory: Memory, inputs: Vector, result: StepResult) -> None:
        """All that is needed to repeat a step: what the law remembered, what it saw, and what it made of both."""
        self.log.record(self._input, time_s, inputs)
        self.log.record(self._memory, time_s, memory.packed)
        self.log.record(self._terms, time_s, result.terms.packed)

    def timing(self, time_s: float, period_s: float, compute_s: float, law_s: float) -> None:
        """Wall-clock durations of one control step."""
        self.log.record(self._timing, time_s, period_s, compute_s, law_s, float(self.log.waiting))

    def estimates(
        self,
        time_s: float,
        hover_thrust: float,
        offset_s: float,
        round_trip_s: float,
        delay_s: float,
        status: VehicleStatus,
    ) -> None:
        """Slow estimates."""
        voltage = status.battery_voltage_v
        self.log.record(
            self._estimates,
            time_s,
            hover_thrust,
            offset_s,
            round_trip_s,
            delay_s,
            math.nan if voltage is None else voltage,
        )

    def streams(self, time_s: float, figures: list[StreamFigures]) -> None:
        """How the autopilot's streams arrive."""
        for f in figures:
            self.log.record(
                self._streams, time_s, float(f.message_id), f.rate_hz, f.jitter_s, f.age_s, f.age_95_s
            )

    def truth(self, message: Message, status: VehicleStatus, now_s: float) -> None:
        """The simulator's true state (HIL_STATE_QUATERNION or SIM_STATE), in the autopilot's local frame.

        The local frame's origin is GPS_GLOBAL_ORIGIN. An autopilot that flies without GPS has none: then the truth
        is laid over the estimate as they stand on the ground, and the log says so.
        """
        if message.get_msgId() == mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION:
            time_s = message.time_usec * 1e-6 or now_s  # PX4's simulation leaves it 0
            place = (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
            velocity_ned = (message.vx * 1e-2, message.vy * 1e-2, message.vz * 1e-2)
            quaternion = tuple(message.attitude_quaternion)
            rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        else:
            time_s = now_s  # SIM_STATE has no time stamp
            place = (_finer(message.lat_int, message.lat), _finer(message.lon_int, message.lon), message.alt)
            velocity_ned = (message.vn, message.ve, message.vd)
            quaternion = (message.q1, message.q2, message.q3, message.q4)
            rates = (message.xgyro, message.ygyro, message.zgyro)
        origin = status.global_origin or self._assumed_origin(place, status)
        if origin is None:
            return
        self.log.record(
            self._truth,
            time_s,
            enu_from_global(*place, origin) + self._origin_offset_enu,
            enu_from_ned(velocity_ned),
            quaternion_enu_flu_from_ned_frd(quaternion),
            flu_from_frd(rates),
        )

    def _assumed_origin(
        self, place: tuple[float, float, float], status: VehicleStatus
    ) -> tuple[float, float, float] | None:
        """An origin that puts the truth on the estimate, averaged while the vehicle stands disarmed."""
        if not status.armed and self._latest_enu is not None:
            if self._ground_place is None:
                self._ground_place = place
            difference = self._latest_enu - enu_from_global(*place, self._ground_place)
            self._ground_samples += 1
            self._origin_offset_enu = (
                self._origin_offset_enu + (difference - self._origin_offset_enu) / self._ground_samples
            )
            return None
        if self._ground_place is not None and not self._origin_told:
            self._origin_told = True
            self.log.event(
                "warning",
                0.0,
                text="no GPS_GLOBAL_ORIGIN: the true position is laid over the estimate as they stood on the ground",
            )
        return self._ground_place


def _finer(integer: int, single: float) -> float:
    """SIM_STATE's position as integer 1e-7 degree where it is filled in; its float has 1 m of resolution only."""
    return integer * 1e-7 if integer else single
