"""Whose setpoints reach the autopilot: passed on, flown by the law, or a client's own business; one side's at a time."""

from __future__ import annotations

import pytest

from companion.mavlink.layouts import mav
from companion.mavlink.signing import Signer
from companion.serve.setpoint_switch import SetpointSwitch

KEY = bytes(range(32))


def packed(message: object, signer: Signer | None = None) -> bytes:
    codec = mav.MAVLink(None, srcSystem=245, srcComponent=190)
    if signer is not None:
        signer.prepare(codec)
    return bytes(message.pack(codec))  # type: ignore[attr-defined]


def position(system: int = 1) -> object:
    return mav.MAVLink_set_position_target_local_ned_message(
        5, system, 1, 1, 0x0DF8, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    )


GLOBAL = mav.MAVLink_set_position_target_global_int_message(
    5, 1, 1, 6, 0x0DF8, 470000000, 80000000, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
)
ATTITUDE = mav.MAVLink_set_attitude_target_message(5, 1, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.5)
MANUAL = mav.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0)


@pytest.mark.parametrize("asked", [position(), position(system=0), GLOBAL])
def test_position_setpoints_are_passed_on_until_the_law_takes_over(asked: object) -> None:
    switch, frame = SetpointSwitch(), packed(asked)
    assert switch.from_client("a", frame, 0.0) == (True, True)
    switch.take(1, 0.1)
    assert switch.from_client("a", frame, 0.2) == (False, True)
    assert switch.let_go(0.3) == frame  # the autopilot has its client's last word
    assert switch.from_client("a", frame, 0.4) == (True, True)


def test_what_is_held_back_is_not_kept_for_long() -> None:
    switch, frame = SetpointSwitch(), packed(position())
    switch.take(1, 0.0)
    assert switch.let_go(0.1) is None
    switch.take(1, 1.0)
    switch.from_client("a", frame, 1.1)
    assert switch.let_go(2.2) is None
    switch.take(1, 3.0)
    assert switch.let_go(3.1) is None  # nothing of an earlier turn is left


def test_everything_else_is_passed_on_and_not_shown() -> None:
    switch = SetpointSwitch()
    switch.take(1, 0.0)
    assert switch.from_client("a", packed(MANUAL), 0.1) == (True, False)
    assert switch.from_client("a", packed(position(system=2)), 0.1) == (True, False)  # another vehicle's
    damaged = bytearray(packed(position()))
    damaged[-1] ^= 1
    assert switch.from_client("a", bytes(damaged), 0.1) == (True, False)  # the autopilot's to refuse


def test_setpoints_of_the_law_reach_the_autopilot_only_while_it_has_taken_over() -> None:
    switch, frame = SetpointSwitch(), packed(ATTITUDE)
    assert not switch.from_law(frame, 0.0)
    assert switch.from_law(packed(MANUAL), 0.0)
    switch.take(1, 0.1)
    assert switch.from_law(frame, 0.2)
    switch.let_go(0.3)
    assert not switch.from_law(frame, 0.4)


def test_a_clients_attitude_setpoints_are_passed_on_and_keep_ours_away() -> None:
    switch, frame = SetpointSwitch(), packed(ATTITUDE)
    switch.take(1, 0.0)
    assert switch.from_client("a", frame, 1.0) == (True, True)
    assert not switch.from_law(frame, 1.4)
    assert switch.from_law(frame, 1.6)


def test_one_source_at_a_time_until_it_is_silent() -> None:
    switch, frame = SetpointSwitch(), packed(position())
    assert switch.from_client("a", frame, 0.0) == (True, True)
    assert switch.from_client("b", frame, 0.5) == (True, False)  # passed on, as without us
    switch.take(1, 0.6)
    assert switch.from_client("b", frame, 0.7) == (False, False)
    assert switch.from_client("a", frame, 0.9) == (False, True)
    assert switch.from_client("b", frame, 2.0) == (False, True)
    assert switch.counters["setpoints of a second client"] == 2


def test_a_law_that_sends_nothing_lapses() -> None:
    switch = SetpointSwitch()
    assert not switch.has_lapsed(9.0)
    switch.take(1, 10.0)
    assert not switch.has_lapsed(10.2)
    assert switch.from_law(packed(ATTITUDE), 10.25)
    assert not switch.has_lapsed(10.5)
    assert switch.has_lapsed(10.6)


def test_what_we_would_sign_has_to_be_signed() -> None:
    """Else a setpoint that the autopilot refuses would reach it under our signature."""
    switch = SetpointSwitch(Signer(KEY))
    switch.take(1, 0.0)
    assert switch.from_client("a", packed(position()), 0.1) == (True, False)
    assert switch.from_client("a", packed(position(), Signer(bytes(32))), 0.2) == (True, False)
    assert switch.from_client("a", packed(position(), Signer(KEY)), 0.3) == (False, True)
    assert switch.counters["setpoints not signed with our key"] == 2
