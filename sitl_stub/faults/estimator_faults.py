"""Faults of what the autopilot believes: jumps, drifts, lost flags, lost GPS."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sitl_stub.faults.fault import Effect, Fault, Site, hold, number, switch


def _metres(default: float, axis: str) -> float:
    chosen: float = number(default, "m", f"jump {axis}", -1000.0, 1000.0)
    return chosen


def _metres_per_second(default: float, axis: str) -> float:
    chosen: float = number(default, "m/s", f"speed of the error {axis}", -20.0, 20.0)
    return chosen


@dataclass(frozen=True)
class EstimatorReset(Fault):
    """The estimate of position and heading jumps for good; PX4's ODOMETRY counts it, ArduPilot tells of none."""

    kind = "estimator_reset"
    momentary = True
    north_m: float = _metres(1.0, "north")
    east_m: float = _metres(0.0, "east")
    down_m: float = _metres(0.0, "down")
    yaw_deg: float = number(0.0, "deg", "jump of the heading, clockwise", -180.0, 180.0)

    def act(self, site: Site) -> Effect:
        """Let it jump."""
        jump = (self.north_m, self.east_m, self.down_m)
        yaw = math.radians(self.yaw_deg)
        estimator = site.autopilot.core.estimator
        if any(jump):
            estimator.reset_position(jump)
        if yaw:
            estimator.reset_heading(yaw)
        site.autopilot.estimate_jumped(jump, yaw)
        yield from ()


@dataclass(frozen=True)
class EstimatorDivergence(Fault):
    """The estimate drifts away with a velocity that agrees, while its flags stay good."""

    kind = "estimator_divergence"
    north_m_s: float = _metres_per_second(0.5, "north")
    east_m_s: float = _metres_per_second(0.0, "east")
    down_m_s: float = _metres_per_second(0.0, "down")
    yaw_deg_s: float = number(0.0, "deg/s", "turn of the heading's error, clockwise", -90.0, 90.0)
    recovers: bool = switch(True, "at the end the error goes, with a reset; false: it stays")

    def act(self, site: Site) -> Effect:
        """Let the error grow."""
        velocity = (self.north_m_s, self.east_m_s, self.down_m_s)
        rate = math.radians(self.yaw_deg_s)
        estimator = site.autopilot.core.estimator
        estimator.diverge(velocity, rate)
        try:
            yield from hold()
        finally:
            estimator.diverge((-velocity[0], -velocity[1], -velocity[2]), -rate)
            if self.recovers:
                grown = -site.elapsed_s
                back = (velocity[0] * grown, velocity[1] * grown, velocity[2] * grown)
                estimator.reset_position(back)
                if rate:
                    estimator.reset_heading(rate * grown)
                site.autopilot.estimate_jumped(back, rate * grown)


@dataclass(frozen=True)
class EstimatorInvalid(Fault):
    """The estimator withdraws position and velocity: flags in ESTIMATOR_STATUS, EKF_STATUS_REPORT."""

    kind = "estimator_invalid"

    def act(self, site: Site) -> Effect:
        """Take the flags away."""
        estimator = site.autopilot.core.estimator

        def flag(good: float) -> None:
            estimator.set_position_invalid(good < 1.0)

        with site.setting("position flag", 0.0, flag, otherwise=1.0):
            yield from hold()


@dataclass(frozen=True)
class GpsLoss(Fault):
    """Position is measured no more (GPS, or motion capture): the estimate drifts, after 5 s its flags go."""

    kind = "gps_loss"

    def act(self, site: Site) -> Effect:
        """Take the measurements away."""
        estimator = site.autopilot.core.estimator

        def aid(given: float) -> None:
            if (given > 0.0) != site.autopilot.core.position_aided:
                estimator.set_aided(given > 0.0)

        with site.setting("aiding", 0.0, aid, otherwise=1.0):
            yield from hold()
