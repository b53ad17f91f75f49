"""A client of a stub inside this process whose faults come from a scenario."""

from __future__ import annotations

from typing import Any

from ardupilot_client import ArduPilotClient
from stub_client import MemoryClient, message_id

from sitl_stub.faults.director import FaultDirector
from sitl_stub.faults.scenario import entry_from, scenario_from
from sitl_stub.firmware.px4.modes import Mode as Px4Mode


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


def flying_px4(**build: Any) -> MemoryClient:
    """In OFFBOARD at 3 m on position setpoints."""
    client = px4(**build)
    client.in_the_air()
    client.take()
    stay(client, 1.1)
    return client


def flying_ardupilot(*messages: str, **build: Any) -> MemoryClient:
    """In GUIDED at 5 m, these messages at 50 Hz."""
    client = ardupilot(**build)
    for name in messages:
        client.command("SET_MESSAGE_INTERVAL", message_id(name), 20_000)
    client.in_the_air()
    client.take()
    client.advance(1.1)
    return client


def stay(client: MemoryClient, seconds: float) -> None:
    """Hold the place by setpoints, whatever has become of the autopilot."""
    client.advance(seconds, every=lambda: client.position(0, 0, -3))


def px4_mode(client: MemoryClient) -> Px4Mode:
    """Of the last HEARTBEAT."""
    custom = client.last("HEARTBEAT").custom_mode
    return next(mode for mode in Px4Mode if mode.custom_mode == custom)


def texts(client: MemoryClient) -> list[str]:
    return [m.text for m in client.take("STATUSTEXT") if not m.text.startswith("fault:")]


def px4_mode_of(seen: list[Any]) -> Px4Mode:
    custom = [m for m in seen if m.name == "HEARTBEAT"][-1].custom_mode
    return next(mode for mode in Px4Mode if mode.custom_mode == custom)
