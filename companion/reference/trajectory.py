"""What a trajectory is, and how one is laid out in the world.

A trajectory is a pure function of time: it knows neither the vehicle nor the clock. Its own axes are
ENU-like: z up, metres, yaw counted from its x axis towards its y axis. `place` turns it into the
autopilot's local ENU before the flight.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from companion.control.structs import Reference, Vector


@runtime_checkable
class Trajectory(Protocol):
    """A path in time, with its derivatives up to snap.

    Every implementation keeps to this:

    - `sample` is pure, and cheap enough for the control loop (below 15 µs); derivatives are analytic.
    - For `0 <= time_s <= duration_s` it returns the motion itself; at both ends, the one-sided limit from
      inside, so that a trajectory may begin and end while moving.
    - Before 0 it stands still at its start, after `duration_s` at its end: position and yaw of that end,
      every derivative zero. Where an end is a moving one this is a jump in velocity: the caller changes
      over to the next trajectory at `duration_s`.
    - NaN is refused with ValueError.
    - Yaw may be any representative of its angle (it runs on past ±π instead of jumping). Two trajectories
      flown one after the other may differ by whole turns where they meet: compare yaw only after wrapping.
    - Arrays in the result are new, writable and contiguous, so that compiled laws always see one type.
    """

    @property
    def duration_s(self) -> float:
        """Length in s, above 0; `math.inf` for one that never ends."""
        ...

    def sample(self, time_s: float) -> Reference:
        """Return the reference `time_s` seconds after the trajectory's start."""
        ...


def resting(position: Vector, yaw_rad: float) -> Reference:
    """Return the reference that stands still at `position` (3,) m with `yaw_rad`."""
    return Reference(
        position_enu=np.array(position, dtype=np.float64),
        velocity_enu=np.zeros(3),
        acceleration_enu=np.zeros(3),
        jerk_enu=np.zeros(3),
        snap_enu=np.zeros(3),
        yaw_rad=float(yaw_rad),
        yaw_rate_rad_s=0.0,
        yaw_acceleration_rad_s2=0.0,
    )


def held_outside(trajectory: Trajectory, time_s: float) -> Reference:
    """Return what the protocol asks for outside `[0, duration_s]`: the nearer end, standing still.

    Raises ValueError for NaN.
    """
    if math.isnan(time_s):
        raise ValueError("trajectory sampled at time NaN")
    end = trajectory.sample(0.0 if time_s < 0.0 else trajectory.duration_s)
    return resting(end.position_enu, end.yaw_rad)


def wrapped(angle_rad: float) -> float:
    """Return the angle in [−π, π] that differs from `angle_rad` by whole turns."""
    return math.remainder(angle_rad, math.tau)


class Frame(enum.Enum):
    """Where a trajectory's own axes lie (`--frame`)."""

    TAKEOFF = "takeoff"
    """Origin at the take-off position, x axis along the vehicle's heading at take-off; yaw counts from it."""
    LOCAL = "local"
    """The autopilot's local ENU frame as it is: x east, y north, z up; yaw counts from east."""


@dataclass(frozen=True, slots=True)
class Placed:
    """A trajectory moved to `origin_enu` (3,) m after turning it by `heading_rad` about z."""

    trajectory: Trajectory
    origin_enu: Vector  # (3,) m, where the trajectory's own origin lies in local ENU
    heading_rad: float  # yaw, ENU (0 is east), along which the trajectory's own x axis points
    _origin: tuple[float, float, float]  # `origin_enu` again
    _cosine: float  # of `heading_rad`
    _sine: float

    @property
    def duration_s(self) -> float:
        """Length of the trajectory placed, in s."""
        return self.trajectory.duration_s

    @property
    def jumps_by_design(self) -> bool:
        """Whether the trajectory placed jumps on purpose (see `step.py`)."""
        return bool(getattr(self.trajectory, "jumps_by_design", False))

    def sample(self, time_s: float) -> Reference:
        """Return the reference at `time_s` in local ENU."""
        own = self.trajectory.sample(time_s)
        c, s = self._cosine, self._sine
        x, y, z = own.position_enu.tolist()
        vx, vy, vz = own.velocity_enu.tolist()
        ax, ay, az = own.acceleration_enu.tolist()
        jx, jy, jz = own.jerk_enu.tolist()
        sx, sy, sz = own.snap_enu.tolist()
        x0, y0, z0 = self._origin
        out = np.array(  # numbers, not matrices: three times as quick at this size
            (
                *(c * x - s * y + x0, s * x + c * y + y0, z + z0),
                *(c * vx - s * vy, s * vx + c * vy, vz),
                *(c * ax - s * ay, s * ax + c * ay, az),
                *(c * jx - s * jy, s * jx + c * jy, jz),
                *(c * sx - s * sy, s * sx + c * sy, sz),
            )
        )
        return Reference(
            out[0:3],
            out[3:6],
            out[6:9],
            out[9:12],
            out[12:15],
            own.yaw_rad + self.heading_rad,
            own.yaw_rate_rad_s,
            own.yaw_acceleration_rad_s2,
        )


def placed(trajectory: Trajectory, origin_enu: Vector, heading_rad: float) -> Placed:
    """Lay `trajectory` out with its origin at `origin_enu` (3,) m and its x axis along `heading_rad`.

    `heading_rad` is a yaw in ENU (0 east, π/2 north), not a compass course. A point p of the trajectory
    comes to lie at `origin + R_z(heading) p`, its yaw ψ becomes `ψ + heading`; z stays vertical.
    Raises ValueError where origin or heading are not finite.
    """
    origin = np.array(origin_enu, dtype=np.float64)
    if origin.shape != (3,) or not np.isfinite(origin).all() or not math.isfinite(heading_rad):
        raise ValueError(f"a trajectory cannot be placed at {origin_enu} with heading {heading_rad}")
    x, y, z = origin.tolist()
    return Placed(
        trajectory, origin, float(heading_rad), (x, y, z), math.cos(heading_rad), math.sin(heading_rad)
    )


def place(
    trajectory: Trajectory, frame: Frame, takeoff_position_enu: Vector, takeoff_heading_rad: float
) -> Trajectory:
    """Lay `trajectory` out as `--frame` asks, given where the vehicle stood before take-off (local ENU)."""
    if frame is Frame.LOCAL:
        return trajectory
    return placed(trajectory, takeoff_position_enu, takeoff_heading_rad)


def told_in_flight(trajectory: Trajectory) -> bool:
    """Whether another program tells it while it is flown (`companion.live`): nothing can be said of it before."""
    own = trajectory.trajectory if isinstance(trajectory, Placed) else trajectory
    return bool(getattr(own, "told_in_flight", False))
