"""A companion-computer flight controller for PX4 and ArduPilot: what a notebook or a script of one's own needs.

    import companion

    flown = companion.fly(sitl="px4", controller="dtlannc", duration_s=20)    # or endpoint="udpin:0.0.0.0:14540"
    print(flown.outcome, flown.text)
    metrics = companion.analyze(flown.log)
    print(metrics.get("rms", "position_truth_m"))                             # (x, y, z) in m

Names are loaded when they are first used, so importing the package costs nothing. Everything else is internal.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from companion.analysis.comparison import Comparison
    from companion.analysis.metrics import FlightMetrics
    from companion.analysis.replay import Replay
    from companion.config.errors import UserError
    from companion.config.settings import Settings, load_settings
    from companion.control.law import ControlLaw
    from companion.control.laws import register_law
    from companion.control.registry import build_law
    from companion.flight.outcome import Outcome
    from companion.flightlog.reader import FlightRecord, read_log
    from companion.front_door import Checked, Flown, analyze, check, compare, fly, replay
    from companion.reference.registry import trajectory_from_text as trajectory

_HOMES = {
    "Checked": "front_door",
    "Comparison": "analysis.comparison",
    "ControlLaw": "control.law",
    "FlightMetrics": "analysis.metrics",
    "FlightRecord": "flightlog.reader",
    "Flown": "front_door",
    "Outcome": "flight.outcome",
    "Replay": "analysis.replay",
    "Settings": "config.settings",
    "UserError": "config.errors",
    "analyze": "front_door",
    "build_law": "control.registry",
    "check": "front_door",
    "compare": "front_door",
    "fly": "front_door",
    "load_settings": "config.settings",
    "read_log": "flightlog.reader",
    "register_law": "control.laws",
    "replay": "front_door",
    "trajectory": "reference.registry:trajectory_from_text",
}
"""Where each name is; after a colon, what it is called there."""

__all__ = [
    "Checked",
    "Comparison",
    "ControlLaw",
    "FlightMetrics",
    "FlightRecord",
    "Flown",
    "Outcome",
    "Replay",
    "Settings",
    "UserError",
    "__version__",
    "analyze",
    "build_law",
    "check",
    "compare",
    "fly",
    "load_settings",
    "read_log",
    "register_law",
    "replay",
    "trajectory",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("dtlannc-companion")
    if name not in _HOMES:
        raise AttributeError(f"module 'companion' has no attribute {name!r}; it has {', '.join(__all__)}")
    module, _, inside = _HOMES[name].partition(":")
    found = getattr(importlib.import_module(f"companion.{module}"), inside or name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
