"""NED/FRD to ENU/FLU: hand-worked attitudes, properties, and what two real autopilots sent while they moved."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from fixtures.make_capture_motion import CAPTURES, LEMNISCATE, capture_motion
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from companion.mavlink import frames

HALF, SQRT = math.pi / 2, math.sqrt(0.5)
MOTION = json.loads((Path(__file__).parent / "fixtures" / "capture_motion.json").read_text())
SHARED_CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "captures"
GRAVITY = 9.81

finite = st.floats(-1e4, 1e4)
vectors = st.tuples(finite, finite, finite).map(np.array)
quaternions = (
    st.tuples(*(st.floats(-1.0, 1.0),) * 4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
angles = st.floats(-10.0, 10.0)


def matrix(quaternion_wxyz):
    """SciPy's rotation matrix, so that nothing of ours is used to judge ours."""
    return Rotation.from_quat(np.asarray(quaternion_wxyz), scalar_first=True).as_matrix()


# By hand ------------------------------------------------------------------------------------------------


def test_world_axes():
    """3 m north, 4 m east, 5 m down is 4 m along x, 3 m along y, 5 m below."""
    np.testing.assert_array_equal(frames.enu_from_ned((3.0, 4.0, 5.0)), [4.0, 3.0, -5.0])
    np.testing.assert_array_equal(frames.ned_from_enu((4.0, 3.0, -5.0)), [3.0, 4.0, 5.0])


