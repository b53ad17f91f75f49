"""The way out of the control loop: newtons to what the autopilot calls thrust, the gate, the message, the wire.

Whoever reckons with the setpoints under way (prediction, hover thrust, log) is told of each from here.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from companion.autopilot.attitude_response import AttitudeResponseMeter
from companion.autopilot.hover_thrust import HoverThrustEstimator
from companion.autopilot.thrust import ThrustScale
from companion.control.prediction import Predictor
from companion.control.structs import Setpoint, Vector
from companion.flight.realtime import LoopWatchdog
from companion.flight.recorder import Recorder
from companion.flight.setpoint_gate import SetpointGate
from companion.flight.vehicle import Vehicle
from companion.mavlink.link import Message


class SetpointSender:
    """See the module. `thrust` is the scale in force; the loop changes it as its estimate of hover thrust moves."""

    def __init__(
        self,
        vehicle: Vehicle,
        thrust: ThrustScale,
        gate: SetpointGate,
        hover: HoverThrustEstimator,
        predictor: Predictor,
        recorder: Recorder,
    ) -> None:
        self._vehicle = vehicle
        self.gate = gate
        self._hover = hover
        self._predictor = predictor
        self._recorder = recorder
        self.thrust = thrust
        self.watchdog: LoopWatchdog | None = None
        """While it has tripped nothing goes out: what would, was made of a state from before the loop stood still."""
        self.asked_quaternion: Vector = np.array([1.0, 0.0, 0.0, 0.0])
        """(4,) of the newest setpoint that passed the gate."""
        self.asked_thrust_newton = 0.0
        self.refused = 0  # setpoints in a row
        self.last_sent_s = -math.inf  # on the autopilot's clock
        self.counters: Counter[str] = Counter()
        self.meter: AttitudeResponseMeter | None = None
        """Of the attitude loop's response, at the attitude level."""

    def send(
        self, time_s: float, setpoint: Setpoint, rotor_thrust: Vector | None, thrust: float | None = None
    ) -> bool:
        """Send a setpoint through the gate; False when it was refused there.

        `rotor_thrust` (N,) in newtons is what goes out, at the actuator level only; `thrust` overrides the normalised
        collective, for idling below the least thrust of flight.
        """
        adapter, link = self._vehicle.adapter, self._vehicle.link
        if thrust is None:
            thrust = self.thrust.normalised(setpoint.thrust_newton)
        controls = self.thrust.controls(rotor_thrust) if rotor_thrust is not None else None
        if not self._fit(time_s, setpoint, thrust, controls):
            return False
        target = link.target_system or 1
        if controls is not None:
            message = adapter.encode_actuators(time_s, controls, target)
        else:
            message = adapter.encode(setpoint, time_s, thrust, target)
        self._post(time_s, message, setpoint, thrust)
        return True

    def _fit(self, time_s: float, setpoint: Setpoint, thrust: float, controls: Vector | None) -> bool:
        refusal = self.gate.refusal(setpoint, thrust, controls)
        if not refusal:
            self.refused = 0
            return True
        self.counters["setpoints refused"] += 1
        if self.refused == 0:
            self._recorder.log.event("safety", time_s, reaction="setpoint refused", reason=refusal)
        self.refused += 1
        return False

    def _post(self, time_s: float, message: Message, setpoint: Setpoint, thrust: float) -> None:
        if self.watchdog is not None and self.watchdog.tripped:
            self.counters["setpoints withheld"] += 1
            return
        if self._vehicle.link.send(message):
            self.last_sent_s = time_s
        else:
            self.counters["setpoints not sent"] += 1
        self.asked_quaternion, self.asked_thrust_newton = setpoint.quaternion_wxyz, setpoint.thrust_newton
        self._hover.sent(time_s, thrust)
        self._predictor.sent(time_s, setpoint)
        if self.meter is not None:  # what the link takes beyond the ordinary is predicted apart
            self.meter.sent(time_s + self._predictor.link_delay_s, setpoint.quaternion_wxyz)
        self._recorder.setpoint(time_s, setpoint, thrust)
