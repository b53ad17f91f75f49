"""The state at the moment a setpoint acts, predicted with the setpoints already sent.

A state message is some milliseconds old (estimator, link), and what is sent now moves the vehicle only after the
dead time of the autopilot's loop. What happens in between is already decided: by the state, and by setpoints
under way. The law is given the state, and the reference, of that later moment; of the autopilot's
response only the lag is left, which the law makes up for by lead.

Thrust has a dead time of its own: it passes by the loops that turn the vehicle, and acts before the attitude sent with it.

The model is small: thrust behind the rotors' lag, gravity, and the attitude behind the setpoint as the
profile's response says. A step is pure and compiled; `Predictor` keeps the setpoints under way.
"""

from __future__ import annotations

import math

import numpy as np

from companion.config.profile import VehicleProfile
from companion.control.compiled import compiled
from companion.control.structs import ControlLevel, Setpoint, Vector, VehicleState

RING = 64
"""Setpoints remembered: 0.25 s of them at 250 Hz, more than any dead time with a few rotor lags."""
LONGEST_SUBSTEP_S = 0.004
USUAL_OVER_S = 0.25
"""The thrust that is not decided yet is the mean of those sent so long, s."""
TIME, THRUST, QUATERNION, RATE, TORQUE, ROW = 0, 1, 2, 6, 9, 12
"""Columns of a remembered setpoint: when all but its thrust acts (s), N, wxyz, rad/s, N·m."""


def pack_model(profile: VehicleProfile, level: ControlLevel, autopilot: str | None) -> Vector:
    """The vehicle's response as (16,): level, g, ω² (3), 2ζω (3), 1/rate lag (3), rotor lag, inertia (3), thrust's delay.

    The last is by how much later than the rest of a setpoint its thrust acts, s; negative where it acts earlier.
    """
    response = profile.response(autopilot)
    axes = (response.tilt, response.tilt, response.yaw)
    model = np.zeros(16)
    model[0] = {ControlLevel.ATTITUDE: 0.0, ControlLevel.BODY_RATE: 1.0, ControlLevel.ACTUATOR: 2.0}[level]
    model[1] = profile.gravity_m_s2
    model[2:5] = [axis.natural_frequency_rad_s**2 for axis in axes]
    model[5:8] = [2.0 * axis.damping * axis.natural_frequency_rad_s for axis in axes]
    model[8:11] = [1.0 / max(lag, 1e-3) for lag in response.rate_lag_s]
    model[11] = profile.rotors.lag_rad_s
    model[12:15] = profile.inertia_kg_m2
    model[15] = response.thrust_dead_time(level) - response.dead_time(level)
    return model


@compiled
def _angular_acceleration(
    model: Vector, setpoint: Vector, torque: Vector, quaternion: Vector, rate: Vector, out: Vector
) -> None:
    """dω/dt into `out` (3,), rad/s² in the body frame under a setpoint row, at the level of `model`."""
    if model[0] == 0.0:
        w, x, y, z = quaternion[0], -quaternion[1], -quaternion[2], -quaternion[3]
        e, f, g, h = (
            setpoint[QUATERNION],
            setpoint[QUATERNION + 1],
            setpoint[QUATERNION + 2],
            setpoint[QUATERNION + 3],
        )
        side = 2.0 if w * e - x * f - y * g - z * h >= 0.0 else -2.0
        gap = (w * f + x * e + y * h - z * g, w * g - x * h + y * e + z * f, w * h + x * g - y * f + z * e)
        for i in range(3):
            out[i] = model[2 + i] * side * gap[i] - model[5 + i] * rate[i]
    elif model[0] == 1.0:
        for i in range(3):
            out[i] = model[8 + i] * (setpoint[RATE + i] - rate[i])
    else:
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            gyroscopic = (model[12 + k] - model[12 + j]) * rate[j] * rate[k]
            out[i] = (torque[i] - gyroscopic) / model[12 + i]


@compiled
def _turn(quaternion: Vector, turn: Vector) -> None:
    """`quaternion` (4,) turned by the rotation vector `turn` (3,) of its body, in place."""
    half = 0.5 * math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    ratio = 0.5 * (math.sin(half) / half if half > 1e-8 else 1.0 - half * half / 6.0)
    a, b, c, d = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    e, f, g, h = math.cos(half), ratio * turn[0], ratio * turn[1], ratio * turn[2]
    quaternion[0] = a * e - b * f - c * g - d * h
    quaternion[1] = a * f + b * e + c * h - d * g
    quaternion[2] = a * g - b * h + c * e + d * f
    quaternion[3] = a * h + b * g - c * f + d * e