def test_body_axes():
    """Rolling right, nose up, turning right in FRD is + + +; in FLU it is + − −."""
    np.testing.assert_array_equal(frames.flu_from_frd((1.0, 2.0, 3.0)), [1.0, -2.0, -3.0])
    np.testing.assert_array_equal(frames.frd_from_flu((1.0, -2.0, -3.0)), [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("said", "ned_frd_wxyz", "forward_enu", "left_enu"),
    [
        ("level, nose north", (1, 0, 0, 0), (0, 1, 0), (-1, 0, 0)),
        ("level, nose east", (SQRT, 0, 0, SQRT), (1, 0, 0), (0, 1, 0)),
        ("level, nose south", (0, 0, 0, 1), (0, -1, 0), (1, 0, 0)),
        ("level, nose west", (SQRT, 0, 0, -SQRT), (-1, 0, 0), (0, -1, 0)),
        # A quarter turn to the right about the nose, which points north: the left side is on top.
        ("nose north, right wing down", (SQRT, SQRT, 0, 0), (0, 1, 0), (0, 0, 1)),
        # Nose straight up, belly to the north, the left side still in the west.
        ("nose up from north", (SQRT, 0, SQRT, 0), (0, 0, 1), (-1, 0, 0)),
    ],
)
def test_attitude_by_hand(said, ned_frd_wxyz, forward_enu, left_enu):
    rotation = matrix(frames.quaternion_enu_flu_from_ned_frd(ned_frd_wxyz))
    np.testing.assert_allclose(rotation[:, 0], forward_enu, atol=1e-12, err_msg=said)
    np.testing.assert_allclose(rotation[:, 1], left_enu, atol=1e-12, err_msg=said)


@pytest.mark.parametrize(
    ("heading_ned_deg", "yaw_enu_deg"), [(0, 90), (90, 0), (45, 45), (-90, -180), (135, -45), (350, 100)]
)
def test_yaw_by_hand(heading_ned_deg, yaw_enu_deg):
    assert frames.yaw_enu_from_ned(math.radians(heading_ned_deg)) == pytest.approx(math.radians(yaw_enu_deg))
    back = frames.yaw_ned_from_enu(math.radians(yaw_enu_deg))
    assert math.cos(back - math.radians(heading_ned_deg)) == pytest.approx(1.0)


def test_global_position_by_hand():
    """1/10,000 of a degree of latitude is 11.119 m on a sphere of 6,371 km; of longitude at 60° half of it."""
    place = frames.enu_from_global(60.0001, 10.0001, 105.0, (60.0, 10.0, 100.0))
    np.testing.assert_allclose(place, [11.1195 / 2, 11.1195, 5.0], atol=1e-3)


# Properties ---------------------------------------------------------------------------------------------


@given(vectors)
def test_vectors_come_back(vector):
    np.testing.assert_array_equal(frames.ned_from_enu(frames.enu_from_ned(vector)), vector)
    np.testing.assert_array_equal(frames.frd_from_flu(frames.flu_from_frd(vector)), vector)


@given(quaternions)
def test_attitudes_come_back(quaternion):
    back = frames.quaternion_ned_frd_from_enu_flu(frames.quaternion_enu_flu_from_ned_frd(quaternion))
    assert abs(float(back @ quaternion)) == pytest.approx(1.0, abs=1e-12)


@given(quaternions, vectors)
def test_a_vector_is_where_it_is(quaternion, vector_frd):
    """Turning into the world and changing its axes may be done in either order: R_enu F = T R_ned."""
    world_ned = matrix(quaternion) @ vector_frd
    rotation_enu = matrix(frames.quaternion_enu_flu_from_ned_frd(quaternion))
    np.testing.assert_allclose(
        rotation_enu @ frames.flu_from_frd(vector_frd), frames.enu_from_ned(world_ned), atol=1e-8
    )


@given(quaternions)
def test_quaternion_is_unit_with_w_positive(quaternion):
    turned = frames.quaternion_enu_flu_from_ned_frd(quaternion)
    assert np.linalg.norm(turned) == pytest.approx(1.0, abs=1e-12)
    assert turned[0] >= 0.0


@given(angles, st.floats(-1.4, 1.4), st.floats(-1.4, 1.4))
def test_euler_angles(yaw_ned, pitch_frd, roll_frd):
    """ZYX angles of the same attitude: roll stays, pitch turns over, yaw is measured the other way from the east."""
    quaternion = Rotation.from_euler("ZYX", [yaw_ned, pitch_frd, roll_frd]).as_quat(scalar_first=True)
    turned = frames.quaternion_enu_flu_from_ned_frd(quaternion)
    yaw, pitch, roll = Rotation.from_quat(turned, scalar_first=True).as_euler("ZYX")
    assert (roll, pitch) == pytest.approx((roll_frd, -pitch_frd), abs=1e-9)
    assert math.cos(yaw - (HALF - yaw_ned)) == pytest.approx(1.0)
    assert math.cos(frames.yaw_enu_from_ned(yaw_ned) - yaw) == pytest.approx(1.0)
    assert -math.pi <= frames.yaw_enu_from_ned(yaw_ned) < math.pi


@given(quaternions, vectors.map(lambda v: v * 1e-4))
def test_body_rate_turns_the_attitude_it_belongs_to(quaternion, rate_frd):
    """A small turn by ω dt in the body: converting before or after it gives the same attitude."""
    dt_s = 1e-2
    later_ned = Rotation.from_quat(quaternion, scalar_first=True) * Rotation.from_rotvec(rate_frd * dt_s)
    now_enu = Rotation.from_quat(frames.quaternion_enu_flu_from_ned_frd(quaternion), scalar_first=True)
    later_enu = now_enu * Rotation.from_rotvec(frames.flu_from_frd(rate_frd) * dt_s)
    converted = frames.quaternion_enu_flu_from_ned_frd(later_ned.as_quat(scalar_first=True))
    np.testing.assert_allclose(later_enu.as_matrix(), matrix(converted), atol=1e-9)


# Real autopilots ----------------------------------------------------------------------------------------


class Motion:
    """One window of a capture, converted by us."""

    def __init__(self, autopilot: str, scenario: str) -> None:
        raw = MOTION[autopilot][scenario]
        attitude, position = np.array(raw["attitude"]), np.array(raw["position"])
        self.attitude_s, self.position_s = attitude[:, 0] * 1e-3, position[:, 0] * 1e-3
        self.rotation = np.array(
            [matrix(frames.quaternion_enu_flu_from_ned_frd(q)) for q in attitude[:, 1:5]]
        )
        self.rate_flu = np.array([frames.flu_from_frd(rate) for rate in attitude[:, 5:8]])
        self.position_enu = np.array([frames.enu_from_ned(p) for p in position[:, 1:4]])
        self.velocity_enu = np.array([frames.enu_from_ned(v) for v in position[:, 4:7]])

    def velocity_from_tilt(self):
        """(N, 2) what the tilt of body z says about the horizontal velocity: a = g · (z_east, z_north) / z_up."""
        acceleration = GRAVITY * self.rotation[:, :2, 2] / self.rotation[:, 2:3, 2]
        summed = running_integral(self.attitude_s, acceleration)
        return np.array([np.interp(self.position_s, self.attitude_s, axis) for axis in summed.T]).T

    def turned_flu(self, stride):
        """Angles (M, 3) turned within each `stride` messages: by attitude, and by body rates."""
        integral = running_integral(self.attitude_s, self.rate_flu)
        ends = range(0, len(self.rotation) - stride, stride)
        relative = [Rotation.from_matrix(self.rotation[k].T @ self.rotation[k + stride]) for k in ends]
        by_attitude = np.array([turn.as_rotvec() for turn in relative])
        return by_attitude, np.array([integral[k + stride] - integral[k] for k in ends])


def running_integral(times, values):
    """(N, K) trapezoidal integral from the first sample."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times)[:, None]
    return np.vstack([np.zeros(values.shape[1]), np.cumsum(steps, axis=0)])


def slope(cause, effect):
    """Least-squares factor from cause to effect, both from their first value."""
    cause, effect = cause - cause[0], effect - effect[0]
    return float(cause @ effect / (cause @ cause))


EAST, NORTH = 0, 1
TILTS = [
    # With the nose north a roll to the right accelerates to the east, nose up to the south.
    ("px4", "step roll +0.2", EAST, +1),
    ("px4", "step pitch +0.2", NORTH, -1),
    ("ardupilot", "step roll +0.2", EAST, +1),
    ("ardupilot", "step pitch +0.2", NORTH, -1),
    ("ardupilot", LEMNISCATE, EAST, 0),
    ("ardupilot", LEMNISCATE, NORTH, 0),
]


@pytest.mark.parametrize(("autopilot", "scenario", "axis", "sign"), TILTS)
def test_tilt_explains_the_movement(autopilot, scenario, axis, sign):
    motion = Motion(autopilot, scenario)
    predicted, measured = motion.velocity_from_tilt()[:, axis], motion.velocity_enu[:, axis]
    # Drag and the estimator's lag take their share; a wrong sign or axis gives −0.8 or nothing.
    assert 0.6 < slope(predicted, measured) < 1.3
    assert np.corrcoef(predicted, measured)[0, 1] > 0.9
    if sign:
        most = measured[np.argmax(np.abs(measured - measured[0]))] - measured[0]
        assert sign * most > 0.5


@pytest.mark.parametrize(("autopilot", "scenario", "axis", "_"), TILTS)
def test_velocity_explains_the_position(autopilot, scenario, axis, _):
    motion = Motion(autopilot, scenario)
    travelled = running_integral(motion.position_s, motion.velocity_enu)
    # PX4's estimate of this session is corrected by GPS on the way: a third of the distance at most.
    assert 0.7 < slope(travelled[:, axis], motion.position_enu[:, axis]) < 1.4
    assert np.corrcoef(travelled[:, axis], motion.position_enu[:, axis])[0, 1] > 0.95


@pytest.mark.parametrize("autopilot", sorted(CAPTURES))
@pytest.mark.parametrize(
    ("scenario", "axis", "sign_flu"),
    [("step roll +0.2", 0, +1), ("step pitch +0.2", 1, -1), ("step yaw +0.8", 2, -1)],
)
def test_body_rates_explain_the_attitude(autopilot, scenario, axis, sign_flu):
    by_attitude, by_rate = Motion(autopilot, scenario).turned_flu(stride=4)
    assert np.polyfit(by_rate[:, axis], by_attitude[:, axis], 1)[0] == pytest.approx(1.0, abs=0.04)
    assert np.corrcoef(by_rate[:, axis], by_attitude[:, axis])[0, 1] > 0.97
    half_way = len(by_rate) // 4  # the step itself, before anything comes back
    assert sign_flu * by_attitude[:half_way, axis].sum() > 0.05


@pytest.mark.parametrize("autopilot", sorted(CAPTURES))
def test_attitude_quaternion_agrees_with_euler_angles(autopilot):
    """ATTITUDE of the same moment, read by the convention of aerospace and turned over by hand."""
    compared = 0
    for window in MOTION[autopilot].values():
        attitudes = {int(row[0]): row[1:5] for row in window["attitude"]}
        for moment, roll, pitch, yaw in window["euler"]:
            turned = frames.quaternion_enu_flu_from_ned_frd(attitudes[int(moment)])
            by_hand = Rotation.from_euler("ZYX", [HALF - yaw, -pitch, roll]).as_matrix()
            np.testing.assert_allclose(matrix(turned), by_hand, atol=2e-3)
            compared += 1
    assert compared > 50


def test_odometry_agrees_with_the_messages_we_use():
    """PX4's ODOMETRY says the same in one message: position as LOCAL_POSITION_NED, attitude as ATTITUDE_QUATERNION."""
    compared = 0
    for window in MOTION["px4"].values():
        positions = {int(row[0]): row[1:4] for row in window["position"]}
        attitude = np.array(window["attitude"])
        for moment, *numbers in window["odometry"]:
            nearest = attitude[np.argmin(np.abs(attitude[:, 0] - moment)), 1:5]
            ours = matrix(frames.quaternion_enu_flu_from_ned_frd(nearest))
            theirs = matrix(frames.quaternion_enu_flu_from_ned_frd(numbers[3:]))
            assert math.acos(min(1.0, (np.trace(ours.T @ theirs) - 1) / 2)) < math.radians(1.0)
            if int(moment) in positions:
                np.testing.assert_allclose(numbers[:3], positions[int(moment)], atol=0.02)
                compared += 1
    assert compared > 3


@pytest.mark.skipif(not SHARED_CAPTURES.is_dir(), reason="the captures are not on this machine")
def test_the_fixture_is_what_the_captures_hold():
    assert capture_motion(SHARED_CAPTURES) == MOTION
