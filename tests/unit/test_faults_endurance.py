"""Nothing that a scenario may say kills the stub: every kind, any parameters within their bounds, any number at once."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ardupilot_client import ArduPilotClient
from fault_client import with_faults
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stub_client import MemoryClient, message_id

from sitl_stub.faults.fault import Parameter
from sitl_stub.faults.registry import KINDS
from sitl_stub.faults.scenario import ANCHORS, Target, entry_from

FLIGHT_S = 4.0


def values_of(parameter: Parameter) -> st.SearchStrategy[Any]:
    """What a scenario may say: bounds themselves come up often."""
    if parameter.kind is bool:
        return st.booleans()
    if parameter.kind is str:
        return st.sampled_from(parameter.options)
    if parameter.kind is tuple:
        few = ("HEARTBEAT", "ATTITUDE", "COMMAND_ACK", "STATUSTEXT", "TIMESYNC", parameter.options[-1])
        return st.lists(st.sampled_from(few), min_size=1, max_size=3)
    if parameter.kind is int:
        return st.integers(int(parameter.least), int(parameter.most))
    bounds = st.sampled_from([parameter.least, parameter.most])
    return st.floats(parameter.least, parameter.most, allow_subnormal=False) | bounds


@st.composite
def faults(draw: st.DrawFn) -> dict[str, Any]:
    """One `[[fault]]` within the schema."""
    kind = KINDS[draw(st.sampled_from(sorted(KINDS)))]
    table: dict[str, Any] = {"kind": kind.kind, "after": draw(st.sampled_from(ANCHORS))}
    table["at_s"] = draw(st.floats(0.0, FLIGHT_S))
    if not kind.momentary and draw(st.booleans()):
        table["for_s"] = draw(st.floats(0.0, 2.0))
    for name, parameter in kind.parameters().items():
        if draw(st.booleans()):
            table[name] = draw(values_of(parameter))
    return table


def taken(table: dict[str, Any], target: Target) -> bool:
    fault = entry_from(table).fault
    return fault.refusal(target.firmware, target.vehicle) is None


def fly_through(client: MemoryClient, firmware: str, tables: list[dict[str, Any]]) -> None:
    """Take off, ask for much, go on for some seconds and look whether the stub still answers."""
    core = client.autopilot.core
    target = Target(firmware, core.vehicle)
    with_faults(client, *(table for table in tables if taken(table, target)), seed=1)
    for name in ("ODOMETRY", "GPS_RAW_INT", "SYS_STATUS", "BATTERY_STATUS", "RC_CHANNELS", "HIGHRES_IMU"):
        client.command("SET_MESSAGE_INTERVAL", message_id(name), 20_000)
    client.advance(1.2)
    for _ in range(round(FLIGHT_S / 0.2)):
        client.command("DO_SET_MODE", 1, 6 if firmware == "px4" else 4)
        client.command("COMPONENT_ARM_DISARM", 1)
        client.command("NAV_TAKEOFF", 0, 0, 0, 0, 0, 0, 5)
        client.advance(0.2, every=lambda: client.position(0, 0, -3), period_s=0.04)
    client.send(mavlink.MAVLink_param_request_list_message(1, 1))
    faults_now = client.autopilot.faults
    assert faults_now is not None
    faults_now.clear()
    client.advance(0.2)
    assert np.isfinite(core.state[:60]).all() and np.isfinite(core.estimate).all()
    client.take()
    if client.autopilot.clock.uptime_us < 0:
        client.advance(-client.autopilot.clock.uptime_us * 1e-6 + 0.2)
    client.advance(1.1)
    assert "HEARTBEAT" in {message.name for message in client.take()}


@settings(
    max_examples=20,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow],
)
@given(tables=st.lists(faults(), min_size=1, max_size=6), firmware=st.sampled_from(["px4", "ardupilot"]))
def test_no_scenario_kills_the_stub(tables: list[dict[str, Any]], firmware: str) -> None:
    client = MemoryClient(seed=1) if firmware == "px4" else ArduPilotClient(estimator="mocap", seed=1)
    fly_through(client, firmware, tables)


@pytest.mark.parametrize("firmware", ["px4", "ardupilot"])
def test_everything_at_once_and_twice(firmware: str) -> None:
    client = MemoryClient(seed=1) if firmware == "px4" else ArduPilotClient(estimator="mocap", seed=1)
    once = [{"kind": kind, "after": "airborne", "at_s": 0.1} for kind in KINDS if kind != "reboot"]
    fly_through(client, firmware, [*once, *once, {"kind": "reboot", "at_s": 3.0}])
