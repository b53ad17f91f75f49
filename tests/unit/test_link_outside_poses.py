"""Poses from outside: both forms of the datagram, checks, time, frames. Expected values worked out by hand."""

import json
import math
import select
import socket
import struct
from contextlib import suppress
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.errors import UserError
from companion.mavlink.link import mav
from companion.mavlink.outside_poses import OutsidePoses
from companion.mavlink.pose_datagram import BadPose, OutsidePose, pack_pose, parse_pose

LEVEL_EAST = (1.0, 0.0, 0.0, 0.0)  # nose to the east, level, in ENU/FLU


class Clock:
    """Our clock, moved by hand."""

    def __init__(self) -> None:
        self.s = 1000.0

    def __call__(self) -> int:
        return round(self.s * 1e9)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def poses(clock: Clock):
    listener = OutsidePoses(("127.0.0.1", 0), rate_hz=50.0, now_ns=clock)
    yield listener
    listener.close()


def datagram(time_s, position=(1.0, 2.0, 3.0), quaternion=LEVEL_EAST, **more) -> bytes:
    fields = {"time_s": time_s, "position_enu": list(position), "quaternion_wxyz": list(quaternion), **more}
    return json.dumps(fields).encode()


def test_position_and_attitude_in_ned_frd(poses: OutsidePoses) -> None:
    message = poses.take(datagram(5.0))
    assert (message.x, message.y, message.z) == (2.0, 1.0, -3.0)
    # Nose to the east is a heading of 90° clockwise from north: q = (cos 45°, 0, 0, sin 45°)
    half = math.sqrt(0.5)
    assert np.abs(message.q) == pytest.approx([half, 0.0, 0.0, half])
    assert message.q[0] * message.q[3] > 0
    assert (message.frame_id, message.child_frame_id) == (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_FRD)
    assert math.isnan(message.vx) and math.isnan(message.pose_covariance[0])
    assert message.estimator_type == mav.MAV_ESTIMATOR_TYPE_VISION


def test_banked_right_heading_north(poses: OutsidePoses) -> None:
    # ENU/FLU: yaw 90° (north), roll +20° (right side down): q = q_z(90°) q_x(20°)
    c, s = math.cos(math.radians(10.0)), math.sin(math.radians(10.0))
    half = math.sqrt(0.5)
    message = poses.take(datagram(1.0, quaternion=(half * c, half * s, half * s, half * c)))
    assert list(message.q) == pytest.approx([c, s, 0.0, 0.0])  # NED/FRD: heading 0, roll +20°


def test_ardupilot_gets_its_frame_and_a_velocity(poses: OutsidePoses, clock: Clock) -> None:
    poses.local_ned = False
    first = poses.take(datagram(1.0, (0.0, 0.0, 1.0)))
    assert first.frame_id == mav.MAV_FRAME_LOCAL_FRD and (first.vx, first.vy, first.vz) == (0.0, 0.0, 0.0)
    clock.s += 0.1
    second = poses.take(datagram(1.1, (0.2, 0.1, 1.05)))
    # 2 m/s to the east is ahead, 1 m/s to the north is left, 0.5 m/s up
    assert (second.vx, second.vy, second.vz) == pytest.approx((2.0, -1.0, -0.5))


def test_a_velocity_of_the_source_goes_to_both_in_the_bodys_axes(poses: OutsidePoses, clock: Clock) -> None:
    north = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # nose to the north
    for k, local_ned in enumerate((True, False)):
        poses.local_ned = local_ned
        clock.s += 0.1
        sent = poses.take(datagram(0.1 * k, quaternion=north, velocity_enu=[1.0, 2.0, 0.5]))
        # 2 m/s to the north is ahead, 1 m/s to the east is right
        assert (sent.vx, sent.vy, sent.vz) == pytest.approx((2.0, 1.0, -0.5))


def test_covariance_is_turned_with_the_frames(poses: OutsidePoses) -> None:
    matrix = np.zeros((6, 6))
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = 1.0, 4.0, 9.0  # east, north, up
    matrix[0, 2] = matrix[2, 0] = 0.5
    matrix[3, 3], matrix[4, 4], matrix[5, 5] = 0.1, 0.2, 0.3  # about forward, left, up
    matrix[1, 4] = matrix[4, 1] = 0.25
    triangle = matrix[np.triu_indices(6)].tolist()
    sent = np.array(poses.take(datagram(1.0, covariance=triangle)).pose_covariance)
    turned = np.zeros((6, 6))
    turned[np.triu_indices(6)] = sent
    assert np.diag(turned) == pytest.approx([4.0, 1.0, 9.0, 0.1, 0.2, 0.3])  # north, east, down
    assert turned[1, 2] == pytest.approx(-0.5)  # east with down: up changed its sign
    assert turned[0, 4] == pytest.approx(-0.25)  # north with the right axis: left changed its sign


