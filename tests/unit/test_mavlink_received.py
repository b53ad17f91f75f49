"""`read` accepts, refuses and understands what pymavlink's `decode` does, and that for any bytes."""

from __future__ import annotations

import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavlink_wire import Sender, attitude, mav

from companion.mavlink.layouts import LAYOUTS
from companion.mavlink.packed import packed
from companion.mavlink.received import Received, read

NUMBERS = sorted(mav.mavlink_map)
OURS = {name for name in dir(Received) if not name.startswith("__")}


def framed(number, payload, version1=False, signed=False, extra=b"\0" * 13):
    """A frame whose checksum is right for its payload."""
    if version1:
        body = bytes([len(payload), 3, 7, 1, number & 0xFF]) + payload
        number &= 0xFF
    else:
        body = bytes([len(payload), int(signed), 0, 3, 7, 1]) + number.to_bytes(3, "little") + payload
    kind = mav.mavlink_map.get(number)
    checksum = mav.x25crc(body + bytes([kind.crc_extra if kind else 0])).crc
    frame = (b"\xfe" if version1 else b"\xfd") + body + checksum.to_bytes(2, "little")
    return frame + extra if signed and not version1 else frame


def by_pymavlink(frame):
    """pymavlink's message, None where it refuses the frame."""
    try:
        return mav.MAVLink(None).decode(bytearray(frame))
    except mav.MAVError:
        return None


def assert_same(frame):
    """Both refuse, or both have the same header and the same fields."""
    ours, theirs = read(frame), by_pymavlink(frame)
    assert (ours is None) == (theirs is None), frame.hex()
    if ours is None:
        return False
    assert ours.unknown == (theirs.get_msgId() == mav.MAVLINK_MSG_ID_UNKNOWN)
    assert ours.get_type() == theirs.get_type()
    if not ours.unknown:  # of those pymavlink does not read the header
        assert ours.get_msgId() == theirs.get_msgId()
        assert ours.get_seq() == theirs.get_seq()
        assert ours.get_srcSystem() == theirs.get_srcSystem()
        assert ours.get_srcComponent() == theirs.get_srcComponent()
        for name in theirs.get_fieldnames():
            assert repr(getattr(ours, name)) == repr(getattr(theirs, name)), (ours.get_type(), name)
        assert ours.boot_ms == getattr(theirs, "time_boot_ms", None)
    return True


FRAMES = st.builds(
    framed,
    st.sampled_from(NUMBERS) | st.integers(0, 2**24 - 1),
    st.binary(max_size=255),
    st.booleans(),
    st.booleans(),
    st.binary(min_size=13, max_size=13),
)


@given(FRAMES)
def test_a_whole_frame_of_any_content_is_read_as_pymavlink_reads_it(frame):
    assert assert_same(frame)


@given(FRAMES, st.lists(st.tuples(st.integers(0, 300), st.integers(0, 255)), max_size=3), st.integers(-3, 3))
def test_a_damaged_frame_is_refused_where_pymavlink_refuses_it(frame, changes, cut):
    damaged = bytearray(frame)
    for place, value in changes:
        damaged[place % len(damaged)] = value
    damaged = damaged[:cut] if cut < 0 else damaged + bytes(cut)
    if damaged:
        assert_same(bytes(damaged))


@given(st.sampled_from((b"\xfe", b"\xfd", b"\0")), st.binary(max_size=300))
def test_any_bytes(start, noise):
    assert_same(start + noise)


@pytest.mark.parametrize("kept", [None, 1, 7])
def test_every_message_of_the_dialect(kept):
    """Payloads whole and cut, which zeros make up for; the time stamp may be what is cut."""
    for number in NUMBERS:
        payload = bytes((37 * k + number) % 256 for k in range(mav.mavlink_map[number].unpacker.size))
        assert assert_same(framed(number, payload[:kept]))


def test_no_field_of_the_dialect_hides_behind_a_name_of_ours():
    assert not {name for layout in LAYOUTS.values() for name in layout.names} & OURS


def test_a_field_that_the_message_has_not_raises():
    message = read(Sender().frame(attitude(10)))
    assert message.q1 == 1.0
    with pytest.raises(AttributeError, match="ATTITUDE_QUATERNION has no field lat"):
        _ = message.lat


def test_packs_every_message_as_pymavlink_does():
    """Each message without text, read from a payload drawn, packed again: with zeros at the end and without."""
    draw = random.Random(20261126)
    codec = mav.MAVLink(None, srcSystem=9, srcComponent=191)
    for number in (number for number in NUMBERS if LAYOUTS[number].plain):
        for kept in (None, 3):
            codec.seq = draw.randrange(256)
            payload = draw.randbytes(mav.mavlink_map[number].unpacker.size)[:kept]
            message = by_pymavlink(framed(number, payload))
            assert packed(message, codec) == bytes(message.pack(codec)), message.get_type()


def test_a_number_that_does_not_fit_is_refused_as_by_pymavlink():
    with pytest.raises(struct.error):
        packed(mav.MAVLink_timesync_message(1 << 64, 0), mav.MAVLink(None))
