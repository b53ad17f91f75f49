"""Commands with their answers, parameters in both encodings, stream rates."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavlink_wire import MemoryTransport, Sender, decoded, heartbeat, link_over, mav

from companion.mavlink.protocol import (
    Command,
    CommandClient,
    ParameterClient,
    message_interval,
    request_message,
)

INTEGERS = {
    mav.MAV_PARAM_TYPE_UINT8: np.uint8,
    mav.MAV_PARAM_TYPE_INT8: np.int8,
    mav.MAV_PARAM_TYPE_UINT16: np.uint16,
    mav.MAV_PARAM_TYPE_INT16: np.int16,
    mav.MAV_PARAM_TYPE_UINT32: np.uint32,
    mav.MAV_PARAM_TYPE_INT32: np.int32,
}


@pytest.fixture
def spoken():
    """A link locked on to system 3, and what it sends."""
    transport = MemoryTransport()
    link = link_over(transport)
    transport.waiting.append(Sender(system=3).frame(heartbeat()))
    link.receive(0.0)
    return link, lambda: decoded(transport.sent)


def ack(command, result, progress=0):
    return mav.MAVLink_command_ack_message(command, result, progress)


def value(name, number, kind):
    return mav.MAVLink_param_value_message(name.encode(), number, kind, 10, 1)


def as_float(kind, integer):
    """The float whose bits hold an integer, by NumPy."""
    raw = INTEGERS[kind](integer).tobytes().ljust(4, b"\0")
    return float(np.frombuffer(raw, "<f4")[0])


def over_the_wire(message):
    """As it comes out of a frame: the float has been through four bytes."""
    return decoded([Sender().frame(message)])[0]


# Commands -----------------------------------------------------------------------------------------------


def test_command_goes_to_the_autopilot_with_all_seven_parameters(spoken):
    link, sent = spoken
    CommandClient(link).send(Command(mav.MAV_CMD_DO_SET_MODE, (1.0, 6.0)))
    (message,) = sent()
    assert (message.target_system, message.target_component, message.command) == (3, 1, 176)
    parameters = [getattr(message, f"param{index}") for index in range(1, 8)]
    assert parameters == [1.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert message.confirmation == 0


def test_confirmation_counts_repetitions_of_the_same_command(spoken):
    link, sent = spoken
    client = CommandClient(link)
    for again in (False, True, True, False):
        client.send(Command(400, (1.0,)), again)
    assert [message.confirmation for message in sent()] == [0, 1, 2, 0]


def test_only_the_answer_to_the_last_command_counts(spoken):
    client = CommandClient(spoken[0])
    client.send(Command(400, (1.0,)))
    client.take(ack(176, mav.MAV_RESULT_ACCEPTED))
    assert client.result is None
    client.take(ack(400, mav.MAV_RESULT_IN_PROGRESS, 50))
    assert client.result is None
    client.take(ack(400, mav.MAV_RESULT_DENIED))
    assert client.result == mav.MAV_RESULT_DENIED
    client.send(Command(176))
    assert client.result is None
    client.take(ack(400, mav.MAV_RESULT_ACCEPTED))  # PX4 acknowledges twice at times
    assert client.result is None


def test_an_answer_to_somebody_else_is_none_to_us(spoken):
    client = CommandClient(spoken[0])
    client.send(Command(511))
    for system, component in ((255, 190), (3, 192), (255, 191)):
        client.take(mav.MAVLink_command_ack_message(511, mav.MAV_RESULT_DENIED, 0, 0, system, component))
    assert client.result is None
    client.take(mav.MAVLink_command_ack_message(511, mav.MAV_RESULT_ACCEPTED, 0, 0, 3, 191))
    assert client.result == mav.MAV_RESULT_ACCEPTED


def test_a_late_refusal_is_not_taken_for_that_of_the_next_command(spoken):
    client = CommandClient(spoken[0])
    client.send(Command(400, (1.0,)))  # nobody answers
    client.send(Command(400, (0.0,)))
    client.take(ack(400, mav.MAV_RESULT_DENIED))  # of the first
    assert client.result is None
    client.take(ack(400, mav.MAV_RESULT_ACCEPTED))
    assert client.result == mav.MAV_RESULT_ACCEPTED


# Parameters ---------------------------------------------------------------------------------------------


def test_integers_are_bits_on_px4_and_values_on_ardupilot(spoken):
    """1 as an INT32 is 1.4e-45 as a float's bits, and 1.0 as a value."""
    bits, values = ParameterClient(spoken[0]), ParameterClient(spoken[0])
    bits.request("COM_OBL_RC_ACT")
    values.request("GUID_OPTIONS")
    bits.bytewise = True
    bits.take(value("COM_OBL_RC_ACT", 1.401298464324817e-45, mav.MAV_PARAM_TYPE_INT32))
    values.take(value("GUID_OPTIONS", 8.0, mav.MAV_PARAM_TYPE_INT32))
    assert bits.values == {"COM_OBL_RC_ACT": 1.0}
    assert values.values == {"GUID_OPTIONS": 8.0}


