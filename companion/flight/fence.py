"""Distances to the fence: how far inside a point is, horizontally; negative outside."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.config.safety import Fence, Reaction, SafetyLimits
from companion.control.structs import Vector
from companion.flight.outcome import Refused
from companion.flight.plan import FlightPlan
from companion.reference.trajectory import told_in_flight

PLAN_STEP_S = 0.05


def horizontal_margin(fence: Fence, east_m: float, north_m: float) -> float:
    """Distance in m from a point, given from the place of take-off, to the fence; negative outside."""
    if fence.shape == "cylinder":
        return fence.radius_m - math.hypot(east_m, north_m)
    if fence.shape == "box":
        west, south, east, north = fence.box_m
        dx, dy = max(west - east_m, east_m - east), max(south - north_m, north_m - north)
        if dx > 0.0 or dy > 0.0:
            return -math.hypot(max(dx, 0.0), max(dy, 0.0))
        return -max(dx, dy)
    return _polygon_margin(fence.polygon_m, east_m, north_m)


def _polygon_margin(corners: tuple[tuple[float, float], ...], x: float, y: float) -> float:
    nearest, inside = math.inf, False
    ax, ay = corners[-1]
    for bx, by in corners:
        ex, ey = bx - ax, by - ay
        length2 = ex * ex + ey * ey
        along = 0.0 if length2 == 0.0 else max(0.0, min(1.0, ((x - ax) * ex + (y - ay) * ey) / length2))
        nearest = min(nearest, math.hypot(x - ax - along * ex, y - ay - along * ey))
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (
            bx - ax
        ):  # a ray to the east crosses this side
            inside = not inside
        ax, ay = bx, by
    return nearest if inside else -nearest


@dataclass(frozen=True, slots=True)
class PlanMargins:
    """The least margins a plan leaves, and when."""

    horizontal_m: float
    ceiling_m: float
    time_s: float  # of the smaller of the two


def plan_margins(fence: Fence, plan: FlightPlan, home_enu: Vector) -> PlanMargins:
    """Sample a plan and measure it against the fence about `home_enu` (3,)."""
    worst = PlanMargins(math.inf, math.inf, 0.0)
    times = np.arange(0.0, plan.duration_s + PLAN_STEP_S, PLAN_STEP_S)
    for leg in plan.legs:
        if told_in_flight(leg.trajectory):  # what comes is checked as it comes; so far it stands still
            times = times[(times <= leg.start_s) | (times >= leg.start_s + leg.duration_s)]
    for time_s in times:
        east, north, up = (plan.sample(float(time_s)).position_enu - home_enu).tolist()
        horizontal, ceiling = horizontal_margin(fence, east, north), fence.height_max_m - up
        least = min(horizontal, ceiling)
        first = least < min(worst.horizontal_m, worst.ceiling_m)
        worst = PlanMargins(
            min(horizontal, worst.horizontal_m),
            min(ceiling, worst.ceiling_m),
            float(time_s) if first else worst.time_s,
        )
    return worst


def require_inside(limits: SafetyLimits, plan: FlightPlan, home_enu: Vector) -> None:
    """Refuse a plan that comes to where a reaction from HOLD on would follow.

    Raises:
        Refused: says where, when and what to change.
    """
    margins = plan_margins(limits.fence, plan, home_enu)
    for name, margin_m, setting in (
        ("fence_margin_m", margins.horizontal_m, "flight.safety.fence"),
        ("ceiling_margin_m", margins.ceiling_m, "flight.safety.fence.height_max_m"),
    ):
        needed = max(
            (at for reaction, at, _ in limits.ladder(name).rungs() if reaction >= Reaction.HOLD), default=0.0
        )
        if margin_m < needed:
            raise Refused(
                f"the plan leaves {margin_m:.2f} m to the fence {margins.time_s:.1f} s after lift-off, "
                f"{name} asks for {needed:g} m: fly a smaller trajectory, or widen {setting}"
            )
