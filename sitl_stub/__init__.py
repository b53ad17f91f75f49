"""A stand-in autopilot in pure Python: PX4 on the wire, a 6-DOF multirotor inside. Knows nothing of the companion.

`Stub` runs it as a process of its own; `sitl_stub.simulation.Simulation` flies it inside this one, without sockets.
"""

from sitl_stub.stub_process import Stub, StubError

__all__ = ["Stub", "StubError"]
