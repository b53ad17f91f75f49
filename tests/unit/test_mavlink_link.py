"""The link: whom it believes, what it counts, what it answers, and that no bytes can upset it."""

from __future__ import annotations

import random

import pytest
from mavlink_wire import (
    Clock,
    MemoryTransport,
    Sender,
    all_messages,
    attitude,
    decoded,
    heartbeat,
    link_over,
    local_position,
    mav,
)

from companion.autopilot.adapter import VehicleStatus
from companion.config.errors import UserError
from companion.flight.vehicle import Vehicle
from companion.mavlink.framing import is_signed
from companion.mavlink.link import Link
from companion.mavlink.protocol import CommandClient, ParameterClient
from companion.mavlink.signing import Signer
from companion.mavlink.state import StateAssembler

GROUND_STATION = mav.MAVLink_heartbeat_message(
    mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3
)


@pytest.fixture
def wire():
    """A transport, the link over it, its clock, and an autopilot with system 1."""
    transport, clock = MemoryTransport(), Clock()
    return transport, link_over(transport, clock), clock, Sender()


def kinds(messages):
    return [message.get_type() for message in messages]


# Whom it believes ---------------------------------------------------------------------------------------


def test_nothing_is_believed_before_an_autopilot_heartbeat(wire):
    transport, link, _, autopilot = wire
    transport.waiting.append(autopilot.frame(attitude(10)))
    transport.waiting.append(autopilot.frame(heartbeat()))
    transport.waiting.append(autopilot.frame(attitude(20)))
    assert kinds(all_messages(link)) == ["HEARTBEAT", "ATTITUDE_QUATERNION"]
    assert link.target_system == 1
    assert link.autopilot_time_s == 0.02


@pytest.mark.parametrize(
    ("system", "component", "message"),
    [
        (255, 190, GROUND_STATION),
        (1, 1, GROUND_STATION),  # a ground station that took an autopilot's numbers
        (0, 1, heartbeat()),  # 0 means everybody
        (1, 154, heartbeat(mav.MAV_AUTOPILOT_PX4, mav.MAV_TYPE_GIMBAL)),
        (1, 191, heartbeat(mav.MAV_AUTOPILOT_INVALID, mav.MAV_TYPE_ONBOARD_CONTROLLER)),
    ],
)
def test_who_is_no_autopilot_is_not_locked_on_to(wire, system, component, message):
    transport, link, _, autopilot = wire
    transport.waiting.append(Sender(system, component).frame(message))
    assert all_messages(link) == []
    assert link.target_system is None
    assert link.counters["other senders"] == 1
    transport.waiting.append(autopilot.frame(heartbeat()))
    assert kinds(all_messages(link)) == ["HEARTBEAT"]


def test_locks_on_to_the_first_and_ignores_everybody_else(wire):
    transport, link, _, _ = wire
    first, second, gimbal = Sender(system=7), Sender(system=1), Sender(system=7, component=154)
    transport.waiting.append(first.frame(heartbeat()))
    transport.waiting.append(second.frame(heartbeat(custom_mode=99)))
    transport.waiting.append(second.frame(attitude(5000)))
    transport.waiting.append(gimbal.frame(attitude(6000)))
    transport.waiting.append(first.frame(attitude(40)))
    messages = all_messages(link)
    assert [(m.get_type(), m.get_srcSystem()) for m in messages] == [
        ("HEARTBEAT", 7),
        ("ATTITUDE_QUATERNION", 7),
    ]
    assert link.heartbeat.custom_mode == 0
    assert link.autopilot_time_s == 0.04
    assert (link.counters["other autopilots"], link.counters["other senders"]) == (2, 1)
    assert link.counters["lost"] == 0


def test_what_nobody_waits_for_is_believed_and_logged_all_the_same(wire):
    """One datagram holds both, as in lockstep: the flight sees one, the log and the counts both."""
    transport, link, _, autopilot = wire
    transport.waiting.append(autopilot.frame(heartbeat()))
    all_messages(link)
    tapped = []
    link.tap = lambda outgoing, time_s, frame: tapped.append((time_s, frame))
    link.wanted = {mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION}
    both = [
        autopilot.frame(local_position(30)),
        autopilot.frame(attitude(20)),
        autopilot.frame(local_position(40)),
    ]
    transport.waiting.append(b"".join(both))
    assert kinds(all_messages(link)) == ["ATTITUDE_QUATERNION"]
    assert tapped == [(0.03, both[0]), (0.03, both[1]), (0.04, both[2])]
    assert link.autopilot_time_s == 0.04
    assert link.counters["received"] == 4 and link.counters["lost"] == 0