@compiled
def predict(
    model: Vector, ring: Vector, count: int, mass: float, state: Vector, start: float, end: float
) -> Vector:
    """State (13,) = [p, v, q, ω] at `end` from the one at `start`, s, under the setpoints of `ring`.

    `ring` (n, 12) holds `count` rows ordered by the time at which they begin to act, their thrust `model[15]` later;
    `mass` in kg is the one that turns thrust setpoints into the acceleration they really give. Nothing is allocated
    on the way: with some 25 substeps a call that cost more than the arithmetic.

    The thrust that is asked for next acts before `end`, where it passes by the loops that turn the vehicle. From then on
    the thrust is taken to be what it has been in the mean: were the last one held, the law would answer its own answer,
    and with 0.13 s of dead time and a lead against slow rotors thrust swung between its bounds.
    """
    out = state.copy()
    position, velocity, quaternion, rate = out[0:3], out[3:6], out[6:10], out[10:13]
    if count == 0:
        for i in range(3):
            position[i] += velocity[i] * (end - start)
        return out
    # where the rotors have got to by `start`: the setpoints before it, through the rotors' lag
    thrust = ring[0, THRUST]
    torque = ring[0, TORQUE:ROW].copy()
    angular, turn = np.empty(3), np.empty(3)
    later = model[15]
    decided = end + min(0.0, later)
    usual, recent = 0.0, 0
    while recent < count and ring[count - 1 - recent, TIME] > ring[count - 1, TIME] - USUAL_OVER_S:
        usual += ring[count - 1 - recent, THRUST]
        recent += 1
    usual /= recent
    now = min(start, ring[0, TIME] + min(0.0, later))
    row = thrust_row = 0
    while now < end:
        while row + 1 < count and ring[row + 1, TIME] <= now + 1e-9:
            row += 1
        while thrust_row + 1 < count and ring[thrust_row + 1, TIME] + later <= now + 1e-9:
            thrust_row += 1
        until = end
        if now < start - 1e-9:
            until = start
        if row + 1 < count:
            until = min(until, ring[row + 1, TIME])
        if thrust_row + 1 < count:
            until = min(until, ring[thrust_row + 1, TIME] + later)
        if now < decided - 1e-9:
            until = min(until, decided)
        flying = now >= start - 1e-9
        dt = min(until - now, LONGEST_SUBSTEP_S) if flying else until - now
        settle = -math.expm1(-model[11] * dt)
        wanted = ring[thrust_row, THRUST]
        if now >= decided - 1e-9:
            wanted = usual
        thrust += settle * (wanted - thrust)
        for i in range(3):
            torque[i] += settle * (ring[row, TORQUE + i] - torque[i])
        if flying:
            _angular_acceleration(model, ring[row], torque, quaternion, rate, angular)
            for i in range(3):
                turn[i] = (rate[i] + 0.5 * dt * angular[i]) * dt
                rate[i] += dt * angular[i]
            w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
            axis = (
                2 * (x * z + w * y),
                2 * (y * z - w * x),
                1 - 2 * (x * x + y * y),
            )  # of thrust, in the world
            for i in range(3):
                acceleration = axis[i] * thrust / mass - (model[1] if i == 2 else 0.0)
                position[i] += dt * (velocity[i] + 0.5 * dt * acceleration)
                velocity[i] += dt * acceleration
            _turn(quaternion, turn)
        now += dt
    norm = math.sqrt(quaternion[0] ** 2 + quaternion[1] ** 2 + quaternion[2] ** 2 + quaternion[3] ** 2)
    for i in range(4):
        quaternion[i] /= norm
    return out