def test_time_is_ours_by_the_quickest_datagram(poses: OutsidePoses, clock: Clock) -> None:
    """The source's clock is 900 s behind ours; datagrams take 2 ms and more."""
    times = []
    for k, delay_s in enumerate([0.006, 0.002, 0.050, 0.004]):
        clock.s = 1000.0 + 0.02 * k + delay_s
        times.append(poses.take(datagram(100.0 + 0.02 * k)).time_usec * 1e-6)
    assert times[0] == pytest.approx(1000.006)  # nothing better known yet
    assert times[1:] == pytest.approx([1000.022, 1000.042, 1000.062])


def test_a_clock_that_drifts_is_followed(poses: OutsidePoses, clock: Clock) -> None:
    for k in range(3000):  # a minute; the source's clock runs 100 ppm fast
        clock.s = 1000.0 + 0.02 * k + 0.001
        message = poses.take(datagram((1.0 + 1e-4) * 0.02 * k))
        assert abs(message.time_usec * 1e-6 - clock.s) < 0.001


@pytest.mark.parametrize("drift", [0.01, -0.01])
def test_a_clock_that_drifts_by_a_percent_is_followed(
    poses: OutsidePoses, clock: Clock, drift: float
) -> None:
    for k in range(1000):
        clock.s = 1000.0 + 0.02 * k + 0.001 + (0.004 if k % 3 else 0.0)
        message = poses.take(datagram((1.0 + drift) * 0.02 * k))
        if message is not None:
            assert abs(message.time_usec * 1e-6 - (1000.001 + 0.02 * k)) < 0.005


@pytest.mark.parametrize("source_hz", [50, 60, 100, 120, 200])
def test_the_rate_is_limited_to_what_was_asked_for_and_not_lower(
    poses: OutsidePoses, clock: Clock, source_hz: int
) -> None:
    sent = 0
    for k in range(5 * source_hz):
        clock.s = 1000.0 + k / source_hz
        sent += poses.take(datagram(k / source_hz)) is not None
    assert 240 <= sent <= 251
    assert poses.counters["pose above the rate"] == 5 * source_hz - sent
    assert poses.counters["forwarded"] == sent


def test_our_time_never_goes_back_while_it_settles(poses: OutsidePoses, clock: Clock) -> None:
    delays = [0.15, 0.12, 0.12, 0.05, 0.05, 0.001, 0.03, 0.001, 0.02, 0.001]
    stamps = []
    for k, delay in enumerate(delays):
        clock.s = max(clock.s, 1000.0 + 0.02 * k + delay)
        message = poses.take(datagram(0.02 * k))
        stamps += [message.time_usec] if message is not None else []
    assert len(stamps) >= 3
    assert all(b > a for a, b in pairwise(stamps))


def test_late_repeated_and_reordered_poses_are_dropped(poses: OutsidePoses, clock: Clock) -> None:
    assert poses.take(datagram(1.0)) is not None
    clock.s += 0.02
    assert poses.take(datagram(1.0)) is None
    assert poses.take(datagram(0.98)) is None
    assert poses.counters["pose repeated or out of order"] == 2
    clock.s += 0.5
    assert poses.take(datagram(1.2)) is None  # 0.5 s late − 0.18 s that passed at the source
    assert poses.counters["pose too late"] == 1
    assert [n for n in poses.notices if "too late" in n]


def test_one_bad_fit_is_dropped_and_a_moved_origin_is_told(poses: OutsidePoses, clock: Clock) -> None:
    def at(k: int, x: float, **more) -> object:
        clock.s = 1000.0 + 0.02 * k
        return poses.take(datagram(0.02 * k, (x, 0.0, 0.0), **more))

    assert at(0, 0.0).reset_counter == 0
    assert at(1, 3.0) is None
    assert at(2, 0.01).reset_counter == 0
    assert [at(k, 3.0) for k in range(3, 7)] == [None] * 4
    assert at(7, 3.0).reset_counter == 1
    assert at(8, 3.01).reset_counter == 1
    assert at(9, -2.0, reset_counter=1).reset_counter == 2  # the source says so itself
    assert poses.counters["pose jumped"] == 5


