"""One flight of a law, compiled from end to end: estimate, prediction, law, setpoint on its way, autopilot, vehicle.

What `companion fly` does between two processes happens here in one function, a hundred times faster than real time.
The law, the prediction and the autopilot are the very functions that fly; only the wire between them is replaced,
by the frame conversion below and a queue that delays setpoints.
"""

from __future__ import annotations

import math

import numpy as np

from companion.control.bounds import NOT_FINITE, TOO_TILTED
from companion.control.compiled import compiled
from companion.control.law import StepKernel
from companion.control.prediction import QUATERNION as ROW_QUATERNION
from companion.control.prediction import RATE as ROW_RATE
from companion.control.prediction import THRUST as ROW_THRUST
from companion.control.prediction import TIME as ROW_TIME
from companion.control.prediction import TORQUE as ROW_TORQUE
from companion.control.prediction import Predictor, predict
from companion.control.rotation import wrap_angle
from companion.control.structs import Packed, Record, Vector
from companion.tuning.lagged_plant import advance_lagged
from companion.tuning.reference_table import PERIOD_S
from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.loop import fly
from sitl_stub.physics import vehicle as body
from sitl_stub.physics.estimator import (
    EST_BODY_RATE,
    EST_POSITION,
    EST_QUATERNION,
    EST_VELOCITY,
    advance_estimate,
)
from sitl_stub.physics.noise import RandomState, standard_normal
from sitl_stub.physics.wind import advance_wind

# how the flight is set up (SETUP_SIZE,)
AHEAD_S, ESTIMATOR_S, FULL_NEWTON, ROTOR_MAX, DELAY_S, JITTER_S, GUST_NEWTON, GUST_CORNER = range(8)
PLANT, HOLD_TICKS, TRACK_FROM, LEVEL, THRUST_MIN, THRUST_MAX = 8, 9, 10, 11, 12, 13
SETUP_SIZE = 14
STUB, LAGGED = 0.0, 1.0
LEAST_THRUST = 0.02  # as ThrustScale

# what a flight came to (RESULT_SIZE,): sums of squares, divided by the count at the end
POSITION_SQUARES, ATTITUDE_SQUARES, SHAKE_SQUARES, COMMAND_SQUARES, HOLD_SQUARES = 0, 3, 6, 9, 12
ENDED_AT, WORST_ERROR, BOUND_TICKS = 15, 16, 17
RESULT_SIZE = 18

# one row of the history: time, p_d − p (3), η_d − η (3), η sent or wanted (3), thrust, torque (3), body rate (3), e_p est.
HISTORY_SIZE = 20
FARTHEST_M = 1.5  # as the supervisor's limit
QUEUE = 128
QUEUE_ROW = 14
CARRYING_TIME_S = Predictor.CARRYING_TIME_S
TRUE_POSITION, TRUE_QUATERNION, TRUE_RATE = body.POSITION, body.QUATERNION, body.BODY_RATE
FORCE = body.EXTERNAL_FORCE
KIND, KIND_ATTITUDE, KIND_RATES, KIND_ACTUATORS = at.KIND, at.KIND_ATTITUDE, at.KIND_RATES, at.KIND_ACTUATORS
SET_QUATERNION, SET_RATES, SET_THRUST, SET_ACTUATORS = at.QUATERNION, at.RATES, at.THRUST, at.ACTUATORS
POSITION_PERIODS = 5  # LOCAL_POSITION_NED comes at 100 Hz at most


@compiled
def turned(q: Vector) -> Vector:
    """(4,) NED/FRD attitude as ENU/FLU, or back: the same turn both ways; w ≥ 0."""
    half = math.sqrt(0.5)
    out = np.array((half * (q[0] + q[3]), half * (q[1] + q[2]), half * (q[1] - q[2]), half * (q[0] - q[3])))
    return -out if out[0] < 0.0 else out