def test_speaks_as_a_component_of_the_vehicle(wire):
    transport, link, _, _ = wire
    transport.waiting.append(Sender(system=7).frame(heartbeat()))
    all_messages(link)
    link.keep_alive()
    ours = decoded(transport.sent)
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in ours} == {(7, 191)}
    alive = next(m for m in ours if m.get_type() == "HEARTBEAT")
    assert alive.type == mav.MAV_TYPE_ONBOARD_CONTROLLER
    assert alive.autopilot == mav.MAV_AUTOPILOT_INVALID


# Commands to the companion ------------------------------------------------------------------------------


def command_to(component, system=1, number=mav.MAV_CMD_COMPONENT_ARM_DISARM):
    return mav.MAVLink_command_long_message(system, component, number, 0, *(1.0,) * 7)


def test_commands_to_the_companion_are_refused_and_nothing_else_happens(wire):
    transport, link, clock, autopilot = wire
    ground = Sender(255, 190)
    transport.waiting.append(
        ground.frame(command_to(191))
    )  # before there is an autopilot: to whom would we answer?
    transport.waiting.append(autopilot.frame(heartbeat()))
    assert kinds(all_messages(link)) == ["HEARTBEAT"] and transport.sent == []
    for addressed in (command_to(191), command_to(1), command_to(0), command_to(191, system=2)):
        transport.waiting.append(ground.frame(addressed))
    transport.waiting.append(
        ground.frame(mav.MAVLink_command_int_message(1, 191, 0, 246, 0, 0, 1, *(0,) * 6))
    )
    assert all_messages(link) == []
    [answer] = decoded(transport.sent)  # of two commands at once; the others were not for us
    assert (answer.get_type(), answer.command) == ("COMMAND_ACK", mav.MAV_CMD_COMPONENT_ARM_DISARM)
    assert answer.result == mav.MAV_RESULT_UNSUPPORTED
    assert (answer.target_system, answer.target_component) == (255, 190)
    assert link.counters["commands refused"] == 2
    clock.advance(0.2)
    transport.waiting += [ground.frame(command_to(191)) for _ in range(50)]
    all_messages(link)
    assert len(transport.sent) == 2


def test_an_unsigned_command_is_denied_where_signing_is_on(wire):
    transport, _, clock, _ = wire
    link = Link(transport, now_ns=clock, signer=Signer(bytes(range(32))))
    theirs = Signer(bytes(range(32)))
    autopilot = Sender()
    theirs.prepare(autopilot.codec)
    transport.waiting.append(autopilot.frame(heartbeat()))
    assert kinds(all_messages(link)) == ["HEARTBEAT"]
    transport.waiting.append(Sender(255, 190).frame(command_to(191)))
    assert all_messages(link) == []
    [answer] = decoded(transport.sent)
    assert answer.result == mav.MAV_RESULT_DENIED and is_signed(transport.sent[0])
    ground = Sender(255, 190)
    theirs.prepare(ground.codec)
    clock.advance(1.0)
    transport.waiting.append(ground.frame(command_to(191)))
    assert all_messages(link) == []
    assert decoded(transport.sent)[-1].result == mav.MAV_RESULT_UNSUPPORTED


# What it counts -----------------------------------------------------------------------------------------


def arrivals(wire, sequences):
    """Loss counted when frames with these sequence numbers arrive."""
    transport, link, _, autopilot = wire
    for sequence in sequences:
        autopilot.codec.seq = sequence % 256
        transport.waiting.append(autopilot.frame(heartbeat()))
    all_messages(link)
    return link.counters["lost"]


