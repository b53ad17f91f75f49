"""What the autopilot believes: the true state seen through an estimator that is noisy, late, biased, and can fail.

Each channel (position, velocity, attitude, gyro, accelerometer) carries a second-order Gauss–Markov error (`noise.py`): a
standard deviation per axis and a corner frequency. Such noise is band-limited as the output of a Kalman filter is, so
the inner loops, which run on this same estimate, see no jump from one sample to the next. The velocity error contains
the derivative of the position error, so that position and velocity agree as an estimator's do. Biases of gyro and
accelerometer wander slowly about zero. Position, velocity and attitude are late by the preset's delay; gyro
and accelerometer are not. Everything advances on a grid of fixed period, and the noise depends on the seed and the number
of grid points passed, not on how calls are cut up: the same seed gives the same bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sitl_stub.physics.compiled import compiled
from sitl_stub.physics.noise import (
    MARKOV_SIZE,
    RandomState,
    random_state,
    second_order_markov,
    standard_normal,
    step_markov,
)
from sitl_stub.physics.presets import EstimatorPreset, load_preset
from sitl_stub.physics.vehicle import (
    BODY_RATE,
    MAX_ROTORS,
    POSITION,
    QUATERNION,
    RIGID_SIZE,
    ROTOR_SIGNAL,
    SPECIFIC_FORCE,
    VELOCITY,
    FloatArray,
)

# --- the estimate (ESTIMATE_SIZE,): its first 13 numbers stand where the true state has them ---------------------------
EST_POSITION = 0  # NED, m
EST_VELOCITY = 3  # NED, m/s
EST_QUATERNION = 6  # w x y z, FRD to NED
EST_BODY_RATE = 10  # FRD, rad/s: gyro less what the filter takes for its bias
EST_SPECIFIC_FORCE = 13  # FRD, m/s²: accelerometer
EST_AGE = 16  # s: how old position, velocity and attitude are
EST_POSITION_VALID = 17  # 1.0 or 0.0
EST_ATTITUDE_VALID = 18
EST_POSITION_RESETS = 19  # counts jumps of position and velocity (ODOMETRY.reset_counter)
EST_HEADING_RESETS = 20
ESTIMATE_SIZE = 21

# --- memory -------------------------------------------------------------------------------------------------------------
NOISE_POSITION = 0  # 3 × (x, ẋ/ω), and so on
NOISE_VELOCITY = 6
NOISE_ATTITUDE = 12
NOISE_GYRO = 18
NOISE_ACCELEROMETER = 24
BIAS_GYRO = 30  # in units of its standard deviation
BIAS_ACCELEROMETER = 33
OFFSET_POSITION = 36  # NED, m: what resets have added
OFFSET_HEADING = 39  # rad
DRIFT_POSITION = 40  # NED, m: error gathered while nothing aids the filter
DRIFT_VELOCITY = 43
TIME_UNAIDED = 46  # s
AIDED = 47  # 1.0: position is measured; 0.0: dead reckoning
FROZEN = 48  # 1.0: the estimate stands still and grows old
RING_NEXT = 49
FORCED_INVALID = 50  # 1.0: position flagged invalid whatever it is
STARTED = 51
OFFSET_RATE = 52  # NED m/s (3), heading rad/s: a divergence, position and velocity of which agree
MEMORY_SIZE = 56

# --- settings, packed from the preset -----------------------------------------------------------------------------------
SET_PERIOD = 0
SET_DELAY = 1
SET_SD = 2  # 5 channels × (3,), unit of the channel
SET_SD_THRUSTING = 17  # gyro and accelerometer × (3,), while the rotors turn
SET_BIAS_SD = 23  # gyro, accelerometer
SET_BIAS_DECAY = 25  # per grid step
SET_DRIFT = 26  # m/s²/√Hz, acceleration noise of dead reckoning
SET_TIMEOUT = 27  # s without aiding until position is flagged invalid
SET_CORNER_POSITION = 28  # rad/s
SET_PROCESS = 29  # 5 × MARKOV_SIZE
SETTINGS_SIZE = SET_PROCESS + 5 * MARKOV_SIZE


@dataclass(frozen=True)
class EstimatorArrays:
    """The arrays `advance_estimate` takes, in its order, for firmware that runs it inside its own compiled loop."""

    estimate: FloatArray  # (ESTIMATE_SIZE,)
    memory: FloatArray  # (MEMORY_SIZE,)
    delay_line: FloatArray  # (rows, 13) past true states
    settings: FloatArray  # (SETTINGS_SIZE,)
    random: RandomState  # (4,)


def pack_settings(preset: EstimatorPreset, period_s: float) -> FloatArray:
    """Settings array (SETTINGS_SIZE,) of a preset for a grid of `period_s`."""
    settings = np.zeros(SETTINGS_SIZE)
    settings[SET_PERIOD] = period_s
    settings[SET_DELAY] = preset.delay_s
    channels = (preset.position, preset.velocity, preset.attitude, preset.gyro, preset.accelerometer)
    for i, channel in enumerate(channels):
        settings[SET_SD + 3 * i : SET_SD + 3 * i + 3] = channel.sd
        at = SET_PROCESS + MARKOV_SIZE * i
        settings[at : at + MARKOV_SIZE] = second_order_markov(channel.corner_rad_s, period_s)
    settings[SET_SD_THRUSTING : SET_SD_THRUSTING + 3] = preset.gyro_sd_thrusting
    settings[SET_SD_THRUSTING + 3 : SET_SD_THRUSTING + 6] = preset.accelerometer_sd_thrusting
    settings[SET_BIAS_SD] = preset.gyro_bias_sd
    settings[SET_BIAS_SD + 1] = preset.accelerometer_bias_sd
    settings[SET_BIAS_DECAY] = math.exp(-period_s / preset.bias_correlation_s)
    settings[SET_DRIFT] = preset.drift_m_s2_per_sqrt_hz
    settings[SET_TIMEOUT] = preset.position_timeout_s
    settings[SET_CORNER_POSITION] = preset.position.corner_rad_s
    return settings


@compiled
def move_errors(memory: FloatArray, settings: FloatArray, random: RandomState) -> None:
    """One grid step of every error process. Draws the same number of random numbers whatever the preset or the faults."""
    for channel in range(5):
        for axis in range(3):
            step_markov(memory, 6 * channel + 2 * axis, settings, SET_PROCESS + MARKOV_SIZE * channel, random)
    keep = settings[SET_BIAS_DECAY]
    stir = math.sqrt(max(1.0 - keep * keep, 0.0))
    for j in range(6):
        memory[BIAS_GYRO + j] = keep * memory[BIAS_GYRO + j] + stir * standard_normal(random)
    period = settings[SET_PERIOD]
    for j in range(3):
        kick = settings[SET_DRIFT] * math.sqrt(period) * standard_normal(random)
        if memory[AIDED] == 0.0:
            memory[DRIFT_POSITION + j] += period * memory[DRIFT_VELOCITY + j]
            memory[DRIFT_VELOCITY + j] += kick
    for j in range(3):
        memory[OFFSET_POSITION + j] += period * memory[OFFSET_RATE + j]
    memory[OFFSET_HEADING] += period * memory[OFFSET_RATE + 3]
    memory[TIME_UNAIDED] = 0.0 if memory[AIDED] > 0.0 else memory[TIME_UNAIDED] + period


@compiled
def start_errors(memory: FloatArray, random: RandomState) -> None:
    """Draw every error process from its stationary distribution, so that the statistics hold from the first sample."""
    for j in range(BIAS_ACCELEROMETER + 3):
        memory[j] = standard_normal(random)


@compiled
def remember_truth(delay_line: FloatArray, memory: FloatArray, state: FloatArray) -> None:
    """Put the true state into the ring; the very first one fills it whole."""
    rows = delay_line.shape[0]
    if memory[STARTED] == 0.0:
        for row in range(rows):
            for j in range(RIGID_SIZE):
                delay_line[row, j] = state[j]
        memory[STARTED] = 1.0
        memory[RING_NEXT] = 0.0
    at = int(memory[RING_NEXT])
    for j in range(RIGID_SIZE):
        delay_line[at, j] = state[j]
    memory[RING_NEXT] = float((at + 1) % rows)


@compiled
def advance_estimate(
    estimate: FloatArray,
    memory: FloatArray,
    delay_line: FloatArray,
    settings: FloatArray,
    random: RandomState,
    state: FloatArray,
) -> None:
    """One grid step: take in the true `state` (STATE_SIZE,) of now and write what the autopilot believes now, in place."""
    if memory[STARTED] == 0.0:
        start_errors(memory, random)
    remember_truth(delay_line, memory, state)
    move_errors(memory, settings, random)
    if memory[FROZEN] > 0.0:
        estimate[EST_AGE] += settings[SET_PERIOD]
        return

    rows = delay_line.shape[0]
    steps = settings[SET_DELAY] / settings[SET_PERIOD]
    whole = int(steps)
    part = steps - whole
    newest = int(memory[RING_NEXT]) - 1 + 2 * rows
    young, old = (newest - whole) % rows, (newest - whole - 1) % rows

    corner = settings[SET_CORNER_POSITION]
    for j in range(3):
        position = (1.0 - part) * delay_line[young, POSITION + j] + part * delay_line[old, POSITION + j]
        velocity = (1.0 - part) * delay_line[young, VELOCITY + j] + part * delay_line[old, VELOCITY + j]
        wander = settings[SET_SD + j]
        estimate[EST_POSITION + j] = (
            position
            + wander * memory[NOISE_POSITION + 2 * j]
            + memory[OFFSET_POSITION + j]
            + memory[DRIFT_POSITION + j]
        )
        estimate[EST_VELOCITY + j] = (
            velocity
            + wander * corner * memory[NOISE_POSITION + 2 * j + 1]
            + settings[SET_SD + 3 + j] * memory[NOISE_VELOCITY + 2 * j]
            + memory[DRIFT_VELOCITY + j]
            + memory[OFFSET_RATE + j]
        )

    # attitude: heading offset about world down on the left, small error in the body on the right
    w = (1.0 - part) * delay_line[young, QUATERNION] + part * delay_line[old, QUATERNION]
    x = (1.0 - part) * delay_line[young, QUATERNION + 1] + part * delay_line[old, QUATERNION + 1]
    y = (1.0 - part) * delay_line[young, QUATERNION + 2] + part * delay_line[old, QUATERNION + 2]
    z = (1.0 - part) * delay_line[young, QUATERNION + 3] + part * delay_line[old, QUATERNION + 3]
    ex = 0.5 * settings[SET_SD + 6] * memory[NOISE_ATTITUDE]
    ey = 0.5 * settings[SET_SD + 7] * memory[NOISE_ATTITUDE + 2]
    ez = 0.5 * settings[SET_SD + 8] * memory[NOISE_ATTITUDE + 4]
    w, x, y, z = (
        w - x * ex - y * ey - z * ez,
        w * ex + x + y * ez - z * ey,
        w * ey - x * ez + y + z * ex,
        w * ez + x * ey - y * ex + z,
    )
    c, s = math.cos(0.5 * memory[OFFSET_HEADING]), math.sin(0.5 * memory[OFFSET_HEADING])
    w, x, y, z = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    estimate[EST_QUATERNION] = w * scale
    estimate[EST_QUATERNION + 1] = x * scale
    estimate[EST_QUATERNION + 2] = y * scale
    estimate[EST_QUATERNION + 3] = z * scale

    turning = 0.0
    for i in range(MAX_ROTORS):
        turning = max(turning, state[ROTOR_SIGNAL + i])
    turning = min(turning / 0.1, 1.0)  # vibration sets in between stopped and a tenth of full signal
    for j in range(3):
        gyro = settings[SET_SD + 9 + j]
        gyro += turning * (settings[SET_SD_THRUSTING + j] - gyro)
        accelerometer = settings[SET_SD + 12 + j]
        accelerometer += turning * (settings[SET_SD_THRUSTING + 3 + j] - accelerometer)
        estimate[EST_BODY_RATE + j] = (
            state[BODY_RATE + j]
            + gyro * memory[NOISE_GYRO + 2 * j]
            + settings[SET_BIAS_SD] * memory[BIAS_GYRO + j]
        )
        estimate[EST_SPECIFIC_FORCE + j] = (
            state[SPECIFIC_FORCE + j]
            + accelerometer * memory[NOISE_ACCELEROMETER + 2 * j]
            + settings[SET_BIAS_SD + 1] * memory[BIAS_ACCELEROMETER + j]
        )
    estimate[EST_AGE] = settings[SET_DELAY]
    lost = memory[TIME_UNAIDED] > settings[SET_TIMEOUT] or memory[FORCED_INVALID] > 0.0
    estimate[EST_POSITION_VALID] = 0.0 if lost else 1.0
    estimate[EST_ATTITUDE_VALID] = 1.0


class Estimate:
    """Named view of the estimate array: reading it always gives the newest values (copies are the reader's business)."""

    def __init__(self, array: FloatArray) -> None:
        self.array = array

    @property
    def position_ned(self) -> FloatArray:
        """(3,) m."""
        return self.array[EST_POSITION : EST_POSITION + 3]

    @property
    def velocity_ned(self) -> FloatArray:
        """(3,) m/s."""
        return self.array[EST_VELOCITY : EST_VELOCITY + 3]

    @property
    def quaternion_wxyz(self) -> FloatArray:
        """(4,) body FRD to NED."""
        return self.array[EST_QUATERNION : EST_QUATERNION + 4]

    @property
    def body_rate_frd(self) -> FloatArray:
        """(3,) rad/s."""
        return self.array[EST_BODY_RATE : EST_BODY_RATE + 3]

    @property
    def acceleration_frd(self) -> FloatArray:
        """(3,) m/s², specific force: (0, 0, −g) on the ground."""
        return self.array[EST_SPECIFIC_FORCE : EST_SPECIFIC_FORCE + 3]

    @property
    def age_s(self) -> float:
        """How old position, velocity and attitude are."""
        return float(self.array[EST_AGE])

    @property
    def position_valid(self) -> bool:
        """Whether the filter vouches for position and velocity."""
        return bool(self.array[EST_POSITION_VALID] > 0.0)

    @property
    def attitude_valid(self) -> bool:
        """Whether the filter vouches for attitude."""
        return bool(self.array[EST_ATTITUDE_VALID] > 0.0)

    @property
    def position_resets(self) -> int:
        """How often position and velocity have jumped (ODOMETRY.reset_counter counts modulo 256)."""
        return int(self.array[EST_POSITION_RESETS])

    @property
    def heading_resets(self) -> int:
        """How often the heading has jumped."""
        return int(self.array[EST_HEADING_RESETS])


class Estimator:
    """An autopilot's estimator on a fixed grid, with its faults.

    `preset` is a name (`mocap`, `gps`, `perfect`) or an `EstimatorPreset`; `period_s` the grid, 250 Hz by default.
    `update` runs it from Python; compiled firmware calls `advance_estimate(*estimator.arguments, state)` once a grid step.
    """

    def __init__(
        self, preset: str | EstimatorPreset = "mocap", seed: int = 0, period_s: float = 0.004
    ) -> None:
        self.preset = load_preset(preset) if isinstance(preset, str) else preset
        self.period_s = period_s
        rows = math.floor(self.preset.delay_s / period_s) + 2
        self.arrays = EstimatorArrays(
            np.zeros(ESTIMATE_SIZE),
            np.zeros(MEMORY_SIZE),
            np.zeros((rows, RIGID_SIZE)),
            pack_settings(self.preset, period_s),
            random_state(seed, stream=1),
        )
        self.arrays.memory[AIDED] = 1.0
        self.arrays.estimate[EST_QUATERNION] = 1.0
        self.estimate = Estimate(self.arrays.estimate)
        self._grid_points = 0

    @property
    def arguments(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, RandomState]:
        """The first five arguments of `advance_estimate`."""
        a = self.arrays
        return a.estimate, a.memory, a.delay_line, a.settings, a.random

    def update(self, time_s: float, true_state: FloatArray) -> Estimate:
        """Bring the estimate up to `time_s` (simulated, from 0) with the true state of that time.

        Does as many grid steps as lie between the last call and this one, none if the next is not due yet.
        """
        due = math.floor(time_s / self.period_s + 1e-6) + 1
        while self._grid_points < due:
            advance_estimate(*self.arguments, true_state)
            self._grid_points += 1
        return self.estimate

    def set_aided(self, aided: bool) -> None:
        """Take position measurements away (the error then drifts, and is flagged after a while) or give them back.

        Given back, the drift is taken out in one jump, with a reset counted.
        """
        memory = self.arrays.memory
        if aided and memory[AIDED] == 0.0:
            memory[DRIFT_POSITION : DRIFT_POSITION + 3] = 0.0
            memory[DRIFT_VELOCITY : DRIFT_VELOCITY + 3] = 0.0
            memory[TIME_UNAIDED] = 0.0
            self.arrays.estimate[EST_POSITION_RESETS] += 1.0
        memory[AIDED] = float(aided)

    def set_frozen(self, frozen: bool) -> None:
        """Hold the estimate still while its age grows: a drop-out of the whole estimator."""
        self.arrays.memory[FROZEN] = float(frozen)

    def set_position_invalid(self, invalid: bool) -> None:
        """Flag position invalid although it is what it was."""
        self.arrays.memory[FORCED_INVALID] = float(invalid)

    def diverge(self, velocity_ned: tuple[float, float, float], heading_rate_rad_s: float) -> None:
        """Let the error of position and heading grow by so much more each second, on top of what it grows already.

        The estimated velocity shows it; the flags do not. Negative numbers take it back: what has grown stays.
        """
        self.arrays.memory[OFFSET_RATE : OFFSET_RATE + 3] += velocity_ned
        self.arrays.memory[OFFSET_RATE + 3] += heading_rate_rad_s

    def reset_position(self, jump_ned: tuple[float, float, float]) -> None:
        """Let the estimated position jump by `jump_ned` m for good, and count a reset."""
        self.arrays.memory[OFFSET_POSITION : OFFSET_POSITION + 3] += jump_ned
        self.arrays.estimate[EST_POSITION_RESETS] += 1.0

    def reset_heading(self, jump_rad: float) -> None:
        """Let the estimated heading jump by `jump_rad` (clockwise from above) for good, and count a reset."""
        self.arrays.memory[OFFSET_HEADING] += jump_rad
        self.arrays.estimate[EST_HEADING_RESETS] += 1.0
