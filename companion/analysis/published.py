"""The report's own figures (control_laws.md section 7), to stand beside ours. QBall2, m̂ = 70 % of m."""

from __future__ import annotations

BASELINE = "tlmbc"

PUBLISHED_RMS: dict[str, dict[str, tuple[float, float, float]]] = {
    "tlmbc": {"position_m": (0.0842, 0.0687, 0.0282), "attitude_deg": (1.4972, 1.2705, 0.3655)},
    "nnsmc": {"position_m": (0.0731, 0.0580, 0.0342), "attitude_deg": (1.2835, 1.3375, 0.7915)},
    "dtlannc": {"position_m": (0.0448, 0.0216, 0.0238), "attitude_deg": (1.1505, 1.1638, 0.2834)},
}
"""RMS of e_x, e_y, e_z and of e_φ, e_θ, e_ψ by controller."""

CONTROLLER_ORDER = ("tlmbc", "nnsmc", "dtlannc")
"""The order of the report's columns."""


def improvement_percent(baseline: float, value: float) -> float:
    """P_imp = (RMS(TLMBC) - RMS(ζ)) / RMS(TLMBC) × 100 %; NaN where the baseline is 0."""
    return (baseline - value) / baseline * 100.0 if baseline else float("nan")
