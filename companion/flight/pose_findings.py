"""What `check` and `fly` say of poses from outside, before anything is armed."""

from __future__ import annotations

from companion.autopilot.adapter import Finding, Verdict
from companion.flight.one_world import (
    HEADING_WARNED_DEG,
    HEADING_WRONG_DEG,
    MOTION_WARNED,
    MOTION_WRONG,
    TILT_WARNED_DEG,
    TILT_WRONG_DEG,
    PoseFigures,
)
from companion.mavlink.outside_poses import OutsidePoses


def pose_findings(poses: OutsidePoses, figures: PoseFigures | None, used: bool | None) -> list[Finding]:
    """Judge poses from outside.

    Args:
        poses: where they are heard.
        figures: how they stand to the estimate; None while there are none, or no estimate.
        used: whether the estimator takes anything from them; where it does not, a wrong frame is a warning.
    """
    dropped = ", ".join(
        f"{count} {what}" for what, count in sorted(poses.counters.items()) if what.startswith("pose ")
    )
    sent = poses.counters["forwarded"]
    arrival = Finding(
        Verdict.OK if sent else Verdict.WARNING,
        "poses from outside",
        f"{sent} forwarded" + (f" ({dropped})" if dropped else ""),
        "" if sent else "the estimator gets nothing from them",
        "" if sent else f"is the source running, and does it send to port {poses.address[1]}?",
    )
    fusion = []
    if used is False:
        fusion.append(
            Finding(
                Verdict.WARNING,
                "use of poses",
                "none",
                "the autopilot's parameters take nothing from ODOMETRY, so the poses change nothing",
                "set them as docs/links.md says, or fly without --outside-poses",
            )
        )
    if figures is None:
        return [arrival, *fusion]
    remedy = (
        figures.looks_like
        or "compare the source's axes with docs/frames.md: x east, y north, z up; forward, left, up"
    )
    by_pose_m, by_estimate_m = figures.moved_m
    still = "neither moves" if figures.motion is None else f"{figures.motion:.2f}"
    return [
        arrival,
        *fusion,
        _judged(
            figures.tilt_deg,
            (TILT_WARNED_DEG, TILT_WRONG_DEG),
            "tilt of poses",
            f"{figures.tilt_deg:.0f}° from the autopilot's own",
            "the autopilot knows gravity by itself: the body's axes, or the world's, are others than it takes them for",
            remedy,
            used,
        ),
        _judged(
            abs(figures.heading_deg),
            (HEADING_WARNED_DEG, HEADING_WRONG_DEG),
            "heading of poses",
            f"{figures.heading_deg:+.0f}° from the autopilot's",
            "positions corrected along turned axes drive the vehicle round in growing circles",
            remedy,
            used,
        ),
        _judged(
            figures.motion or 0.0,
            (MOTION_WARNED, MOTION_WRONG),
            "movement of poses",
            f"{by_pose_m:.3g} m within 1 s, by the autopilot {by_estimate_m:.3g} m (difference {still})"
            if figures.motion is not None
            else still,
            "poses that go elsewhere, or farther, than the vehicle steer it wrongly",
            remedy,
            used,
        ),
    ]


def _judged(
    value: float,
    limits: tuple[float, float],
    subject: str,
    found: str,
    why: str,
    remedy: str,
    used: bool | None,
) -> Finding:
    warned, wrong = limits
    if value <= warned:
        return Finding(Verdict.OK, subject, found)
    harmless = used is False or value <= wrong
    return Finding(Verdict.WARNING if harmless else Verdict.REFUSAL, subject, found, why, remedy)
