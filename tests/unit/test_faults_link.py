"""Faults of the link, seen from the wire: what a client gets, and what of its own arrives."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from fault_client import inject, px4, with_faults
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stub_client import MemoryClient

from sitl_stub.firmware.px4.modes import Mode
from sitl_stub.mavlink.codec import FrameReader

ATTITUDE_S = 0.01


def times_of(client: MemoryClient, seconds: float) -> list[tuple[float, float]]:
    """(when it arrived, its own time) of every ATTITUDE of the next seconds, s."""
    found = []
    end = client.autopilot.time_us + round(seconds * 1e6)
    while client.autopilot.time_us < end:
        client.autopilot.step()
        now = client.autopilot.time_us * 1e-6
        found += [(now, message.time_boot_ms * 1e-3) for message in client.take("ATTITUDE")]
    return found


def ping(client: MemoryClient, number: int) -> None:
    client.send(mavlink.MAVLink_ping_message(0, number, 0, 0))


def answered(client: MemoryClient) -> list[int]:
    return [message.seq for message in client.take("PING") if message.target_system == 255]


def test_loss_silences_the_autopilot_for_its_time_and_sequence_numbers_tell() -> None:
    client = px4({"kind": "link_loss", "at_s": 1.0, "for_s": 0.5, "direction": "to_client"})
    client.advance(0.99)
    last_before = client.link.frames[-1][4]
    assert client.take() != []
    client.advance(0.02)
    assert [m.text for m in client.take("STATUSTEXT")] == ["fault: link_loss on"]
    client.advance(0.48)
    assert client.take() == []
    client.advance(0.05)
    frames = client.link.frames
    assert (frames[0][4] - last_before) % 256 > 50  # told of what was lost
    assert [m.text for m in client.take("STATUSTEXT")] == ["fault: link_loss off"]


def test_loss_in_one_direction_leaves_the_other() -> None:
    client = px4()
    client.advance(0.5)
    inject(client, "link_loss", direction="from_client")
    client.advance(0.1)
    client.take()
    received = client.link.counters.received
    ping(client, 1)
    client.advance(0.1)
    seen = client.take()
    assert len(seen) > 10 and not any(m.name == "PING" and m.target_system == 255 for m in seen)
    assert client.link.counters.received == received
    assert client.autopilot.faults is not None
    client.autopilot.faults.clear()
    ping(client, 2)
    assert answered(client) == [2]


def test_lost_setpoints_end_in_the_offboard_failsafe() -> None:
    client = px4({"kind": "link_loss", "after": "airborne", "at_s": 6.0, "direction": "from_client"})
    client.advance(2.0)
    client.advance(0.5, every=lambda: client.position(0, 0, -3))
    client.set_mode(Mode.OFFBOARD)
    client.command("COMPONENT_ARM_DISARM", 1)
    client.advance(10.0, every=lambda: client.position(0, 0, -3))
    modes = {m.custom_mode >> 16 & 0xFF for m in client.take("HEARTBEAT")[-2:]}
    assert modes == {4}  # AUTO: it returns


def test_delay_is_that_long_both_ways_and_keeps_the_order_when_it_ends() -> None:
    client = px4({"kind": "link_delay", "at_s": 1.0, "for_s": 1.5, "delay_s": 0.205})
    client.advance(1.3)
    client.take()
    late = times_of(client, 0.5)
    assert len(late) == 50
    assert {round(now - own, 3) for now, own in late} == {0.206}  # to the next control period of 2 ms
    sent_us = client.autopilot.time_us
    ping(client, 1)
    assert answered(client) == []
    while not answered(client):
        client.autopilot.step()
    assert client.autopilot.time_us - sent_us == 412_000
    around_the_end = times_of(client, 1.0)
    own_times = [own for _, own in around_the_end]
    assert own_times == sorted(own_times) and len(own_times) > 110
    after = [now - own for now, own in around_the_end if now > 2.5]
    assert len(after) > 50 and max(after) < 0.001


def test_jitter_varies_the_lateness_within_its_bound_in_order() -> None:
    client = px4({"kind": "link_jitter", "jitter_s": 0.05, "direction": "to_client"})
    seen = times_of(client, 3.0)
    late = [now - own for now, own in seen]
    assert 0.0 <= min(late) < 0.025 and 0.035 < max(late) <= 0.0511
    assert [own for _, own in seen] == sorted(own for _, own in seen)


def test_duplicates_are_the_same_frame_twice() -> None:
    client = px4({"kind": "link_duplicate", "probability": 0.5, "direction": "to_client"})
    client.advance(2.0)
    frames = client.link.frames
    doubled = sum(a == b for a, b in itertools.pairwise(frames))
    assert 0.25 < doubled / len(frames) < 0.42  # a third of all frames that arrive


def test_reordered_frames_are_overtaken_and_none_is_lost() -> None:
    plain, client = px4(), px4({"kind": "link_reorder", "probability": 0.2, "direction": "to_client"})
    expected = [own for _, own in times_of(plain, 2.0)]
    own_times = [own for _, own in times_of(client, 2.1)]
    assert own_times != sorted(own_times)
    assert sorted(own_times)[: len(expected)] == expected


def test_corrupt_frames_fail_their_checksum_both_ways() -> None:
    client = px4({"kind": "link_corrupt", "probability": 0.5, "bits": 3})
    client.advance(2.0)
    reader = FrameReader()
    good = [m for frame in client.link.frames for m in reader.read_datagram(frame)]
    bad = reader.counters.dropped + reader.counters.garbage_bytes
    assert bad > 100 and 0.4 < len(good) / len(client.link.frames) < 0.6
    for number in range(100):
        ping(client, number)
    c = client.link.counters
    assert 30 < c.received < 70
    assert c.bad_checksum + c.truncated + c.unknown + c.garbage_bytes > 20


def test_truncated_frames_are_shorter_and_counted() -> None:
    client = px4({"kind": "link_truncate", "probability": 0.5})
    client.advance(1.0)
    reader = FrameReader()
    good = [m for frame in client.link.frames for m in reader.read_datagram(frame)]
    assert reader.counters.truncated > 50
    assert 0.4 < len(good) / len(client.link.frames) < 0.6
    for number in range(100):
        ping(client, number)
    assert client.link.counters.truncated > 20


def test_lost_acknowledgements_hide_a_command_that_was_obeyed() -> None:
    client = px4({"kind": "ack_loss", "for_s": 3.0})
    client.advance(2.0)
    assert client.command("COMPONENT_ARM_DISARM", 1) == []
    assert client.autopilot.armed
    client.advance(2.0)
    assert client.command("COMPONENT_ARM_DISARM", 0) == [0]


def test_lost_parameters_leave_holes_that_a_read_fills() -> None:
    client = px4({"kind": "parameter_loss", "probability": 0.2, "for_s": 3.0})
    client.advance(0.1)
    client.send(mavlink.MAVLink_param_request_list_message(1, 1))
    client.advance(3.0)
    got = {m.param_index for m in client.take("PARAM_VALUE")} - {65535}
    missing = set(range(884)) - got
    assert 0.15 < len(missing) / 884 < 0.25
    for index in missing:
        client.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", index))
    assert {m.param_index for m in client.take("PARAM_VALUE")} == missing


@pytest.mark.parametrize(
    "fault",
    [
        {"kind": "link_loss", "probability": 0.3},
        {"kind": "link_jitter"},
        {"kind": "link_duplicate"},
        {"kind": "link_reorder"},
        {"kind": "link_corrupt"},
        {"kind": "link_truncate"},
        {"kind": "parameter_loss"},
    ],
    ids=lambda fault: fault["kind"],
)
def test_the_seed_decides(fault: dict[str, Any]) -> None:
    def frames(seed: int) -> list[list[bytes]]:
        """What has come by each of 100 moments."""
        client = with_faults(MemoryClient(), fault, seed=seed)
        client.send(mavlink.MAVLink_param_request_list_message(1, 1))
        moments = []
        for _ in range(100):
            client.advance(0.01)
            moments.append(list(client.link.frames))
        return moments

    first = frames(1)
    assert frames(1) == first
    assert frames(2) != first


def test_a_director_without_faults_changes_no_byte() -> None:
    plain, directed = MemoryClient(seed=4), MemoryClient(seed=4)
    with_faults(directed)
    for client in (plain, directed):
        client.in_the_air()
    assert plain.link.frames == directed.link.frames