def test_a_restarted_source_is_heard_again(poses: OutsidePoses, clock: Clock) -> None:
    assert poses.take(datagram(500.0)) is not None
    clock.s += 2.0
    message = poses.take(datagram(0.1, (4.0, 0.0, 0.0)))
    assert message.time_usec == pytest.approx(clock.s * 1e6, abs=1)
    assert message.reset_counter == 1


def test_silence_is_told_once_and_the_return_too(poses: OutsidePoses, clock: Clock) -> None:
    poses.take(datagram(1.0))
    poses.notices.clear()
    for _ in range(10):
        clock.s += 0.1
        poses.poll()
    assert list(poses.notices) == ["poses from outside: none for 0.5 s; is the vehicle in view?"]
    poses.take(datagram(2.0))
    assert poses.notices[-1] == "poses from outside: back after 1.0 s"


def test_over_a_socket_both_forms(poses: OutsidePoses, clock: Clock) -> None:
    binary = struct.pack("<4s8d", b"POS1", 1.02, 1.1, 2.0, 3.0, *LEVEL_EAST)
    messages: list = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as source:
        for data, taken in (
            (datagram(1.0), "forwarded"),
            (binary, "forwarded"),
            (b"\x00", "pose not readable"),
        ):
            clock.s += 0.02
            before = poses.counters[taken]
            source.sendto(data, poses.address)
            select.select([poses], [], [], 5.0)
            messages += poses.poll()
            assert poses.counters[taken] == before + 1
    assert [round(m.y, 6) for m in messages] == [1.0, 1.1]


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "not readable"),
        (b"[1, 2]", "not readable"),
        (b"[" * 2000, "not readable"),
        (b'{"time_s": 1}', "not readable"),
        (datagram(1.0, position=(1.0, 2.0)), "wrong length"),
        (b"POS1" + bytes(63), "wrong length"),
        (datagram(float("nan")), "not finite"),
        (datagram(1.0, position=(math.inf, 0.0, 0.0)), "not finite"),
        (datagram(1.0, position=(2e4, 0.0, 0.0)), "too far away"),
        (datagram(1.0, quaternion=(0.0, 0.0, 0.0, 0.0)), "not of unit length"),
        (datagram(1.0, quaternion=(0.9, 0.0, 0.0, 0.0)), "not of unit length"),
        (datagram(1.0, velocity_enu=[1.0, 2.0]), "wrong length"),
        (datagram(1.0, velocity_enu=[1.0, 2.0, 300.0]), "too fast"),
        (b"POS2" + bytes(64), "wrong length"),
        (datagram(1.0, covariance=[1.0] * 20), "21 finite numbers"),
        (datagram(1.0, covariance=[-1.0] + [0.0] * 20), "negative variance"),
    ],
)
def test_what_is_no_pose(data: bytes, why: str) -> None:
    with pytest.raises(BadPose, match=why):
        parse_pose(data)


@given(st.binary(max_size=200))
def test_no_datagram_breaks_the_listener(data: bytes) -> None:
    for content in (data, b"POS1" + data, b"POS2" + data):
        with suppress(BadPose):
            parse_pose(content)


@given(
    st.floats(0.0, 1e6),
    st.tuples(*[st.floats(-100.0, 100.0)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(v * v for v in q) > 0.01),
    st.booleans(),
)
def test_packing_and_parsing_agree(time_s: float, position, quaternion, binary: bool) -> None:
    unit = np.array(quaternion) / np.linalg.norm(quaternion)
    speed = 0.5 * np.array(position) if position[0] > 0 else None
    pose = OutsidePose(time_s, np.array(position), unit, np.arange(1.0, 22.0), velocity_enu=speed)
    again = parse_pose(pack_pose(pose, binary))
    assert (again.velocity_enu is None) == (speed is None)
    assert speed is None or np.array_equal(again.velocity_enu, speed)
    assert again.time_s == time_s
    assert np.array_equal(again.position_enu, pose.position_enu)
    assert again.quaternion_wxyz == pytest.approx(unit, abs=1e-12)
    assert again.covariance == pytest.approx(pose.covariance)


def test_a_taken_port_is_an_error_in_words(poses: OutsidePoses) -> None:
    with pytest.raises(UserError, match="another program"):
        OutsidePoses(poses.address)