class Predictor:
    """Remembers the setpoints under way and predicts states to the moment the next one acts.

    The mass that turns thrust setpoints into acceleration is not taken from the profile, of which the law may be
    told a part only: it is what the thrust sent has been carrying, low-passed over a second.
    """

    CARRYING_TIME_S = 1.0

    def __init__(self, profile: VehicleProfile, level: ControlLevel, autopilot: str | None = None) -> None:
        """Read delays and responses for `autopilot` (`px4`, `ardupilot`) from the profile, and compile.

        Seconds the first time on a machine: build it before arming.
        """
        self._model = pack_model(profile, level, autopilot)
        self._dead_s = profile.response(autopilot).dead_time(level)
        self._estimator_s = profile.estimator_delay_s
        self._rows = np.zeros((8 * RING, ROW))  # so that they need not all move at every setpoint
        self._first = 0
        self._ring = self._rows[:RING]
        self._count = 0
        self._gravity = profile.gravity_m_s2
        self._mass = profile.mass_estimate_kg
        self.link_delay_s = 0.0
        """What the link takes beyond what is within the dead time, from a state's stamp to its setpoint's arrival, s."""
        self._warm_up()

    def respond(self, profile: VehicleProfile, level: ControlLevel, autopilot: str | None) -> None:
        """Go on with another response; setpoints under way act by it, too."""
        self._model = pack_model(profile, level, autopilot)
        later_s = profile.response(autopilot).dead_time(level) - self._dead_s
        self._dead_s += later_s
        self._ring[: self._count, TIME] += later_s

    @property
    def delay_s(self) -> float:
        """From a state's true age to the moment a setpoint sent now acts, s."""
        return self._estimator_s + self.ahead_s

    @property
    def ahead_s(self) -> float:
        """From a state's time stamp to that moment, s: the reference is to be taken this much later."""
        return self._dead_s + self.link_delay_s

    @property
    def mass_kg(self) -> float:
        """What the thrust setpoints have been carrying, kg."""
        return self._mass

    def sent(self, time_s: float, setpoint: Setpoint) -> None:
        """Remember a setpoint sent at `time_s` on the autopilot's clock."""
        acts_s = time_s + self.ahead_s
        if self._count and acts_s <= self._ring[self._count - 1, TIME]:
            self._count -= 1  # the clock stood still or stepped back: the newest replaces
            while self._count and acts_s <= self._ring[self._count - 1, TIME]:
                self._count -= 1
        dt = acts_s - self._ring[self._count - 1, TIME] if self._count else 0.0
        if self._count == RING:
            self._forget_oldest()
            self._count -= 1
        thrust, (w, x, y, z) = setpoint.thrust_newton, setpoint.quaternion_wxyz.tolist()
        rate, torque = setpoint.body_rate_flu.tolist(), setpoint.torque_flu.tolist()
        self._ring[self._count] = (acts_s, thrust, w, x, y, z, *rate, *torque)
        self._count += 1
        carried = thrust * (1.0 - 2.0 * (x * x + y * y)) / self._gravity
        if carried > 0.3 * self._mass:  # idle on the ground carries nothing
            self._mass += -math.expm1(-min(dt, 0.1) / self.CARRYING_TIME_S) * (carried - self._mass)

    def hovering(self, time_s: float, quaternion_wxyz: Vector, thrust_newton: float) -> None:
        """Begin anew with a vehicle that somebody else has kept at this attitude (4,) with this thrust."""
        w, x, y, z = quaternion_wxyz.tolist()
        self._ring[0] = (time_s - self.CARRYING_TIME_S, thrust_newton, w, x, y, z, *(0.0,) * 6)
        self._count = 1
        self._mass = thrust_newton * (1.0 - 2.0 * (x * x + y * y)) / self._gravity

    def _forget_oldest(self) -> None:
        """Let the ring begin one row later; at the end of the rows that are there it moves back to their beginning."""
        self._first += 1
        if self._first + RING > len(self._rows):
            self._rows[:RING] = self._rows[self._first - 1 : self._first - 1 + RING]
            self._first = 1
        self._ring = self._rows[self._first : self._first + RING]

    def predict(self, state: VehicleState) -> VehicleState:
        """The state at the moment a setpoint sent now acts; its `time_s` says when that is."""
        if self.delay_s <= 0.0:
            return state
        packed = np.concatenate(
            (state.position_enu, state.velocity_enu, state.quaternion_wxyz, state.body_rate_flu)
        )
        start, end = state.time_s - self._estimator_s, state.time_s + self.ahead_s
        out = predict(self._model, self._ring, self._count, self._mass, packed, start, end)
        return VehicleState(end, out[0:3], out[3:6], out[6:10], out[10:13])

    def _warm_up(self) -> None:
        state = np.concatenate((np.zeros(6), [1.0, 0.0, 0.0, 0.0], np.zeros(3)))
        predict(self._model, self._ring, 0, 1.0, state, 0.0, 0.0)
