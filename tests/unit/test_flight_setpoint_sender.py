"""The way out of the control loop: what is refused, withheld or lost is counted, and nobody is told that it was sent."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.autopilot.px4 import Px4
from companion.autopilot.thrust import ThrustScale
from companion.control.structs import ControlLevel, Setpoint
from companion.flight.setpoint_gate import SetpointGate
from companion.flight.setpoint_sender import SetpointSender

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
GOOD = Setpoint(ControlLevel.ATTITUDE, 9.81, LEVEL, np.zeros(3), np.zeros(3))
NAN = replace(GOOD, quaternion_wxyz=np.array([np.nan, 0.0, 0.0, 0.0]))


class Wire:
    """A link that keeps what is sent, a predictor, a hover estimate and a log that keep what they are told."""

    def __init__(self) -> None:
        self.open = True
        self.target_system = 1
        self.messages: list[Any] = []
        self.told: list[tuple[str, float]] = []
        self.events: list[str] = []

    def send(self, message: Any) -> bool:
        if self.open:
            self.messages.append(message)
        return self.open


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
def sender(wire: Wire) -> SetpointSender:
    def tells(name: str) -> Any:
        return lambda time_s, *rest: wire.told.append((name, time_s))

    log = SimpleNamespace(event=lambda kind, time_s, **fields: wire.events.append(fields["reason"]))
    return SetpointSender(
        SimpleNamespace(adapter=Px4(), link=wire),  # type: ignore[arg-type]
        ThrustScale(0.4, 2.0, 12.0, np.ones((4, 4))),
        SetpointGate(np.radians([220.0, 220.0, 120.0])),
        SimpleNamespace(sent=tells("hover")),  # type: ignore[arg-type]
        SimpleNamespace(sent=tells("predictor")),  # type: ignore[arg-type]
        SimpleNamespace(setpoint=tells("log"), log=log),  # type: ignore[arg-type]
    )


def test_a_good_one_goes_out_as_the_autopilot_means_it(sender: SetpointSender, wire: Wire) -> None:
    """Half the weight of 2 kg that hover at 0.4 is thrust 0.2; level and facing east in ENU is yaw 90° in NED."""
    assert sender.send(3.0, GOOD, None)
    (message,) = wire.messages
    assert message.get_type() == "SET_ATTITUDE_TARGET" and message.time_boot_ms == 3000
    assert message.thrust == pytest.approx(0.2)
    assert message.q == pytest.approx([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    assert wire.told == [("hover", 3.0), ("predictor", 3.0), ("log", 3.0)]
    assert sender.last_sent_s == 3.0 and sender.asked_thrust_newton == 9.81 and not sender.counters


def test_what_the_gate_refuses_is_said_once_and_counted_each_time(sender: SetpointSender, wire: Wire) -> None:
    assert [sender.send(0.01 * i, NAN, None) for i in range(3)] == [False] * 3
    assert not wire.messages and not wire.told and len(wire.events) == 1
    assert sender.refused == 3 and sender.counters == {"setpoints refused": 3}
    assert sender.send(0.03, GOOD, None) and sender.refused == 0


def test_nothing_of_before_a_stall_goes_out(sender: SetpointSender, wire: Wire) -> None:
    watchdog = SimpleNamespace(tripped=True)
    sender.watchdog = watchdog  # type: ignore[assignment]
    sender.send(1.0, GOOD, None)
    assert not wire.messages and not wire.told and sender.counters == {"setpoints withheld": 1}
    watchdog.tripped = False
    sender.send(2.0, GOOD, None)
    assert len(wire.messages) == 1 and sender.last_sent_s == 2.0


def test_one_that_finds_no_way_out_leaves_a_gap(sender: SetpointSender, wire: Wire) -> None:
    sender.send(1.0, GOOD, None)
    wire.open = False
    sender.send(2.0, GOOD, None)
    assert sender.last_sent_s == 1.0 and sender.counters == {"setpoints not sent": 1}