@pytest.mark.parametrize(
    ("sequences", "lost"),
    [
        (range(250, 262), 0),  # over the wrap
        ([1, 2, 5, 6], 2),
        ([254, 1], 2),  # 255 and 0
        ([10, 12, 11, 13, 14], 1),  # 11 came late: it was missed once, and nothing after it
        ([10, 11, 11, 12], 0),  # twice
        ([200, 0, 1, 2], 55),  # 201 to 255
        ([100, 0, 1, 2], 155),  # 101 to 255: more than half a turn
    ],
)
def test_loss_is_counted_by_sequence_numbers(wire, sequences, lost):
    assert arrivals(wire, sequences) == lost


def test_loss_ratio_is_lost_by_all(wire):
    arrivals(wire, [0, 1, 2, 4])
    assert wire[1].loss_ratio == 1 / 5


def test_unknown_messages_are_not_lost_ones_and_are_logged(wire):
    transport, link, _, autopilot = wire
    tapped = []
    link.tap = lambda outgoing, time_s, frame: tapped.append((outgoing, frame))
    payload = b"abc"
    unknown = bytes([0xFD, len(payload), 0, 0, 1, 1, 1, 410 & 0xFF, 410 >> 8, 0]) + payload + b"\x12\x34"
    stranger = unknown[:5] + b"\x09" + unknown[6:]  # of system 9
    transport.waiting.append(autopilot.frame(heartbeat()))
    transport.waiting.append(unknown)
    transport.waiting.append(stranger)
    autopilot.skip(1)
    transport.waiting.append(autopilot.frame(heartbeat()))
    assert kinds(all_messages(link)) == ["HEARTBEAT", "HEARTBEAT"]
    assert link.counters["lost"] == 0
    assert link.counters["unknown messages"] == 2
    assert [frame for _, frame in tapped].count(unknown) == 1
    assert stranger not in [frame for _, frame in tapped]


def test_reboot_is_noticed_and_small_steps_back_are_not_one(wire):
    transport, link, _, autopilot = wire
    for time_ms in (60_000, 60_010, 59_990, 60_020):  # streams are stamped when sampled
        transport.waiting.append(autopilot.frame(local_position(time_ms)))
    transport.waiting.appendleft(autopilot.frame(heartbeat()))
    all_messages(link)
    assert link.counters["reboots"] == 0
    assert link.autopilot_time_s == 60.02
    transport.waiting.append(autopilot.frame(local_position(1500)))
    all_messages(link)
    assert link.counters["reboots"] == 1
    assert link.autopilot_time_s == 1.5


def test_an_old_setpoint_is_no_reboot(wire):
    """PX4 1.17 flown at body rates stamps ATTITUDE_TARGET with the last attitude setpoint: seen 16 s old."""
    transport, link, _, autopilot = wire
    transport.waiting.append(autopilot.frame(heartbeat()))
    transport.waiting.append(autopilot.frame(local_position(42_900)))
    transport.waiting.append(
        autopilot.frame(
            mav.MAVLink_attitude_target_message(26_092, 128, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.5)
        )
    )
    all_messages(link)
    assert link.counters["reboots"] == 0
    assert link.autopilot_time_s == 42.9


def test_silence_is_of_the_autopilot_not_of_the_wire(wire):
    transport, link, clock, autopilot = wire
    assert link.silence_s == float("inf")
    transport.waiting.append(autopilot.frame(heartbeat()))
    all_messages(link)
    clock.advance(2.5)
    transport.waiting.append(Sender(255, 190).frame(GROUND_STATION))
    transport.waiting.append(b"noise")
    all_messages(link)
    assert link.silence_s == pytest.approx(2.5)
    assert link.counters["stray bytes"] == 5


def test_bad_checksums_are_counted_and_dropped(wire):
    transport, link, _, autopilot = wire
    good = autopilot.frame(heartbeat())
    bad = bytearray(autopilot.frame(attitude(10)))
    bad[12] ^= 1
    transport.waiting.extend([good, bytes(bad), autopilot.frame(attitude(20))])
    assert kinds(all_messages(link)) == ["HEARTBEAT", "ATTITUDE_QUATERNION"]
    assert link.counters["bad frames"] == 1


# What it answers ----------------------------------------------------------------------------------------


