"""A stand-in autopilot in pure Python: PX4 or ArduCopter on the wire, a 6-DOF multirotor inside.

    from sitl_stub import FAULTS, Stub

    with Stub(firmware="px4", lockstep=True, seed=3) as stub:
        fly(stub.endpoint)                       # anybody's client
        stub.inject("gps_loss", for_s=5.0)       # one of FAULTS

`Stub` runs it as a process of its own; `sitl_stub.simulation.Simulation` flies it inside this one, without sockets.
`FAULTS` are the kinds of faults by name (docs/faults.md). Names are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sitl_stub.faults.registry import KINDS as FAULTS
    from sitl_stub.stub_process import Stub, StubError

_HOMES = {"FAULTS": "faults.registry:KINDS", "Stub": "stub_process", "StubError": "stub_process"}
__all__ = ["FAULTS", "Stub", "StubError", "__version__"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("dtlannc-companion")
    if name not in _HOMES:
        raise AttributeError(f"module 'sitl_stub' has no attribute {name!r}; it has {', '.join(__all__)}")
    module, _, inside = _HOMES[name].partition(":")
    found = getattr(importlib.import_module(f"sitl_stub.{module}"), inside or name)
    globals()[name] = found
    return found
