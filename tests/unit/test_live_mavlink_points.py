"""What MAVLink's position targets and trajectory representations mean, as points in ENU; numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.live.follower import Follower
from companion.live.mavlink_points import MavlinkPoints, Surroundings
from companion.live.point import BadPoint, Point, PolynomialPiece
from companion.reference.trajectory import resting
from companion.reference.transit import TransitLimits
from tests.unit.mavlink_wire import Sender, mav

NAN = math.nan
SYSTEM = 7
HEADING_NORTH, HEADING_EAST = math.pi / 2, 0.0  # ENU
AT = np.array([10.0, 20.0, 3.0])
LOCAL, OFFSET, BODY, BODY_OFFSET = 1, 7, 8, 9
P, V, A, FORCE, YAW, RATE = 0x7, 0x38, 0x1C0, 0x200, 0x400, 0x800


def around(yaw_rad: float = HEADING_NORTH, **changed: object) -> Surroundings:
    known = {"position_enu": AT, "yaw_rad": yaw_rad, "origin": (47.0, 8.0, 400.0), "ground_m": -1.0}
    return Surroundings(**{**known, "system": SYSTEM, **changed})  # type: ignore[arg-type]


def local(
    mask: int,
    frame: int = LOCAL,
    p=(1, 2, -3),
    v=(4, 5, -6),
    a=(7, 8, -9),
    yaw=0.5,
    rate=0.25,
    ms=0,
    to=SYSTEM,
):
    return mav.MAVLink_set_position_target_local_ned_message(ms, to, 1, frame, mask, *p, *v, *a, yaw, rate)


def asked(message, surroundings: Surroundings | None = None) -> Point | PolynomialPiece:
    reader = MavlinkPoints(lambda: surroundings or around())
    (found,) = reader.parse(Sender(255, 190).frame(message))
    assert isinstance(found, Point | PolynomialPiece)
    return found


def equal(value, expected) -> bool:
    return np.allclose(value, expected, rtol=0, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize("ignored", range(16))
def test_every_part_of_the_mask_is_heeded(ignored: int) -> None:
    """Position, velocity, acceleration and yaw given or not, in every combination; NED → ENU."""
    bits = [part for n, part in enumerate((P, V, A, YAW | RATE)) if ignored >> n & 1]
    point = asked(local(sum(bits)))
    assert equal(point.position, [NAN] * 3 if P in bits else [2, 1, 3])
    assert equal(point.velocity, [NAN] * 3 if V in bits else [5, 4, 6])
    assert equal(point.acceleration, [NAN] * 3 if A in bits else [8, 7, 9])
    assert equal(point.yaw_rad, NAN if YAW | RATE in bits else math.pi / 2 - 0.5)
    assert equal(point.yaw_rate_rad_s, NAN if YAW | RATE in bits else -0.25)
    assert math.isnan(point.time_s)


def test_every_axis_of_the_mask_is_heeded_by_itself() -> None:
    """As PX4: x and y by velocity, z by position."""
    point = asked(local(0b1_1100_0111_1111 & ~(1 << 2) & ~(1 << 3) & ~(1 << 4) | (1 << 5) | A | YAW | RATE))
    assert equal(point.position, [NAN, NAN, 3]) and equal(point.velocity, [5, 4, NAN])


@pytest.mark.parametrize(
    ("frame", "yaw_rad", "position", "velocity", "yaw"),
    [
        (LOCAL, HEADING_EAST, [2, 1, 3], [5, 4, 6], math.pi / 2 - 0.5),
        (OFFSET, HEADING_EAST, [12, 21, 6], [5, 4, 6], math.pi / 2 - 0.5),
        # forward is x of the message: heading north it is y of ENU, heading east it is x; right of east is south
        (BODY, HEADING_NORTH, [12, 21, 6], [5, 4, 6], math.pi / 2 - 0.5),
        (BODY_OFFSET, HEADING_EAST, [11, 18, 6], [4, -5, 6], -0.5),
    ],
)
def test_frames_are_arducopters(frame: int, yaw_rad: float, position, velocity, yaw: float) -> None:
    point = asked(local(A | RATE, frame), around(yaw_rad))
    assert equal(point.position, position) and equal(point.velocity, velocity) and equal(point.yaw_rad, yaw)


def test_a_body_frame_of_px4_has_no_position_and_an_absolute_yaw() -> None:
    point = asked(local(RATE, BODY), around(HEADING_EAST, body_frame_of_px4=True))
    assert equal(point.position, [NAN] * 3)
    assert equal(point.velocity, [4, -5, 6]) and equal(point.acceleration, [7, -8, 9])
    assert equal(point.yaw_rad, math.pi / 2 - 0.5)


@pytest.mark.parametrize(("frame", "height"), [(5, 12.5), (0, 12.5), (6, 411.5), (3, 411.5)])
def test_global_positions_lie_about_the_origin(frame: int, height: float) -> None:
    """0.001° of latitude are 6371000 m · π/180000 = 111.1949 m (PX4's sphere); of longitude at 47° times 0.681998."""
    message = mav.MAVLink_set_position_target_global_int_message(
        0, SYSTEM, 1, frame, A | YAW | RATE, 470010000, 80010000, 412.5, 1, 2, -3, 0, 0, 0, 0, 0
    )
    point = asked(message)
    assert np.allclose(point.position, [111.1949 * 0.681998, 111.1949, height], atol=2e-3)
    assert equal(point.velocity, [2, 1, 3])


@pytest.mark.parametrize(
    ("message", "surroundings", "words"),
    [
        (local(A, p=(NAN, 0, 0)), around(), "not a number: position"),
        (local(A, v=(0, math.inf, 0)), around(), "not a number: velocity"),
        (local(A, yaw=NAN), around(), "not a number: yaw"),
        (local(FORCE), around(), "setpoints of force"),
        (local(A, frame=12), around(), "frame: 12 is not flown"),
        (local(A, to=3), around(), "for another: system 3, and we fly 7"),
        (local(A, frame=BODY), around(position_enu=None), "position is not known yet"),
        (
            mav.MAVLink_set_position_target_global_int_message(0, 7, 1, 11, A, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 0),
            around(), "heights above terrain",
        ),
        (
            mav.MAVLink_set_position_target_global_int_message(0, 7, 1, 6, A, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 0),
            around(origin=None), "no GPS_GLOBAL_ORIGIN",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_flown_is_refused_in_words(message, surroundings, words: str) -> None:
    with pytest.raises(BadPoint, match=words):
        asked(message, surroundings)


def test_force_that_is_ignored_is_no_reason_to_refuse() -> None:
    """As ArduCopter: the bit matters where accelerations are given."""
    assert equal(asked(local(FORCE | A)).position, [2, 1, 3])


def test_times_are_the_clients_where_they_tell_something() -> None:
    reader, sender = MavlinkPoints(around), Sender(255, 190)

    def times(*stamps: int) -> list[float]:
        return [reader.parse(sender.frame(local(0, ms=ms)))[0].time_s for ms in stamps]  # type: ignore[union-attr]

    assert equal(times(1000, 1020, 1020, 1040, 0, 0), [1.0, 1.02, NAN, 1.04, NAN, NAN])
    frame = sender.frame(local(0, ms=1060))
    reader.parse(frame)
    with pytest.raises(BadPoint, match="repeated"):
        reader.parse(frame)


def test_other_messages_are_passed_over_and_noise_is_said() -> None:
    reader, sender = MavlinkPoints(around), Sender(255, 190)
    assert reader.parse(sender.frame(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))) == []
    assert (
        reader.parse(sender.frame(mav.MAVLink_command_long_message(7, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))) == []
    )
    with pytest.raises(BadPoint, match="not MAVLink"):
        reader.parse(b"\x00garbage" * 20)
    damaged = bytearray(sender.frame(local(0)))
    damaged[20] ^= 0xFF
    with pytest.raises(BadPoint, match="not MAVLink"):
        reader.parse(bytes(damaged))
    both = sender.frame(local(0)) + sender.frame(local(P))
    assert len(reader.parse(both)) == 2


def test_the_first_waypoint_of_a_representation_is_a_point() -> None:
    five, zero = [NAN] * 5, [0] * 5
    names = [
        [1.0, *five[1:]],
        [2.0, *five[1:]],
        [-3.0, *five[1:]],
        [4.0, *five[1:]],
        [5.0, *five[1:]],
        [-6.0, *five[1:]],
    ]
    yaw, rate = [0.5, *five[1:]], [0.25, *five[1:]]
    message = mav.MAVLink_trajectory_representation_waypoints_message(
        2_000_000, 1, *names, five, five, five, yaw, rate, zero
    )
    point = asked(message)
    assert isinstance(point, Point)
    assert (
        equal(point.position, [2, 1, 3])
        and equal(point.velocity, [5, 4, 6])
        and np.isnan(point.acceleration).all()
    )
    assert (
        equal(point.time_s, 2.0)
        and equal(point.yaw_rad, math.pi / 2 - 0.5)
        and equal(point.yaw_rate_rad_s, -0.25)
    )
    with pytest.raises(BadPoint, match="valid_points: 0"):
        asked(
            mav.MAVLink_trajectory_representation_waypoints_message(
                0, 0, *names, five, five, five, yaw, rate, zero
            )
        )


def test_a_bezier_curve_goes_through_its_ends_along_its_control_points() -> None:
    """Quadratic, 2 s, north 0 → 1 → 4: B(1) = (0 + 2·1 + 4)/4 = 1.5, B'(0) = 2·(1 − 0)/2 = 1 m/s, B'(2) = 3 m/s."""
    rows = [[0, 1, 4, 0, 0], [0, 0, 2, 0, 0], [-1, -1, -1, 0, 0]]
    delta = [0, 0, 2.0, 0, 0]
    message = mav.MAVLink_trajectory_representation_bezier_message(3_000_000, 3, *rows, delta, [NAN] * 5)
    piece = asked(message)
    assert isinstance(piece, PolynomialPiece)
    assert piece.duration_s == 2.0 and piece.time_s == 3.0 and np.isnan(piece.coefficients[3]).all()
    north, up = piece.coefficients[1], piece.coefficients[2]
    value = [float(np.polyval(north[::-1], t)) for t in (0, 1, 2)]
    slope = [float(np.polyval(np.polyder(north[::-1]), t)) for t in (0, 2)]
    assert equal(value, [0, 1.5, 4]) and equal(slope, [1, 3]) and equal(np.polyval(up[::-1], 1.3), 1)
    with pytest.raises(BadPoint, match="time horizon"):
        asked(mav.MAVLink_trajectory_representation_bezier_message(0, 3, *rows, [0] * 5, [NAN] * 5))


def test_a_follower_flies_what_mavlink_asks_for() -> None:
    """The whole way that `serve` and the reference port go: frame → point → course."""
    follower = Follower(resting(np.array([2.0, 1.0, 3.0]), 0.0), 0.0, TransitLimits())
    reader, sender = MavlinkPoints(around), Sender(255, 190)
    for step in range(200):
        north = 1.0 + 0.5 * step * 0.02
        (point,) = reader.parse(
            sender.frame(local(A | YAW | RATE, p=(north, 2, -3), v=(0.5, 0, 0), ms=1 + 20 * step))
        )
        assert isinstance(point, Point)
        follower.take(point, step * 0.02)
        now = follower.sample(step * 0.02 + 0.08)
    assert equal(now.velocity_enu, [0, 0.5, 0])
    assert np.allclose(now.position_enu, [2, 1 + 0.5 * (199 * 0.02 + 0.08), 3], atol=1e-3)
