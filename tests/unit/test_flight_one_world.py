"""Poses in every kind of wrong frame against an estimate that is right, on the ground and climbing."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.autopilot.adapter import Verdict
from companion.control.structs import VehicleState
from companion.flight.one_world import PoseComparison, PoseFigures, TwoPaths
from companion.flight.pose_findings import pose_findings
from companion.mavlink.outside_poses import OutsidePoses
from companion.mavlink.pose_datagram import OutsidePose

NED_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def rotation(quaternion: np.ndarray) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


def ned_frd(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    matrix = NED_ENU @ rotation(quaternion).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    return NED_ENU @ position, wxyz(Rotation.from_matrix(matrix))


def y_mirrored(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mirror = np.diag([1.0, -1.0, 1.0])
    matrix = mirror @ rotation(quaternion).as_matrix() @ mirror
    return mirror @ position, wxyz(Rotation.from_matrix(matrix))


def turned(angle_deg: float) -> Change:
    by = Rotation.from_euler("z", angle_deg, degrees=True)
    return lambda position, quaternion: (by.apply(position), wxyz(by * rotation(quaternion)))


def scaled(factor: float) -> Change:
    return lambda position, quaternion: (factor * position, quaternion)


FRAMES: dict[str, Change] = {
    "right": lambda position, quaternion: (position + np.array([3.0, -40.0, 0.7]), quaternion),
    "NED and FRD": ned_frd,
    "y mirrored": y_mirrored,
    "yaw +90": turned(90.0),
    "yaw -90": turned(-90.0),
    "yaw 180": turned(180.0),
    "millimetres": scaled(1e3),
    "centimetres": scaled(1e2),
    "forward, right, down": lambda p, q: (p, wxyz(rotation(q) * Rotation.from_euler("x", 180, degrees=True))),
    "x, y, z, w": lambda p, q: (p, q[[1, 2, 3, 0]]),
    "world to body": lambda p, q: (p, wxyz(rotation(q).inv())),
    "z down": lambda p, q: (np.array([p[0], p[1], -p[2]]), q),
}
FAINT = ("y mirrored", "world to body")
"""At rest they turn the heading about east, by twice as much as it has: a warning here."""
HEADING_RAD = 0.25  # NED given as ENU errs by 90° less twice the heading: north-east hides it at rest


def compared(
    change: Change, climb_m_s: float, sideways_m_s: float = 0.0, seconds: float = 1.5
) -> PoseFigures:
    """A vehicle at `HEADING_RAD`, tilted a little; 50 poses a second with 1 mm of noise, 20 ms late."""
    comparison, draw = PoseComparison(), np.random.default_rng(3)
    quaternion = wxyz(Rotation.from_euler("ZYX", [HEADING_RAD, 0.02, -0.03]))
    velocity = np.array([0.3 * sideways_m_s, sideways_m_s, climb_m_s])
    for k in range(round(50 * seconds)):
        time_s = 10.0 + 0.02 * k
        late = np.array([1.0, 2.0, 0.1]) + (0.02 * k - 0.02) * velocity + draw.normal(0.0, 1e-3, 3)
        position, attitude = change(late, quaternion)
        estimate = np.array([1.0, 2.0, 0.1]) + 0.02 * k * velocity
        state = VehicleState(time_s, estimate, velocity, quaternion, np.zeros(3))
        comparison.add(OutsidePose(time_s, position, attitude), state)
    figures = comparison.figures(10.0 + seconds)
    assert figures is not None
    return figures


def verdicts(figures: PoseFigures, used: bool | None = True) -> set[Verdict]:
    poses = OutsidePoses(("127.0.0.1", 0))
    poses.counters["forwarded"] = 50
    try:
        return {finding.verdict for finding in pose_findings(poses, figures, used)}
    finally:
        poses.close()


@pytest.mark.parametrize("sideways", [0.0, 1.0])
@pytest.mark.parametrize("climb", [0.0, 0.8])
def test_a_right_frame_is_right_wherever_its_origin_is(climb: float, sideways: float) -> None:
    figures = compared(FRAMES["right"], climb, sideways)
    assert figures.tilt_deg < 0.1 and abs(figures.heading_deg) < 0.1
    assert figures.looks_like == ""
    assert verdicts(figures) == {Verdict.OK}
    assert (figures.motion is None) == (not climb and not sideways)


HIDDEN = ("right", "centimetres", "z down", *FAINT)


@pytest.mark.parametrize("frame", [name for name in FRAMES if name not in HIDDEN])
def test_at_rest(frame: str) -> None:
    """Millimetres by the noise, which then moves by metres; all else by tilt or heading."""
    figures = compared(FRAMES[frame], 0.0)
    assert Verdict.REFUSAL in verdicts(figures), figures
    assert verdicts(figures, used=False) == {Verdict.OK, Verdict.WARNING}


@pytest.mark.parametrize("frame", [name for name in FRAMES if name not in ("right", "world to body")])
def test_in_the_climb_and_sideways(frame: str) -> None:
    figures = compared(FRAMES[frame], 0.5, 0.7)
    assert Verdict.REFUSAL in verdicts(figures), figures


@pytest.mark.parametrize("frame", ["z down", "millimetres", "centimetres", "NED and FRD"])
def test_in_a_climb_alone(frame: str) -> None:
    figures = compared(FRAMES[frame], 0.6)
    assert figures.motion is not None and figures.motion > 0.8


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        ("NED and FRD", "NED and FRD given as ENU and FLU"),
        ("y mirrored", "y mirrored"),
        ("yaw +90", "its world is turned by +90°"),
        ("yaw -90", "its world is turned by -90°"),
        ("yaw 180", "its world is turned by"),
        ("millimetres", "positions in millimetres: send metres"),
        ("centimetres", "positions in centimetres: send metres"),
        ("forward, right, down", "body axes forward, right, down"),
        ("x, y, z, w", "quaternion in the order x, y, z, w: send w first"),
        ("z down", "z downwards"),
    ],
)
def test_the_mistake_is_named_once_it_moves(frame: str, words: str) -> None:
    assert compared(FRAMES[frame], 0.5, 0.7).looks_like.startswith(words)


def test_a_single_wrong_pose_and_an_announced_origin_change_nothing() -> None:
    comparison = PoseComparison()
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    for k in range(100):
        state = VehicleState(0.05 * k, np.zeros(3), np.zeros(3), quaternion, np.zeros(3))
        origin = np.array([5.0, 0.0, 0.0]) if k >= 70 else np.zeros(3)
        outlier = np.array([0.0, 9.0, 0.0]) if k == 50 else np.zeros(3)
        pose = OutsidePose(0.05 * k, origin + outlier, quaternion, reset_counter=int(k >= 70))
        comparison.add(pose, state)
        figures = comparison.figures(0.05 * k)
        assert figures is not None and figures.motion is None, k


def test_old_poses_say_nothing() -> None:
    comparison = PoseComparison()
    assert comparison.figures(0.0) is None
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    comparison.add(
        OutsidePose(0.0, np.zeros(3), quaternion),
        VehicleState(0.0, np.zeros(3), np.zeros(3), quaternion, np.zeros(3)),
    )
    assert comparison.figures(0.4) is not None
    assert comparison.figures(0.6) is None


@pytest.mark.parametrize(("angle_deg", "difference"), [(0, 0.0), (60, 1.0), (90, math.sqrt(2)), (180, 2.0)])
def test_the_difference_of_two_paths_is_that_of_their_directions(angle_deg: float, difference: float) -> None:
    paths, angle = TwoPaths(), math.radians(angle_deg)
    for k in range(40):
        paths.add(
            0.05 * k, (0.05 * k, 0.0, 0.0), (0.05 * k * math.cos(angle), 0.05 * k * math.sin(angle), 7.0)
        )
    assert paths.difference == pytest.approx(difference, abs=1e-9)
    assert math.hypot(*paths.moved[0]) == pytest.approx(1.0, abs=0.051)  # of the last second