@compiled
def remember(ring: Vector, count: int, carried: Vector, gravity: float, terms: Record, acts_s: float) -> int:
    """`Predictor.sent` on arrays: put a setpoint into `ring` (n, 12), move the carried mass (1,); the new count."""
    while count > 0 and acts_s <= ring[count - 1, ROW_TIME]:
        count -= 1
    dt = acts_s - ring[count - 1, ROW_TIME] if count > 0 else 0.0
    if count == ring.shape[0]:
        for k in range(count - 1):
            ring[k] = ring[k + 1]
        count -= 1
    row = ring[count]
    row[ROW_TIME], row[ROW_THRUST] = acts_s, terms.thrust
    for i in range(4):
        row[ROW_QUATERNION + i] = terms.quaternion[i]
    for i in range(3):
        row[ROW_RATE + i] = terms.body_rate[i]
        row[ROW_TORQUE + i] = terms.torque[i]
    upright = 1.0 - 2.0 * (row[ROW_QUATERNION + 1] ** 2 + row[ROW_QUATERNION + 2] ** 2)
    newton = terms.thrust * upright / gravity
    if newton > 0.3 * carried[0]:
        carried[0] += -math.expm1(-min(dt, 0.1) / CARRYING_TIME_S) * (newton - carried[0])
    return count + 1


@compiled
def encode(terms: Record, level: int, setup: Vector, unmix: Vector, due: int, row: Vector) -> None:
    """A law's output as the stub's setpoint: [due period, kind, q (4) NED/FRD, thrust, rates (3) or controls (4)]."""
    row[0] = due
    row[6] = min(1.0, max(LEAST_THRUST, terms.thrust / setup[FULL_NEWTON]))
    if level == 2:
        row[1] = KIND_ACTUATORS
        for k in range(4):
            control = 0.0
            for j in range(unmix.shape[1]):
                control += unmix[k, j] * min(1.0, max(0.0, terms.rotor_thrust[j] / setup[ROTOR_MAX]))
            low = 0.0 if k == 3 else -1.0
            control = min(1.0, max(low, control))
            row[7 + k] = -control if k in (1, 2) else control
    else:
        row[1] = KIND_ATTITUDE if level == 0 else KIND_RATES
        row[2:6] = turned(terms.quaternion)
        row[7], row[8], row[9] = terms.body_rate[0], -terms.body_rate[1], -terms.body_rate[2]


@compiled
def apply(row: Vector, setpoint: Vector) -> None:
    """Put an encoded row into the stub's setpoint array."""
    setpoint[KIND] = row[1]
    setpoint[SET_THRUST] = row[6]
    for i in range(4):
        setpoint[SET_QUATERNION + i] = row[2 + i]
    if row[1] == KIND_RATES:
        for i in range(3):
            setpoint[SET_RATES + i] = row[7 + i]
    if row[1] == KIND_ACTUATORS:
        for i in range(4):
            setpoint[SET_ACTUATORS + i] = row[7 + i]


@compiled
def fill_input(x: Record, state: Vector, reference: Vector, dt: float, bounds: tuple[float, float]) -> None:
    """`pack_input` on arrays: state (13,) ENU/FLU, a row of the reference table, time step; the gate is RUN."""
    for i in range(3):
        x.position[i], x.velocity[i], x.body_rate[i] = state[i], state[3 + i], state[10 + i]
        x.reference_position[i] = reference[i]
        x.reference_velocity[i] = reference[3 + i]
        x.reference_acceleration[i] = reference[6 + i]
        x.reference_jerk[i] = reference[9 + i]
        x.reference_snap[i] = reference[12 + i]
    for i in range(4):
        x.quaternion[i] = state[6 + i]
    x.reference_yaw = reference[15]
    x.reference_yaw_rate = reference[16]
    x.reference_yaw_acceleration = reference[17]
    x.dt, x.gate = dt, 0.0
    x.thrust_min, x.thrust_max = bounds


@compiled
def command_of(terms: Record, level: int, i: int) -> float:
    """What is sent about tilt axis `i`, as an angle (attitude), a rate (body rate) or a torque."""
    if level == 0:
        return terms.euler_setpoint[i]  # type: ignore[no-any-return]
    if level == 1:
        return terms.body_rate[i]  # type: ignore[no-any-return]
    return terms.torque[i]  # type: ignore[no-any-return]


