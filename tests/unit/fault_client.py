"""A client of a stub inside this process whose faults come from a scenario."""

from __future__ import annotations

from typing import Any

from ardupilot_client import ArduPilotClient
from stub_client import MemoryClient

from sitl_stub.faults.director import FaultDirector
from sitl_stub.faults.scenario import entry_from, scenario_from


def with_faults(client: MemoryClient, *faults: dict[str, Any], seed: int = 0, **top: Any) -> MemoryClient:
    """`client` with the faults of a scenario (`kind`, `at_s`, ... as in a file)."""
    FaultDirector(client.autopilot, scenario_from({"fault": list(faults), **top}), seed)
    return client


def px4(*faults: dict[str, Any], **build: Any) -> MemoryClient:
    return with_faults(MemoryClient(estimator="perfect", **build), *faults)


def ardupilot(*faults: dict[str, Any], **build: Any) -> ArduPilotClient:
    client = ArduPilotClient(**build)
    with_faults(client, *faults)
    return client


def inject(client: MemoryClient, kind: str, **values: Any) -> None:
    """As `Stub.inject`: now, or `at_s`."""
    assert client.autopilot.faults is not None
    client.autopilot.faults.plan(entry_from({"kind": kind, **values}))