def test_timesync_question_is_answered_in_its_turn(wire):
    """The caller gets the question after all that came before it; the answer carries the question's time back."""
    transport, link, clock, autopilot = wire
    transport.waiting.append(autopilot.frame(heartbeat()))
    transport.waiting.append(autopilot.frame(attitude(10)))
    transport.waiting.append(autopilot.frame(mav.MAVLink_timesync_message(0, 123_456_789)))
    transport.waiting.append(autopilot.frame(attitude(20)))
    messages = all_messages(link)
    assert kinds(messages) == ["HEARTBEAT", "ATTITUDE_QUATERNION", "TIMESYNC", "ATTITUDE_QUATERNION"]
    assert transport.sent == []
    link.answer_timesync(messages[2])
    (answer,) = decoded(transport.sent)
    assert (answer.get_type(), answer.tc1, answer.ts1) == ("TIMESYNC", clock.ns, 123_456_789)


def test_timesync_answer_becomes_the_offset(wire):
    transport, link, clock, autopilot = wire
    transport.waiting.append(autopilot.frame(heartbeat()))
    all_messages(link)
    transport.waiting.append(autopilot.frame(attitude(1000)))
    all_messages(link)
    link.keep_alive()
    [question] = [m for m in decoded(transport.sent) if m.get_type() == "TIMESYNC"]
    asked_ns = question.ts1
    clock.advance(0.004)
    autopilot_ns = asked_ns + 2_000_000 + 50_000_000_000  # half-way, 50 s ahead of us
    transport.waiting.append(autopilot.frame(mav.MAVLink_timesync_message(autopilot_ns, asked_ns)))
    assert all_messages(link) == []
    assert link.timesync.offset_s == pytest.approx(50.0, abs=1e-9)
    assert link.timesync.round_trip_s == pytest.approx(0.004)
    # The same answer once more, later, and one to another companion's question: neither is ours.
    clock.advance(0.4)
    transport.waiting.append(autopilot.frame(mav.MAVLink_timesync_message(autopilot_ns, asked_ns)))
    transport.waiting.append(autopilot.frame(mav.MAVLink_timesync_message(autopilot_ns, asked_ns + 1)))
    assert all_messages(link) == []
    assert link.timesync.samples == 1
    assert link.counters["time answers to others"] == 2


@pytest.mark.parametrize(("count", "lost"), [(127, 127), (128, 128), (200, 200), (255, 255)])
def test_a_gap_of_half_a_turn_and_more_is_counted(wire, count, lost):
    """Of a stream of frames that differ: one that is as another of the same number was is a repeated one."""
    transport, link, _, autopilot = wire
    transport.waiting.append(autopilot.frame(heartbeat()))
    for index in range(600):
        if index == 300:
            autopilot.skip(count)
        transport.waiting.append(autopilot.frame(attitude(index)))
    all_messages(link)
    assert link.counters["lost"] == lost


def test_two_autopilots_are_remembered_by_name_and_never_obeyed(wire):
    transport, link, _, autopilot = wire
    transport.waiting.append(autopilot.frame(heartbeat()))
    transport.waiting.append(Sender(2).frame(heartbeat(mav.MAV_AUTOPILOT_ARDUPILOTMEGA)))
    transport.waiting.append(Sender(3, 154).frame(heartbeat(kind=mav.MAV_TYPE_GIMBAL)))
    transport.waiting.append(Sender(4).frame(GROUND_STATION))
    assert kinds(all_messages(link)) == ["HEARTBEAT"]
    assert link.target_system == 1
    assert link.other_autopilots == {2: "ArduPilot, system 2"}


def test_the_system_that_is_wanted_is_waited_for():
    transport = MemoryTransport()
    link = Link(transport, system=2)
    transport.waiting.append(Sender(1).frame(heartbeat()))
    transport.waiting.append(Sender(2).frame(heartbeat()))
    assert [m.get_srcSystem() for m in all_messages(link)] == [2]
    assert link.other_autopilots == {1: "PX4, system 1"}


def test_heartbeat_at_1_hz_of_the_autopilots_time(wire):
    """A simulation at ten times real time gets ten heartbeats in a second of ours."""
    transport, link, clock, autopilot = wire
    transport.waiting.append(autopilot.frame(heartbeat()))
    for index in range(1, 1001):
        clock.advance(0.001)
        transport.waiting.append(autopilot.frame(attitude(10 * index)))
        all_messages(link)
        link.keep_alive()
    ours = kinds(decoded(transport.sent))
    assert ours.count("HEARTBEAT") in (10, 11)
    assert ours.count("TIMESYNC") in range(90, 102)