def test_reals_are_the_same_in_both(spoken):
    for bytewise in (True, False):
        client = ParameterClient(spoken[0])
        client.bytewise = bytewise
        client.request("MPC_THR_HOVER")
        client.take(value("SOMEBODY_ELSES", 0.5, mav.MAV_PARAM_TYPE_REAL32))
        assert client.values == {}
        client.take(value("MPC_THR_HOVER", 0.5, mav.MAV_PARAM_TYPE_REAL32))
        assert client.values["MPC_THR_HOVER"] == 0.5


@given(st.sampled_from(sorted(INTEGERS)), st.data())
def test_integers_come_back_from_px4s_encoding(kind, data):
    limits = np.iinfo(INTEGERS[kind])
    integer = data.draw(st.integers(int(limits.min), int(limits.max)))
    if math.isnan(as_float(kind, integer)):
        return  # a processor may change the bits of a signalling NaN on the way: PX4's own limit
    client = ParameterClient(link_over(MemoryTransport()))
    client.bytewise = True
    client.request("NAME")
    client.take(over_the_wire(value("NAME", as_float(kind, integer), kind)))
    assert client.values["NAME"] == integer


@given(st.sampled_from(sorted(INTEGERS)), st.integers(0, 127), st.booleans())
def test_what_is_set_is_what_the_autopilot_reads(kind, integer, bytewise):
    transport = MemoryTransport()
    client = ParameterClient(link_over(transport))
    client.bytewise = bytewise
    client.request("NAME")
    transport.sent.clear()
    client.take(over_the_wire(value("NAME", as_float(kind, 3) if bytewise else 3.0, kind)))
    client.set("NAME", float(integer))
    (message,) = decoded(transport.sent)
    assert (message.param_id, message.param_type) == ("NAME", kind)
    raw = struct.pack("<f", message.param_value)
    read = np.frombuffer(raw, INTEGERS[kind])[0] if bytewise else message.param_value
    assert read == integer


def test_a_name_of_sixteen_letters(spoken):
    link, sent = spoken
    client = ParameterClient(link)
    client.request("SIXTEEN_LETTERS_")
    (message,) = sent()
    assert (message.param_id, message.param_index, message.target_system) == ("SIXTEEN_LETTERS_", -1, 3)
    client.take(over_the_wire(value("SIXTEEN_LETTERS_", 2.0, mav.MAV_PARAM_TYPE_REAL32)))
    assert client.values == {"SIXTEEN_LETTERS_": 2.0}


# Requests -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate_hz", "interval_us"),
    [(100.0, 10_000), (250.0, 4_000), (2.0, 500_000), (30.0, 33_000), (2000.0, 1_000)],
)
def test_intervals_are_whole_milliseconds(rate_hz, interval_us):
    """ArduPilot refuses finer ones."""
    command = message_interval(mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, rate_hz)
    assert (command.number, command.parameters) == (511, (31.0, float(interval_us)))


def test_request_message():
    command = request_message(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    assert (command.number, command.parameters) == (512, (148.0,))
