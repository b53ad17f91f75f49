"""Whether a vehicle can fly a trajectory, said before it takes off rather than by its crash.

The trajectory is sampled, what it asks of the vehicle is worked out by flatness, and everything beyond a
limit is listed with its time, its value and the limit. Jumps are found by comparing each value with what
its derivative says it should be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Vector
from companion.reference.flatness import Demand, Motion, demand, sampled
from companion.reference.trajectory import Trajectory

STEP_S = 0.005
MOST_SAMPLES = 120_000
ENDLESS_HORIZON_S = 60.0


@dataclass(frozen=True, slots=True)
class VehicleLimits:
    """What a vehicle can and may do. Heights and fence are in the frame the trajectory is placed in."""

    mass_kg: float
    thrust_min_newton: float
    thrust_max_newton: float
    tilt_max_rad: float
    body_rate_max_rad_s: tuple[float, float, float]  # FLU
    angular_acceleration_max_rad_s2: tuple[float, float, float]  # FLU
    height_min_m: float = -math.inf
    height_max_m: float = math.inf
    fence_radius_m: float = math.inf  # horizontal distance
    fence_centre_m: tuple[float, float] = (0.0, 0.0)
    speed_max_m_s: float = math.inf


@dataclass(frozen=True, slots=True)
class Violation:
    """One limit that a trajectory breaks."""

    what: str
    time_s: float  # where it is worst
    value: float
    limit: float
    unit: str
    first_s: float  # where it is first broken
    below: bool = False  # the limit is a least value
    dynamic: bool = True  # flying slower helps

    def __str__(self) -> str:
        """Say it in one line."""
        relation = "at least" if self.below else "at most"
        since = f", broken from {self.first_s:.2f} s on" if self.first_s < self.time_s - STEP_S else ""
        return (
            f"{self.what} is {self.value:.4g} {self.unit} at {self.time_s:.2f} s; "
            f"{relation} {self.limit:.4g} {self.unit} is possible{since}"
        )


@dataclass(frozen=True, slots=True)
class Feasibility:
    """The result of a check."""

    violations: tuple[Violation, ...]
    peaks: dict[str, float]  # largest values along the way, by name with unit
    slower: (
        float | None
    )  # share of its speed at which the path keeps to the limits; None where that does not help

    @property
    def ok(self) -> bool:
        """Whether the trajectory can be flown."""
        return not self.violations

    def require(self, name: str) -> None:
        """Raise UserError that lists what is wrong with the trajectory called `name`."""
        if self.ok:
            return
        lines = [f"trajectory '{name}' cannot be flown by this vehicle:"]
        lines += [f"  {violation}" for violation in self.violations]
        lines.append(f"  (it asks for up to {self.peaks['acceleration_m_s2']:.4g} m/s²)")
        if self.slower is not None:
            lines.append(f"  flown at {self.slower:.2g} of its speed or less it would be within these limits")
        raise UserError("\n".join(lines))


def check_feasibility(
    trajectory: Trajectory, limits: VehicleLimits, span_s: float | None = None
) -> Feasibility:
    """Check `trajectory`, as placed, over its duration or its first `span_s`.

    An endless trajectory without `span_s` is checked over a minute. Steps of 5 ms; beyond ten minutes they
    are longer, and jumps are looked for in the first ten only. A trajectory with a true `jumps_by_design` is
    not checked for jumps.
    """
    length = trajectory.duration_s if span_s is None else min(span_s, trajectory.duration_s)
    if math.isinf(length):
        length = ENDLESS_HORIZON_S
    count = int(min(max(math.ceil(length / STEP_S), 20), MOST_SAMPLES))
    motion = sampled(trajectory, np.linspace(0.0, length, count + 1))
    if not (np.isfinite(motion.derivatives).all() and np.isfinite(motion.yaw).all()):
        bad = np.isfinite(motion.derivatives).all(axis=(1, 2)) & np.isfinite(motion.yaw).all(axis=1)
        time_s = float(motion.times_s[int(np.argmin(bad))])
        raise UserError(f"the trajectory is not a finite number at {time_s:.3f} s")
    asked = demand(motion, limits.mass_kg)
    violations: list[Violation] = []
    if not getattr(trajectory, "jumps_by_design", False):
        fine = count < MOST_SAMPLES
        beginning = np.linspace(0.0, STEP_S * MOST_SAMPLES, MOST_SAMPLES + 1)
        violations += find_jumps(motion if fine else sampled(trajectory, beginning))
    broken = _broken_limits(motion, asked, limits)
    violations += broken
    slower = None
    if not any(not v.dynamic for v in violations) and broken:
        slower = _slow_enough(motion, limits)
    size = np.linalg.norm(motion.derivatives, axis=2).max(axis=0)
    peaks = {
        "speed_m_s": float(size[1]),
        "acceleration_m_s2": float(size[2]),
        "jerk_m_s3": float(size[3]),
        "thrust_newton": float(asked.thrust_newton.max()),
        "tilt_rad": float(asked.tilt_rad.max()),
        "body_rate_rad_s": float(np.abs(asked.body_rate_flu).max()),
        "angular_acceleration_rad_s2": float(np.abs(asked.angular_acceleration_flu).max()),
    }
    return Feasibility(tuple(violations), peaks, slower)


def _broken_limits(motion: Motion, asked: Demand, limits: VehicleLimits) -> list[Violation]:
    position = motion.derivatives[:, 0]
    distance = np.hypot(position[:, 0] - limits.fence_centre_m[0], position[:, 1] - limits.fence_centre_m[1])
    found = [
        _above(
            motion, "speed", np.linalg.norm(motion.derivatives[:, 1], axis=1), limits.speed_max_m_s, "m/s"
        ),
        _above(motion, "thrust", asked.thrust_newton, limits.thrust_max_newton, "N"),
        _below(motion, "thrust", asked.thrust_newton, limits.thrust_min_newton, "N"),
        _above(motion, "tilt", np.degrees(asked.tilt_rad), math.degrees(limits.tilt_max_rad), "°"),
    ]
    for i, axis in enumerate(("roll", "pitch", "yaw")):
        rate = np.abs(asked.body_rate_flu[:, i])
        found.append(_above(motion, f"{axis} rate", rate, limits.body_rate_max_rad_s[i], "rad/s"))
    for i, axis in enumerate(("roll", "pitch", "yaw")):
        angular = np.abs(asked.angular_acceleration_flu[:, i])
        bound = limits.angular_acceleration_max_rad_s2[i]
        found.append(_above(motion, f"{axis} angular acceleration", angular, bound, "rad/s²"))
    found += [
        _below(motion, "height", position[:, 2], limits.height_min_m, "m", dynamic=False),
        _above(motion, "height", position[:, 2], limits.height_max_m, "m", dynamic=False),
        _above(
            motion, "distance from the fence's centre", distance, limits.fence_radius_m, "m", dynamic=False
        ),
    ]
    return [violation for violation in found if violation is not None]


def _above(
    motion: Motion, what: str, values: Vector, limit: float, unit: str, dynamic: bool = True
) -> Violation | None:
    broken = values > limit + 1e-9 * max(1.0, abs(limit))
    if not broken.any():
        return None
    worst, first = int(np.argmax(values)), int(np.argmax(broken))
    times = motion.times_s
    return Violation(
        what, float(times[worst]), float(values[worst]), limit, unit, float(times[first]), dynamic=dynamic
    )


def _below(
    motion: Motion, what: str, values: Vector, limit: float, unit: str, dynamic: bool = True
) -> Violation | None:
    found = _above(motion, what, -values, -limit, unit, dynamic)
    if found is None:
        return None
    return Violation(what, found.time_s, -found.value, limit, unit, found.first_s, True, dynamic)


def _slow_enough(motion: Motion, limits: VehicleLimits) -> float | None:
    """Share of its speed at which a path keeps to the limits, rounded down; None where none of 1 % or more does."""

    def fits(factor: float) -> bool:
        slowed = motion.sped_up(factor)
        return not _broken_limits(slowed, demand(slowed, limits.mass_kg), limits)

    low, high = 0.0, 1.0
    for _ in range(8):
        middle = (low + high) / 2.0
        low, high = (middle, high) if fits(middle) else (low, middle)
    return math.floor(low * 100.0) / 100.0 if low >= 0.01 else None


_JUMPS = (
    # what, order of the value's derivative, largest change between two samples that its derivatives don't explain
    ("position", 0, 1e-3, "m"),
    ("velocity", 1, 0.02, "m/s"),
    ("acceleration", 2, 0.2, "m/s²"),
)


def find_jumps(motion: Motion) -> list[Violation]:
    """List where position, velocity, acceleration or yaw change by more than their derivatives explain.

    What one step of time changes is compared with the cubic Hermite rule over first and second derivative,
    so that a smooth trajectory leaves nothing. A derivative that belongs to something else shows as well.
    """
    step = np.diff(motion.times_s)[:, None]
    found = []
    for what, order, allowed, unit in _JUMPS:
        value, slope, curvature = np.moveaxis(motion.derivatives[:, order : order + 3], 1, 0)
        size = np.linalg.norm(_unexplained(value, slope, curvature, step), axis=1)
        found.append(_jump(motion, what, size, allowed, unit))
    yaw, rate, acceleration = motion.yaw.T[:, :, None]
    turn = _unexplained(yaw, rate, acceleration, step)[:, 0]
    turn = np.abs(np.remainder(turn + math.pi, math.tau) - math.pi)  # whole turns are no jump
    found.append(_jump(motion, "yaw", turn, 0.005, "rad"))
    return [violation for violation in found if violation is not None]


def _unexplained(value: Vector, slope: Vector, curvature: Vector, step: Vector) -> Vector:
    explained = step * (slope[1:] + slope[:-1]) / 2.0 - step**2 * (curvature[1:] - curvature[:-1]) / 12.0
    return np.diff(value, axis=0) - explained


def _jump(motion: Motion, what: str, size: Vector, allowed: float, unit: str) -> Violation | None:
    broken = size > allowed
    if not broken.any():
        return None
    worst, first = int(np.argmax(size)), int(np.argmax(broken))
    middle = (motion.times_s[1:] + motion.times_s[:-1]) / 2.0
    return Violation(
        f"the jump in {what}",
        float(middle[worst]),
        float(size[worst]),
        allowed,
        unit,
        float(middle[first]),
        dynamic=False,
    )