def test_heartbeat_at_1_hz_of_ours_while_nobody_speaks(wire):
    transport, link, clock, _ = wire
    for _ in range(100):
        clock.advance(0.05)
        link.keep_alive()
    assert kinds(decoded(transport.sent)).count("HEARTBEAT") in (5, 6)
    assert "TIMESYNC" not in kinds(decoded(transport.sent))


def test_what_could_not_be_sent_is_counted_and_not_logged(wire):
    transport, link, _, _ = wire
    tapped = []
    link.tap = lambda outgoing, time_s, frame: tapped.append(frame)
    transport.takes = False
    assert not link.send(heartbeat())
    transport.takes = True
    assert link.send(heartbeat())
    assert (link.counters["unsent"], link.counters["sent"], len(tapped)) == (1, 1, 1)


# Nothing upsets it --------------------------------------------------------------------------------------


def corpus(draw):
    """One frame of each message of the dialect, its payload drawn."""
    frames = []
    for number, kind in mav.mavlink_map.items():
        payload = draw.randbytes(kind.unpacker.size)
        header = bytes([0xFD, len(payload), 0, 0, 0, 1, 1]) + number.to_bytes(3, "little")
        frames.append(repaired(bytearray(header + payload + b"\0\0")))
    return frames


def repaired(frame):
    """The frame with a right checksum, so that its contents are believed."""
    kind = mav.mavlink_map.get(frame[7] | frame[8] << 8 | frame[9] << 16)
    if kind is None or len(frame) != frame[1] + 12:
        return frame
    checksum = mav.x25crc(frame[1:-2] + bytes([kind.crc_extra])).crc
    return frame[:-2] + checksum.to_bytes(2, "little")


@pytest.mark.parametrize("datagrams", [True, False], ids=["datagrams", "stream"])
def test_mutated_frames_never_raise(datagrams):
    """50,000 damaged frames each way, half of them with a checksum that is right for their nonsense."""
    draw = random.Random(20261122)
    transport = MemoryTransport(datagrams)
    link = Link(transport, now_ns=Clock())
    status, assembler = VehicleStatus(), StateAssembler()
    commands, parameters = CommandClient(link), ParameterClient(link)
    parameters.bytewise = True
    frames = corpus(draw)
    interesting = [frame for frame in frames if (frame[7] | frame[8] << 8) in TAKEN_IN_FLIGHT]
    transport.waiting.append(Sender().frame(heartbeat()))
    heard = 0
    for index in range(50_000):
        frame = bytearray(draw.choice(interesting if index % 2 else frames))
        for _ in range(draw.randrange(4)):
            frame[draw.randrange(10 if index % 5 else 0, len(frame))] = draw.choice(
                (0, 255, draw.randrange(256))
            )
        if draw.random() < 0.5:
            frame = repaired(frame)
        if draw.random() < 0.05:
            frame = frame[: draw.randrange(len(frame))]
        transport.waiting.append(bytes(frame))
        while (message := link.receive(0.0)) is not None:
            heard += 1
            status.take(message)
            commands.take(message)
            parameters.take(message)
            assembler.take(message)
    assert heard > 20_000
    assert link.counters["bad frames"] > 5_000
    assert link.target_system == 1


TAKEN_IN_FLIGHT = {
    mav.MAVLINK_MSG_ID_HEARTBEAT,
    mav.MAVLINK_MSG_ID_SYS_STATUS,
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mav.MAVLINK_MSG_ID_COMMAND_ACK,
    mav.MAVLINK_MSG_ID_PARAM_VALUE,
    mav.MAVLINK_MSG_ID_STATUSTEXT,
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
    mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    mav.MAVLINK_MSG_ID_TIMESYNC,
}


