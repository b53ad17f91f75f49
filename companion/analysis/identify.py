"""How the autopilot's own loops follow our setpoints, read off a flight: dead time, natural frequency, damping.

The model is the profile's: y(t) follows the setpoint of `dead_time` ago like ω²/(s² + 2ζωs + ω²) (attitude level),
like 1/(lag s + 1) (body rates). It is fitted to roll, pitch and yaw of the estimate by Levenberg–Marquardt from several
starting points, each axis with an offset of its own. The result goes into a profile's `[responses.…]`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.analysis.rotation import euler_from_quaternions
from companion.config.errors import UserError
from companion.control.compiled import compiled
from companion.control.structs import Vector
from companion.flightlog.reader import FlightRecord

STEP_S = 0.004
SETTLING_S = 1.0
"""Left out of the fit at the start: what the vehicle did before is not known."""
LEAST_MOTION_RAD = 0.01
"""Standard deviation of a setpoint below which its axis tells nothing."""
LONGEST_GAP_S = 0.25
VAGUE = 0.2
"""Relative deviation of a natural frequency above which it is not to be relied on."""
_STARTS = ((0.03, 8.0, 0.7), (0.06, 12.0, 0.9), (0.1, 5.0, 0.6))


@dataclass(frozen=True, slots=True)
class AxisResponse:
    """One axis' response. `spread` are standard deviations of the three numbers, as the fit's residuals suggest."""

    axis: str  # roll, pitch or yaw
    dead_time_s: float
    natural_frequency_rad_s: float  # of a rate's first-order response: 1/lag, and damping is nan
    damping: float
    explained: float  # share of the motion's variance, 0..1
    spread: tuple[float, float, float]

    @property
    def lag_s(self) -> float:
        """Dead time and lag behind a ramp together, s: what a sine far below ω is late by."""
        if math.isnan(self.damping):
            return self.dead_time_s + 1.0 / self.natural_frequency_rad_s
        return self.dead_time_s + 2.0 * self.damping / self.natural_frequency_rad_s


@compiled
def second_order(
    command: Vector, dead_time: float, omega: float, zeta: float, first: float, dt: float
) -> Vector:
    """Response (n,) to `command` (n,) sampled every `dt` s, held; starts at rest at `first`. Exact to dt²."""
    out = np.empty(command.size)
    x, v = first, 0.0
    shift = dead_time / dt
    for k in range(command.size):
        out[k] = x
        position = max(k - shift, 0.0)
        low = int(position)
        high = min(low + 1, command.size - 1)
        wanted = command[low] + (position - low) * (command[high] - command[low])
        for _ in range(2):
            half = 0.5 * dt
            acceleration = omega * omega * (wanted - x) - 2.0 * zeta * omega * v
            middle_x, middle_v = x + 0.5 * half * v, v + 0.5 * half * acceleration
            x += half * middle_v
            v += half * (omega * omega * (wanted - middle_x) - 2.0 * zeta * omega * middle_v)
    return out


@compiled
def first_order(command: Vector, dead_time: float, bandwidth: float, first: float, dt: float) -> Vector:
    """Response (n,) of 1/(s/bandwidth + 1) to `command` (n,) of `dead_time` ago, s and rad/s."""
    out = np.empty(command.size)
    x = first
    shift = dead_time / dt
    share = -math.expm1(-bandwidth * dt)
    for k in range(command.size):
        out[k] = x
        position = max(k - shift, 0.0)
        low = int(position)
        high = min(low + 1, command.size - 1)
        x += share * (command[low] + (position - low) * (command[high] - command[low]) - x)
    return out


def identify(record: FlightRecord) -> list[AxisResponse]:
    """Fit every axis that moved enough.

    Raises:
        UserError: the flight holds no stretch that says anything.
    """
    setpoint, state = record.channel("/setpoint"), record.channel("/state")
    if setpoint is None or state is None:
        raise UserError(f"{record.path}: holds no setpoints or no states; identify needs a flight")
    level = record.flight.get("level", "attitude")
    if level not in ("attitude", "body_rate"):
        raise UserError(f"{record.path}: level {level} has no loop of the autopilot's to identify")
    flown = _longest_stretch(record, setpoint.time_s)
    time_s = np.arange(flown[0], flown[1], STEP_S)
    if time_s.size * STEP_S < 2.0 * SETTLING_S:
        raise UserError(f"{record.path}: only {time_s.size * STEP_S:.1f} s of control; fly longer")
    if level == "attitude":
        asked = np.unwrap(euler_from_quaternions(setpoint["quaternion_wxyz"]), axis=0)
        was = np.unwrap(euler_from_quaternions(state["quaternion_wxyz"]), axis=0)
    else:
        asked, was = setpoint["body_rate_flu"], state["body_rate_flu"]
    held = np.clip(np.searchsorted(setpoint.time_s, time_s, side="right") - 1, 0, None)
    found = []
    for i, axis in enumerate(("roll", "pitch", "yaw")):
        command, motion = asked[held, i], np.interp(time_s, state.time_s, was[:, i])
        if level == "attitude":  # which turn of 2π each began at is of no meaning
            motion = motion - 2.0 * math.pi * np.round(np.mean(motion - command) / (2.0 * math.pi))
        if np.std(command) < LEAST_MOTION_RAD:
            continue
        found.append(_fit(axis, np.ascontiguousarray(command), motion, level == "attitude"))
    if not found:
        raise UserError(
            f"{record.path}: no axis moved more than {math.degrees(LEAST_MOTION_RAD):.1f}°; "
            "fly the lemniscate, or --trajectory step"
        )
    return found


def _longest_stretch(record: FlightRecord, time_s: Vector) -> tuple[float, float]:
    """From the moment the law took over until setpoints stopped."""
    begun = [e.time_s for e in record.events_of("phase") if e.fields.get("phase") == "climb"]
    start_s = begun[0] if begun else float(time_s[0])
    times = time_s[time_s >= start_s]
    gaps = np.flatnonzero(np.diff(times) > LONGEST_GAP_S)
    end_s = float(times[gaps[0]]) if gaps.size else (float(times[-1]) if times.size else start_s)
    return start_s, end_s


def _fit(axis: str, command: Vector, motion: Vector, is_attitude: bool) -> AxisResponse:
    skip = round(SETTLING_S / STEP_S)

    def residual(p: Vector) -> Vector:
        dead, rate = abs(float(p[0])), math.exp(float(p[1]))
        if is_attitude:
            model = second_order(command, dead, rate, math.exp(float(p[2])), float(motion[0]), STEP_S)
        else:
            model = first_order(command, dead, rate, float(motion[0]), STEP_S)
        error = model[skip:] - motion[skip:]
        return np.asarray(error - error.mean())

    count = 3 if is_attitude else 2
    starts = [np.array([d, math.log(w), math.log(z)])[:count] for d, w, z in _STARTS]
    best, jacobian = min(
        (_levenberg_marquardt(residual, s) for s in starts), key=lambda r: float(np.sum(residual(r[0]) ** 2))
    )
    error = residual(best)
    variance = float(np.mean(error**2))
    # neighbours in time are not independent: count one sample for each 0.1 s
    effective = max(1.0, error.size * STEP_S / 0.1)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance * error.size / effective
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rate = math.exp(best[1])
    damping = math.exp(best[2]) if is_attitude else math.nan
    return AxisResponse(
        axis,
        abs(float(best[0])),
        rate,
        damping,
        1.0 - variance / float(np.var(motion[skip:])),
        (
            float(deviation[0]),
            rate * float(deviation[1]),
            damping * float(deviation[2]) if is_attitude else math.nan,
        ),
    )


def _levenberg_marquardt(residual: Callable[[Vector], Vector], start: Vector) -> tuple[Vector, Vector]:
    """Minimum of ‖residual‖² near `start`, and the Jacobian there."""
    point, damping = start.copy(), 1e-2
    error = residual(point)
    jacobian = _jacobian(residual, point, error)
    for _ in range(60):
        normal = jacobian.T @ jacobian
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -jacobian.T @ error)
        trial = point + np.clip(step, -0.5, 0.5)
        trial_error = residual(trial)
        with np.errstate(over="ignore", invalid="ignore"):  # of a trial that ran away
            better = trial_error @ trial_error < error @ error
        if better:
            done = float(np.max(np.abs(trial - point))) < 1e-5
            point, error, damping = trial, trial_error, damping * 0.3
            jacobian = _jacobian(residual, point, error)
            if done:
                break
        else:
            damping *= 4.0
            if damping > 1e8:
                break
    return point, jacobian


def _jacobian(residual: Callable[[Vector], Vector], point: Vector, error: Vector) -> Vector:
    columns = []
    for i in range(point.size):
        moved = point.copy()
        moved[i] += 1e-4
        columns.append((residual(moved) - error) / 1e-4)
    return np.column_stack(columns)


def profile_lines(found: list[AxisResponse], autopilot: str) -> str:
    """The result as TOML for a vehicle profile: roll and pitch averaged as `tilt`, the better known one counting more."""
    tilt = [r for r in found if r.axis != "yaw"]
    lines = [f"[responses.{autopilot}]"]
    vague = [r for r in found if r.spread[1] > VAGUE * r.natural_frequency_rad_s]
    if vague:
        lines.append(
            f"# {', '.join(r.axis for r in vague)}: too little motion to tell dead time and lag apart; their sum "
            f"({', '.join(f'{r.lag_s * 1e3:.0f} ms' for r in vague)}) holds. Fly --trajectory step for better ones."
        )
    if tilt and not math.isnan(tilt[0].damping):
        # each axis counts by how well its own frequency is known
        weights = [1.0 / max(r.spread[1] / r.natural_frequency_rad_s, 1e-3) ** 2 for r in tilt]
        dead, omega, zeta = np.average(
            [(r.dead_time_s, r.natural_frequency_rad_s, r.damping) for r in tilt], axis=0, weights=weights
        )
        lines.append(f"dead_time_s = {dead:.3f}")
        lines.append(f"tilt = {{ natural_frequency_rad_s = {omega:.1f}, damping = {zeta:.2f} }}")
    elif tilt:
        lines.append(f"rate_dead_time_s = {np.mean([r.dead_time_s for r in tilt]):.3f}")
        lags = {r.axis: 1.0 / r.natural_frequency_rad_s for r in found}
        lines.append("# rate_lag_s: " + ", ".join(f"{axis} {lag:.3f}" for axis, lag in lags.items()))
    for r in found:
        if r.axis == "yaw" and not math.isnan(r.damping):
            lines.append(
                f"yaw = {{ natural_frequency_rad_s = {r.natural_frequency_rad_s:.1f}, damping = {r.damping:.2f} }}"
            )
    return "\n".join(lines)