@compiled
def judge(
    setup: Vector,
    k: int,
    error: Vector,
    attitude_error: Vector,
    rate: Vector,
    terms: Record,
    step: Vector,
    result: Vector,
) -> None:
    """Add tick `k` to the sums: error (3,) ENU, η_d − η and body rate (3,), change of the command (3,) per s."""
    if k < setup[TRACK_FROM]:
        if setup[HOLD_TICKS] / 2 < k < setup[HOLD_TICKS]:
            for i in range(3):
                result[HOLD_SQUARES + i] += error[i] ** 2 / (setup[HOLD_TICKS] / 2)
        return
    for i in range(3):
        result[POSITION_SQUARES + i] += error[i] ** 2
        result[ATTITUDE_SQUARES + i] += attitude_error[i] ** 2
        result[SHAKE_SQUARES + i] += (rate[i] - terms.flat_euler_rate[i]) ** 2
        result[COMMAND_SQUARES + i] += step[i] ** 2
    if terms.bounds:
        result[BOUND_TICKS] += 1.0


@compiled
def true_euler(q: Vector) -> Vector:
    """ZYX angles (3,) of an attitude (4,)."""
    return np.array(
        (
            math.atan2(2.0 * (q[0] * q[1] + q[2] * q[3]), 1.0 - 2.0 * (q[1] ** 2 + q[2] ** 2)),
            math.asin(min(1.0, max(-1.0, 2.0 * (q[0] * q[2] - q[3] * q[1])))),
            math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] ** 2 + q[3] ** 2)),
        )
    )


