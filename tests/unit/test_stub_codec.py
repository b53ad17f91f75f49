"""The stub's own frame code against pymavlink's, and against broken input."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl_stub.mavlink.codec import (
    LAYOUTS,
    NEWER_MESSAGES,
    FrameReader,
    FrameWriter,
    LinkCounters,
    pack_fields,
)

unit = st.floats(-1e6, 1e6, width=32)


def _attitude(time_ms: int = 5, roll: float = 0.25) -> mavlink.MAVLink_attitude_message:
    return mavlink.MAVLink_attitude_message(time_ms, roll, -0.5, 1.5, 0.0, 0.125, 0.0)


def test_the_message_table_is_pymavlinks() -> None:
    """Where this fails after an update of pymavlink: python scripts/message_table.py."""
    for message_id, cls in mavlink.mavlink_map.items():
        layout = LAYOUTS[cls.msgname]
        assert (layout.message_id, layout.crc_extra) == (message_id, cls.crc_extra)
        assert (layout.packer.format, layout.fields) == (cls.unpacker.format, tuple(cls.ordered_fieldnames))
        types = dict(zip(cls.fieldnames, cls.fieldtypes, strict=True))
        lengths = zip(cls.ordered_fieldnames, cls.array_lengths, strict=True)
        assert layout.array_lengths == tuple(-1 if types[name] == "char" else n for name, n in lengths)


@given(st.lists(unit, min_size=4, max_size=4), unit, st.integers(0, 255), st.booleans())
def test_reads_what_pymavlink_packs(q: list[float], thrust: float, mask: int, old: bool) -> None:
    message = mavlink.MAVLink_set_attitude_target_message(7, 1, 0, mask, q, 0.5, 0.25, -2.0, thrust)
    frame = message.pack(mavlink.MAVLink(None, 12, 34), force_mavlink1=old)
    (read,) = FrameReader().read_datagram(bytes(frame))
    assert (read.name, read.system, read.component, read.mavlink_version) == (
        "SET_ATTITUDE_TARGET",
        12,
        34,
        2 - old,
    )
    assert list(read.q) == q
    assert (read.thrust, read.type_mask, read.body_yaw_rate, read.time_boot_ms) == (thrust, mask, -2.0, 7)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("ATTITUDE", {"time_boot_ms": 9, "roll": 0.5, "yawspeed": -1.25}),
        ("PARAM_VALUE", {"param_id": "MPC_THR_HOVER", "param_value": 0.5, "param_count": 9, "param_type": 9}),
        ("STATUSTEXT", {"severity": 4, "text": "hello"}),
        ("BATTERY_STATUS", {"voltages": [12000, 65535], "battery_remaining": 55}),
        ("COMMAND_ACK", {"command": 400, "result": 4, "target_system": 255, "target_component": 190}),
        ("HOME_POSITION", {"latitude": 1, "q": [1.0, 0.0, 0.0, 0.0], "time_usec": 77}),
        ("GPS_RAW_INT", {"time_usec": 5, "fix_type": 3, "alt_ellipsoid": 99}),
        ("HIGHRES_IMU", {"time_usec": 5, "zacc": -9.75, "id": 1}),
        ("SERVO_OUTPUT_RAW", {"servo1_raw": 1500, "servo16_raw": 900}),
        ("SYS_STATUS", {"onboard_control_sensors_health": 1 << 28, "battery_remaining": -1}),
        ("TIMESYNC", {"tc1": 1, "ts1": 2}),
        ("ATTITUDE_QUATERNION", {"q1": 1.0}),
        ("DISTANCE_SENSOR", {"current_distance": 250, "orientation": 25}),
        ("SCALED_PRESSURE", {"press_abs": 955.5}),
        ("MISSION_CURRENT", {"seq": 3}),
        ("SIM_STATE", {"q1": 1.0}),
        ("AUTOPILOT_VERSION", {"uid": 5}),
        ("GPS_GLOBAL_ORIGIN", {"altitude": 4, "time_usec": 6}),
    ],
)
def test_pymavlink_reads_what_it_packs(version: int, name: str, fields: dict[str, object]) -> None:
    layout = LAYOUTS[name]
    frame = FrameWriter(3, 4, version).frame(layout, pack_fields(layout, fields))
    read = mavlink.MAVLink(None).decode(bytearray(frame))
    assert (read.get_type(), read.get_srcSystem(), read.get_srcComponent()) == (name, 3, 4)
    # what MAVLink 1 cannot carry is the message's extension fields, zero here or in this table of extensions
    extensions = (
        {"target_system", "target_component", "time_usec", "servo16_raw", "alt_ellipsoid", "id"}
        if version == 1
        else ()
    )
    for key, value in fields.items():
        if key in extensions and not (name in ("HIGHRES_IMU", "GPS_RAW_INT") and key == "time_usec"):
            continue
        got = getattr(read, key)
        if isinstance(value, list):
            assert list(got)[: len(value)] == value
        else:
            assert got == value


def test_mavlink1_payload_lengths_are_pymavlinks_for_every_message_it_sends() -> None:
    from sitl_stub.firmware.px4.build import build_px4

    for definition in build_px4().streams.definitions.values():
        layout = definition.layout
        if layout.message_id > 255 or layout.name in NEWER_MESSAGES:
            continue
        zeros = layout.packer.unpack(bytes(layout.packer.size))
        ours = FrameWriter(1, 1, 1).frame(layout, zeros)
        theirs = mavlink.mavlink_map[layout.message_id](*_zero_arguments(layout.message_id)).pack(
            mavlink.MAVLink(None, 1, 1), force_mavlink1=True
        )
        # pymavlink puts extension fields into MAVLink 1 frames as well; the fields before them must lie the same
        assert ours[1] <= theirs[1], layout.name
        assert ours[6 : 6 + ours[1]] == bytes(theirs[6 : 6 + ours[1]])


def _zero_arguments(message_id: int) -> list[object]:
    cls = mavlink.mavlink_map[message_id]
    arguments: list[object] = []
    for name in cls.fieldnames:
        index = cls.ordered_fieldnames.index(name)
        length = cls.array_lengths[index]
        is_text = cls.fieldtypes[cls.fieldnames.index(name)] == "char"
        arguments.append(b"" if is_text else [0] * length if length else 0)
    return arguments


def test_truncated_datagram_does_not_swallow_the_next() -> None:
    frame = bytes(_attitude().pack(mavlink.MAVLink(None, 1, 1)))
    reader = FrameReader()
    assert reader.read_datagram(frame[:-3]) == []
    assert [m.roll for m in reader.read_datagram(frame)] == [0.25]
    assert (reader.counters.truncated, reader.counters.received) == (1, 1)


def test_several_frames_and_garbage_in_one_datagram() -> None:
    packer = mavlink.MAVLink(None, 1, 1)
    first, second = (bytes(_attitude(roll=value).pack(packer)) for value in (0.5, 0.75))
    reader = FrameReader()
    assert [m.roll for m in reader.read_datagram(b"\x00junk" + first + b"\xfd" + second)] == [0.5, 0.75]


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 400), max_size=6))
def test_stream_gives_the_same_however_it_is_cut(seed: int, cuts: list[int]) -> None:
    packer = mavlink.MAVLink(None, 1, 1)
    data = b"".join(bytes(_attitude(time_ms=i, roll=i / 8).pack(packer)) for i in range(8))
    reader, got = FrameReader(), []
    for cut in [*sorted({0, *(c % len(data) for c in cuts)}), len(data)]:
        got.append(cut)
    messages = [m for a, b in itertools.pairwise(got) for m in reader.read_stream(data[a:b])]
    assert [m.time_boot_ms for m in messages] == list(range(8))


def test_mutated_frames_are_counted_never_raised() -> None:
    generator = random.Random(1)
    packer = mavlink.MAVLink(None, 1, 1)
    frames = [
        bytes(_attitude().pack(packer)),
        bytes(mavlink.MAVLink_param_set_message(1, 1, b"MC_ROLL_P", math.pi, 9).pack(packer)),
        bytes(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(packer, force_mavlink1=True)),
    ]
    reader = FrameReader(LinkCounters())
    fed = 20_000
    for _ in range(fed):
        frame = bytearray(generator.choice(frames))
        for _ in range(generator.randint(1, 4)):
            frame[generator.randrange(len(frame))] = generator.randrange(256)
        del frame[generator.randint(0, len(frame)) :]
        reader.read_datagram(bytes(frame))
    counters = reader.counters
    assert counters.bad_checksum + counters.truncated + counters.unknown + counters.garbage_bytes > fed // 2
    assert counters.received < fed * 0.02  # a mutation that changed nothing, or a checksum hit by chance
