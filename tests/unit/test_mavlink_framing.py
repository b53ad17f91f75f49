"""Frames out of bytes: any split, noise between, false starts, and datagrams that end too early."""

from __future__ import annotations

import itertools
import random

from hypothesis import given
from hypothesis import strategies as st
from mavlink_wire import Sender, attitude, heartbeat, local_position, mav

from companion.mavlink.framing import Framer, frame_length

UNKNOWN_ID = 410  # PX4 1.17 sends it, the dialect does not have it


def unknown_frame(sequence, payload=b"\x01\x02\x03"):
    header = bytes([0xFD, len(payload), 0, 0, sequence, 1, 1, UNKNOWN_ID & 0xFF, UNKNOWN_ID >> 8, 0])
    return header + payload + b"\x12\x34"


def traffic(count):
    """Frames of several lengths, MAVLink 1 and 2, one of an unknown message."""
    autopilot = Sender()
    frames = []
    for index in range(count):
        if index % 5 == 4:
            autopilot.skip(1)
            frames.append(unknown_frame(index % 256))
            continue
        message = (heartbeat(), attitude(index), local_position(index, (1.0, 2.0, 3.0)))[index % 3]
        packed = message.pack(autopilot.codec, force_mavlink1=index % 7 == 3)
        autopilot.skip(1)
        frames.append(bytes(packed))
    return frames


def drain(framer):
    """Believed frames, as the link believes them: by their checksum."""
    codec = mav.MAVLink(None)
    frames = []
    while (frame := framer.next_frame()) is not None:
        try:
            codec.decode(bytearray(frame))
        except mav.MAVError:
            framer.reject()
        else:
            frames.append(bytes(frame))
    return frames


def by_stream(chunks):
    framer, frames = Framer(mav.mavlink_map, stream=True), []
    for chunk in chunks:
        framer.feed(chunk)
        frames += drain(framer)
    return frames, framer


def split_at(data, cuts):
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


FRAMES = traffic(12)
PLAIN_NOISE = st.binary(max_size=20).map(lambda noise: noise.replace(b"\xfd", b"\0").replace(b"\xfe", b"\0"))


@given(st.lists(st.integers(0, 600), max_size=40))
def test_any_split_gives_the_same_frames(cuts):
    data = b"".join(FRAMES) + b"\0"  # the byte behind the last frame of an unknown message
    frames, _ = by_stream(split_at(data, cuts))
    known = [frame for frame in FRAMES if unknown_frame(0)[7:10] != frame[7:10]]
    assert [frame for frame in frames if frame in known] == known
    assert frames == by_stream([data])[0] == by_stream([bytes([byte]) for byte in data])[0]


@given(st.lists(PLAIN_NOISE, min_size=len(FRAMES), max_size=len(FRAMES)), st.integers(1, 64))
def test_noise_between_frames_costs_no_frame(noises, size):
    """Of messages we know: nobody can tell that an unknown one's checksum is right."""
    known = [frame for frame in FRAMES if frame[7:10] != unknown_frame(0)[7:10]]
    data = b"".join(noise + frame for noise, frame in zip(noises, known, strict=False))
    frames, framer = by_stream(data[at : at + size] for at in range(0, len(data), size))
    assert frames == known
    assert framer.stray_bytes == len(data) - sum(len(frame) for frame in known)


@given(st.binary(max_size=400), st.lists(st.integers(0, 400), max_size=20))
def test_noise_of_any_bytes_does_not_depend_on_the_split(noise, cuts):
    data = noise + b"".join(FRAMES) + noise
    assert by_stream(split_at(data, cuts))[0] == by_stream([data])[0]


def test_false_start_costs_its_byte_only():
    """A start byte that promises 200 bytes of a message we know, in front of two good frames and behind them."""
    first, second = FRAMES[0], FRAMES[1]
    promise = bytes([0xFD, 200, 0, 0, 7, 1, 1, 0, 0, 0])
    frames, framer = by_stream([promise + first + promise + second + b"\0" * 300])
    assert frames == [first, second]
    assert framer.stray_bytes >= 2 * len(promise)


def test_noise_full_of_start_bytes():
    """Wire noise in which every eighth byte starts a frame: fewer than one frame in fifty is lost."""
    random_bytes = random.Random(5)
    frames = [frame for frame in traffic(1500) if frame[7:10] != unknown_frame(0)[7:10]]
    data = bytearray()
    for frame in frames:
        for _ in range(random_bytes.randrange(12)):
            data.append(random_bytes.choice((0xFD, 0xFE, *(random_bytes.randrange(253) for _ in range(14)))))
        data += frame
    found, _ = by_stream(bytes(data[at : at + 100]) for at in range(0, len(data), 100))
    good = set(frames)
    assert len([frame for frame in found if frame in good]) > 0.98 * len(frames)


def test_flags_nobody_knows_are_no_frame():
    good = bytearray(FRAMES[0])
    assert frame_length(good, 0) == len(good)
    good[2] = 0x02
    assert frame_length(good, 0) == 0
    good[2] = 0x01
    assert frame_length(good, 0) == len(good) + 13  # signed


def test_frame_length_waits_for_what_it_needs():
    assert frame_length(b"\x00", 0) == 0
    assert frame_length(b"\xfd", 0) is None
    assert frame_length(b"\xfd\x09", 0) is None
    assert frame_length(b"\xfe", 0) is None
    assert frame_length(b"\xfe\x09", 0) == 17


def datagrams(*chunks):
    framer = Framer(mav.mavlink_map, stream=False)
    for chunk in chunks:
        framer.feed(chunk)
    return drain(framer), framer


@given(st.integers(0, len(FRAMES[1]) - 1), st.booleans())
def test_truncated_datagram_does_not_swallow_the_next(kept, turned_round):
    cut = FRAMES[1][:kept]
    order = (FRAMES[0], cut, FRAMES[2]) if turned_round else (cut, FRAMES[0], FRAMES[2])
    frames, framer = datagrams(*order)
    assert frames == [FRAMES[0], FRAMES[2]]
    assert framer.stray_bytes == kept


def test_several_frames_in_a_datagram_and_an_unknown_one_at_its_end():
    unknown = unknown_frame(3)
    frames, framer = datagrams(FRAMES[0] + b"\xfd\xff" + FRAMES[1] + unknown, FRAMES[2])
    assert frames == [FRAMES[0], FRAMES[1], unknown, FRAMES[2]]
    assert framer.stray_bytes == 2


@given(st.binary(max_size=3000))
def test_any_datagram_is_survived(noise):
    frames, _ = datagrams(noise, FRAMES[0])
    assert frames[-1] == FRAMES[0]


def test_a_serial_bridges_packets_lose_no_frame():
    """Packets of any size, as a serial-to-UDP bridge fills them; frames of another sender's packets are not mixed in."""
    known = [frame for frame in traffic(200) if frame[7:10] != unknown_frame(0)[7:10]]
    data = b"".join(known)
    for size in (7, 64, 256):
        framer, frames = Framer(mav.mavlink_map, stream=False), []
        for at in range(0, len(data), size):
            framer.feed(data[at : at + size], "bridge")
            frames += drain(framer)
        assert frames == known, size
        assert framer.stray_bytes == 0


def test_another_senders_datagram_does_not_end_a_frame():
    framer = Framer(mav.mavlink_map, stream=False)
    framer.feed(FRAMES[1][:10], "one")
    assert drain(framer) == []
    framer.feed(FRAMES[1][10:] + FRAMES[0], "two")
    assert drain(framer) == [FRAMES[0]]