def fly_law(
    kernel: StepKernel,
    parameters: Packed,
    memories: Packed,
    inputs: Packed,
    terms_of: Packed,
    periods: Vector,
    now: Vector,
    ahead: Vector,
    setup: Vector,
    model: Vector,
    ring: Vector,
    carried: Vector,
    unmix: Vector,
    queue: Vector,
    lagged: Vector,
    random: RandomState,
    state: Vector,
    estimate: Vector,
    estimator_memory: Vector,
    delay_line: Vector,
    estimator_settings: Vector,
    estimator_random: RandomState,
    wind: Vector,
    wind_random: RandomState,
    setpoint: Vector,
    gains: Vector,
    memory: Vector,
    mixer: Vector,
    columns: Vector,
    scratch: Vector,
    vehicle: Vector,
    environment: Vector,
    position_every: int,
    physics_steps: int,
    result: Vector,
    history: Vector,
) -> None:
    """Fly the whole reference table; everything is changed in place, the outcome is in `result` and `history`.

    `history` (n, 20) is filled where it has rows. A flight that leaves the reference by 1.5 m, or whose law refuses,
    ends there: `result[ENDED_AT]` is the share of the flight that was flown.
    """
    level = int(setup[LEVEL])
    bounds = (setup[THRUST_MIN], setup[THRUST_MAX])
    n = now.shape[0]
    x, terms = inputs[0], terms_of[0]
    here_memory, next_memory = memories[0:1], memories[1:2]
    packed, error = np.empty(13), np.empty(3)
    push, step, last_command = np.zeros(3), np.zeros(3), np.zeros(3)
    count = head = tail = 0
    position_time, next_position = 0.0, 0
    last_time, last_due = 0.0, -1
    ended = n
    desired = np.empty((n, 3))  # η_d as made at each tick, for AHEAD_S later
    attitude_error, due_tick = np.zeros(3), 0
    for k in range(n):
        time = periods[k] * PERIOD_S
        dt = time - last_time if k > 0 else (periods[1] - periods[0]) * PERIOD_S
        last_time = time
        if periods[k] >= next_position:
            next_position = (periods[k] // POSITION_PERIODS + 1) * POSITION_PERIODS
            position_time = time
            for i in range(2):
                packed[i], packed[3 + i] = estimate[EST_POSITION + 1 - i], estimate[EST_VELOCITY + 1 - i]
            packed[2], packed[5] = -estimate[EST_POSITION + 2], -estimate[EST_VELOCITY + 2]
        here = packed.copy()
        for i in range(3):
            here[i] += (time - position_time) * packed[3 + i]
        here[6:10] = turned(estimate[EST_QUATERNION : EST_QUATERNION + 4])
        here[10], here[11] = estimate[EST_BODY_RATE], -estimate[EST_BODY_RATE + 1]
        here[12] = -estimate[EST_BODY_RATE + 2]
        there = predict(
            model, ring, count, carried[0], here, time - setup[ESTIMATOR_S], time + setup[AHEAD_S]
        )
        fill_input(x, there, ahead[k], dt, bounds)
        terms.bounds = 0
        kernel(parameters, here_memory, inputs, next_memory, terms_of)
        here_memory, next_memory = next_memory, here_memory
        error[0] = now[k, 0] - state[TRUE_POSITION + 1]
        error[1] = now[k, 1] - state[TRUE_POSITION]
        error[2] = now[k, 2] + state[TRUE_POSITION + 2]
        size = math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
        if terms.bounds & (NOT_FINITE | TOO_TILTED) or not size < FARTHEST_M:
            ended = k
            break
        result[WORST_ERROR] = max(result[WORST_ERROR], size)
        count = remember(ring, count, carried, model[1], terms, time + setup[AHEAD_S])
        late = setup[DELAY_S] + setup[JITTER_S] * abs(standard_normal(random))
        due = max(periods[k] + round(late / PERIOD_S), last_due)
        last_due = due
        encode(terms, level, setup, unmix, due, queue[tail % QUEUE])
        tail = k + 1
        euler = true_euler(turned(state[TRUE_QUATERNION : TRUE_QUATERNION + 4]))
        rate = np.array((state[TRUE_RATE], -state[TRUE_RATE + 1], -state[TRUE_RATE + 2]))
        for i in range(3):
            command = command_of(terms, level, i)
            step[i] = (command - last_command[i]) / dt
            last_command[i] = command
        for i in range(3):
            desired[k, i] = terms.euler_desired[i]
        while due_tick < k and periods[due_tick + 1] * PERIOD_S + setup[AHEAD_S] <= time + 1e-9:
            due_tick += 1
        since = time - setup[AHEAD_S] - periods[due_tick] * PERIOD_S
        share = since / ((periods[due_tick + 1] - periods[due_tick]) * PERIOD_S) if due_tick < k else 0.0
        for i in range(3):
            change = wrap_angle(desired[min(due_tick + 1, k), i] - desired[due_tick, i])
            attitude_error[i] = wrap_angle(desired[due_tick, i] + max(0.0, share) * change - euler[i])
        judge(setup, k, error, attitude_error, rate, terms, step, result)
        if history.shape[0] > 0:
            row = history[k]
            row[0] = time
            row[1:4], row[4:7] = error, attitude_error
            row[7:10], row[10] = terms.euler_setpoint, terms.thrust
            row[11:14], row[14:17] = terms.torque, rate
            row[17:20] = now[k, 0:3] - here[0:3]
        for period in range(periods[k], periods[k + 1]):
            while head < tail and queue[head % QUEUE, 0] <= period:
                apply(queue[head % QUEUE], setpoint)
                head += 1
            if setup[GUST_NEWTON] > 0.0:
                keep = math.exp(-setup[GUST_CORNER] * PERIOD_S)
                for i in range(3):
                    stir = setup[GUST_NEWTON] * math.sqrt(1.0 - keep * keep)
                    push[i] = keep * push[i] + stir * standard_normal(random)
                    environment[FORCE + i] = push[i]
            if setup[PLANT] == LAGGED:
                advance_wind(wind, wind_random, state, environment, PERIOD_S)
                advance_lagged(lagged, state, setpoint, environment, PERIOD_S)
                advance_estimate(
                    estimate, estimator_memory, delay_line, estimator_settings, estimator_random, state
                )
            else:
                fly(
                    state,
                    estimate,
                    estimator_memory,
                    delay_line,
                    estimator_settings,
                    estimator_random,
                    wind,
                    wind_random,
                    setpoint,
                    gains,
                    memory,
                    mixer,
                    columns,
                    scratch,
                    vehicle,
                    environment,
                    PERIOD_S,
                    physics_steps,
                    position_every,
                    True,
                    1,
                )
    result[ENDED_AT] = ended / n
    tracked = max(1.0, ended - setup[TRACK_FROM])
    for i in range(HOLD_SQUARES):
        result[i] /= tracked