def test_an_autopilot_that_never_pauses_and_asks_nothing_still_hears_us(wire):
    """ArduPilot in flight: hundreds of messages a second, and no TIMESYNC question of its own for 10 s."""
    transport, link, _, autopilot = wire
    vehicle = Vehicle(link, silence_limit_s=1.0)
    transport.waiting.append(autopilot.frame(heartbeat()))
    transport.waiting.extend(autopilot.frame(attitude(10 * k)) for k in range(1, 301))
    vehicle.until(lambda: link.autopilot_time_s >= 3.0)
    sent = kinds(decoded(transport.sent))
    assert sent.count("TIMESYNC") == pytest.approx(30, abs=2)
    assert sent.count("HEARTBEAT") == pytest.approx(4, abs=1)


ARMED = mav.MAV_MODE_FLAG_SAFETY_ARMED


def _disarmed_by(wire, base_modes):
    """The autopilot's time at which `disarmed_for(1.0)` is satisfied; a HEARTBEAT every 0.1 s says `base_modes`."""
    transport, link, _, autopilot = wire
    vehicle = Vehicle(link, silence_limit_s=1.0)
    for step, base_mode in enumerate(base_modes):
        transport.waiting.append(autopilot.frame(heartbeat(base_mode=base_mode)))
        transport.waiting.append(autopilot.frame(attitude(5000 + 100 * step)))
    vehicle.until(lambda: vehicle.status.armed)
    vehicle.until(vehicle.disarmed_for(1.0))
    return link.autopilot_time_s


def test_a_heartbeat_that_was_held_up_is_not_taken_for_a_disarming(wire):
    held_up = [ARMED] * 3 + [0] + [ARMED] * 20 + [0] * 20
    assert _disarmed_by(wire, held_up) == pytest.approx(5.0 + 2.4 + 1.0, abs=0.11)


def test_an_autopilot_that_started_anew_and_sends_no_time_is_believed_to_be_disarmed(wire):
    """ArduPilot streams nothing until asked: after a reboot HEARTBEATs are all there is (campaign, ardupilot 833)."""
    transport, link, _, autopilot = wire
    vehicle = Vehicle(link, silence_limit_s=1.0)
    transport.waiting.append(autopilot.frame(heartbeat(base_mode=ARMED)))
    transport.waiting.append(autopilot.frame(attitude(5000)))
    vehicle.until(lambda: vehicle.status.armed)
    disarmed = vehicle.disarmed_for(1.0)
    answers = []
    for _ in range(6):
        transport.waiting.append(autopilot.frame(heartbeat(base_mode=0)))
        for message in all_messages(link):
            vehicle.status.take(message)
        answers.append(disarmed())
    assert answers == [False] * 5 + [True]


def test_the_round_trip_is_known_in_the_autopilots_time(wire):
    """A simulation in lockstep: 150 ms on its clock are 1 ms of ours."""
    transport, link, clock, autopilot = wire
    transport.waiting.append(autopilot.frame(heartbeat()))
    transport.waiting.append(autopilot.frame(attitude(10_000)))
    all_messages(link)
    link.keep_alive()
    (question,) = [message for message in decoded(transport.sent) if message.get_type() == "TIMESYNC"]
    clock.advance(0.001)
    transport.waiting.append(autopilot.frame(attitude(10_150)))
    transport.waiting.append(autopilot.frame(mav.MAVLink_timesync_message(10_075_000_000, question.ts1)))
    all_messages(link)
    assert link.timesync.round_trip_s == pytest.approx(0.001)
    assert link.timesync.autopilot_trip_s == pytest.approx(0.15)


@pytest.mark.parametrize("system", [None, 2])
def test_two_autopilots_are_refused_unless_one_is_named(system):
    transport, notices = MemoryTransport(), []
    vehicle = Vehicle(Link(transport, system=system), 5.0)
    vehicle.on_notice = notices.append
    two = Sender(2)
    for sender in (Sender(1), two, Sender(255, 190)):
        transport.waiting.append(sender.frame(heartbeat()))
    version = mav.MAVLink_autopilot_version_message(*(0,) * 5, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)
    transport.waiting.append(two.frame(version))
    if system is None:
        with pytest.raises(
            UserError, match=r"2 autopilots .*PX4, system 1; PX4, system 2.*--system 1 or --system 2"
        ):
            vehicle.connect(5.0)
    else:
        vehicle.connect(5.0)
        assert vehicle.link.target_system == 2
        assert notices == ["another autopilot is heard on this link (PX4, system 1); we fly PX4, system 2"]
