"""What trajectories ask of the vehicle, against numbers worked out by hand and an independent flatness."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.config.errors import UserError
from companion.control.structs import Reference, Vector
from companion.reference.circle import Circle
from companion.reference.feasibility import VehicleLimits, check_feasibility
from companion.reference.flatness import demand, sampled
from companion.reference.hold import Hold
from companion.reference.lemniscate import Lemniscate
from companion.reference.step import Step
from companion.reference.trajectory import Trajectory, placed, resting
from companion.reference.transit import TransitLimits, run_in, transit

MASS = 1.79
G = 9.81
QBALL2 = VehicleLimits(
    mass_kg=MASS,
    thrust_min_newton=2.0,
    thrust_max_newton=45.0,
    tilt_max_rad=math.radians(35.0),
    body_rate_max_rad_s=(4.0, 4.0, 2.0),
    angular_acceleration_max_rad_s2=(60.0, 60.0, 10.0),
    height_min_m=0.1,
    height_max_m=3.0,
    fence_radius_m=5.0,
)


def named(trajectory: Trajectory, limits: VehicleLimits = QBALL2, span_s: float | None = None) -> dict:
    return {
        violation.what: violation for violation in check_feasibility(trajectory, limits, span_s).violations
    }


def test_the_reports_lemniscate_can_be_flown() -> None:
    result = check_feasibility(Lemniscate(), QBALL2, span_s=40.0)
    assert result.ok
    result.require("lemniscate")
    # At t = 2 both horizontal speeds are π/4 and ż = 0.21 t² e^(-0.1 t³) = 0.3774; the peak is near by.
    assert result.peaks["speed_m_s"] == pytest.approx(math.hypot(math.pi / 4, math.pi / 4, 0.3774), rel=1e-3)
    # At t = 1: 0.5 (π/2)² = 1.2337, (π/4)² / √2 = 0.4362, 0.07 · 5.1 · e^-0.1 = 0.3230.
    assert result.peaks["acceleration_m_s2"] == pytest.approx(math.hypot(1.2337, 0.4362, 0.323), rel=2e-3)


def test_the_report_taken_literally_is_refused_with_its_numbers() -> None:
    literal = Lemniscate(x_period_s=1 / 4, y_period_s=1 / 8)  # sin(2π 4t), cos(2π 8t)
    result = check_feasibility(literal, QBALL2, span_s=40.0)
    found = {violation.what: violation for violation in result.violations}
    # (2π 8)² = 2526.6 m/s²; m √(a² + g²) = 4523 N
    assert result.peaks["acceleration_m_s2"] == pytest.approx((16 * math.pi) ** 2, rel=1e-3)
    assert found["thrust"].value == pytest.approx(MASS * math.hypot((16 * math.pi) ** 2, G), rel=1e-3)
    assert found["thrust"].limit == 45.0
    assert found["tilt"].value > 89.0
    assert not any("jump" in what for what in found)
    only_x = check_feasibility(replace(literal, y_amplitude_m=0.0), QBALL2, span_s=5.0)
    assert only_x.peaks["acceleration_m_s2"] == pytest.approx(
        315.8, rel=3e-3
    )  # samples 5 ms apart miss the crest a little
    with pytest.raises(UserError) as error:
        result.require("lemniscate")
    message = str(error.value)
    for part in ("'lemniscate'", "thrust is 4523 N", "at most 45 N", "2527 m/s²", "of its speed"):
        assert part in message


def test_circle_by_hand() -> None:
    radius, speed = 2.0, 3.0
    acceleration = speed**2 / radius  # 4.5 m/s²
    motion = sampled(Circle(radius_m=radius, speed_m_s=speed), np.linspace(0.0, 4.0, 50))
    asked = demand(motion, MASS)
    np.testing.assert_allclose(asked.thrust_newton, MASS * math.hypot(G, acceleration), rtol=1e-12)
    np.testing.assert_allclose(asked.tilt_rad, math.atan2(acceleration, G), rtol=1e-12)
    # Body z goes round a cone of half angle β once in 2πr/v: |ż_B| = Ω sin β, and that is √(p² + q²).
    turning = speed / radius
    swing = np.hypot(asked.body_rate_flu[:, 0], asked.body_rate_flu[:, 1])
    np.testing.assert_allclose(swing, turning * math.sin(math.atan2(acceleration, G)), rtol=1e-12)


@pytest.mark.parametrize("clockwise", [False, True])
def test_coordinated_turn_by_hand(clockwise: bool) -> None:
    # Looking ahead on a circle, the whole vehicle turns about the vertical at Ω = v/r with constant bank:
    # ω = Rᵀ (0, 0, Ω), with roll φ towards the centre and no pitch: (0, Ω sin φ, Ω cos φ).
    radius, speed = 2.0, 3.0
    circle = Circle(radius_m=radius, speed_m_s=speed, look_ahead=True, clockwise=clockwise)
    asked = demand(sampled(circle, np.linspace(0.0, 3.0, 20)), MASS)
    turning = -speed / radius if clockwise else speed / radius
    # Anticlockwise the centre is on the left: the left side goes down, which is negative roll in FLU.
    roll = math.copysign(math.atan2(speed**2 / radius, G), -turning)
    expected = [0.0, turning * math.sin(roll), turning * math.cos(roll)]
    np.testing.assert_allclose(asked.body_rate_flu, np.tile(expected, (20, 1)), atol=1e-12)
    np.testing.assert_allclose(asked.angular_acceleration_flu, 0.0, atol=1e-11)


def rotation_by_the_report(reference: Reference, drag: Vector) -> np.ndarray:
    """Attitude from Eqs. (17), (18), as matrix, independent of the code under test."""
    f = MASS * (reference.acceleration_enu + np.array([0.0, 0.0, G])) + drag * reference.velocity_enu
    c, s = math.cos(reference.yaw_rad), math.sin(reference.yaw_rad)
    pitch = math.atan((f[0] * c + f[1] * s) / f[2])
    roll = math.atan(math.cos(pitch) * (f[0] * s - f[1] * c) / f[2])
    from_euler = pytest.importorskip("scipy.spatial.transform").Rotation.from_euler
    return from_euler("ZYX", [reference.yaw_rad, pitch, roll]).as_matrix()


@pytest.mark.parametrize("drag", [np.zeros(3), np.array([0.1, 0.2, 0.05])])
def test_rates_are_the_derivatives_of_the_reports_attitude(drag: Vector) -> None:
    trajectory = transit(
        Lemniscate(speed=1.5).sample(2.0), Circle(radius_m=1.0, look_ahead=True).sample(1.0), TransitLimits()
    )
    if drag.any():  # with drag, snap enters through the jerk of the velocity term only: still exact
        trajectory = placed(trajectory, np.zeros(3), 0.7)
    h = 1e-4

    def rate(time_s: float) -> np.ndarray:
        ahead, behind = (rotation_by_the_report(trajectory.sample(time_s + d), drag) for d in (h, -h))
        here = rotation_by_the_report(trajectory.sample(time_s), drag)
        skew = here.T @ (ahead - behind) / (2 * h)
        return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])

    times = np.linspace(0.1, trajectory.duration_s - 0.1, 15)
    asked = demand(sampled(trajectory, times), MASS, drag)
    for i, time_s in enumerate(times):
        np.testing.assert_allclose(asked.body_rate_flu[i], rate(time_s), rtol=1e-5, atol=1e-6)
        angular = (rate(time_s + 1e-3) - rate(time_s - 1e-3)) / 2e-3
        np.testing.assert_allclose(asked.angular_acceleration_flu[i], angular, rtol=1e-4, atol=1e-4)


def test_limits_bite_where_they_should() -> None:
    # A circle of 2 m at v: a = v²/r. The thrust limit T is reached at v² = r √((T/m)² - g²) = 46.24 m²/s².
    loose = replace(
        QBALL2,
        tilt_max_rad=1.55,
        body_rate_max_rad_s=(99.0,) * 3,
        angular_acceleration_max_rad_s2=(999.0,) * 3,
    )
    edge = math.sqrt(2.0 * math.sqrt((45.0 / MASS) ** 2 - G**2))
    assert not named(Circle(radius_m=2.0, speed_m_s=0.999 * edge), loose, 5.0)
    assert set(named(Circle(radius_m=2.0, speed_m_s=1.001 * edge), loose, 5.0)) == {"thrust"}
    # Tilt 35° at v² = r g tan 35° = 13.74 m²/s².
    tilted = replace(loose, tilt_max_rad=math.radians(35.0))
    edge = math.sqrt(2.0 * G * math.tan(math.radians(35.0)))
    assert not named(Circle(radius_m=2.0, speed_m_s=0.999 * edge), tilted, 5.0)
    found = named(Circle(radius_m=2.0, speed_m_s=1.001 * edge), tilted, 5.0)
    assert set(found) == {"tilt"}
    assert found["tilt"].value == pytest.approx(35.0, rel=2e-3)
    assert named(Hold(), replace(QBALL2, speed_max_m_s=1.0), 2.0) == {}
    assert set(named(Circle(speed_m_s=1.1), replace(QBALL2, speed_max_m_s=1.0), 2.0)) == {"speed"}


def test_heights_and_fence_are_those_of_the_placed_trajectory() -> None:
    assert named(Hold(height_m=0.05))["height"].below
    assert named(Hold(height_m=3.2))["height"].value == 3.2
    assert not named(placed(Hold(height_m=0.05), np.array([0.0, 0.0, 0.5]), 0.0))
    far = named(placed(Hold(), np.array([3.0, 4.5, 0.0]), 0.0))["distance from the fence's centre"]
    assert far.value == pytest.approx(math.hypot(3.0, 4.5))
    assert not named(
        placed(Hold(), np.array([3.0, 4.5, 0.0]), 0.0), replace(QBALL2, fence_centre_m=(3.0, 4.0))
    )


def test_least_thrust_is_checked() -> None:
    fall = replace(QBALL2, height_min_m=-99.0, body_rate_max_rad_s=(1e9,) * 3, tilt_max_rad=4.0)
    # z = -0.7 (1 - e^{-c s³}) with a high rate drops faster than free fall somewhere.
    found = named(Lemniscate(rise_m=-2.0, rise_rate=8.0, scale=0.0), fall, 2.0)
    assert found["thrust"].below


def test_the_advice_to_slow_down_is_right() -> None:
    fast = Lemniscate(speed=6.0)
    result = check_feasibility(fast, QBALL2, span_s=10.0)
    assert not result.ok
    assert result.slower is not None
    assert check_feasibility(replace(fast, speed=6.0 * result.slower), QBALL2, span_s=10.0 / result.slower).ok
    too_fast = 6.0 * (result.slower + 0.02)
    assert not check_feasibility(replace(fast, speed=too_fast), QBALL2, span_s=10.0 / result.slower).ok
    # Where height is the matter, flying slower is no advice.
    assert check_feasibility(Lemniscate(speed=6.0, height_m=9.0), QBALL2, span_s=10.0).slower is None


class Joined:
    """A circle up to 1 s, and from then on the same with one derivative off."""

    duration_s = 3.0

    def __init__(self, field: str, offset: object) -> None:
        self.field, self.offset = field, offset

    def sample(self, time_s: float) -> Reference:
        reference = Circle(look_ahead=True).sample(time_s)
        if time_s < 1.0:
            return reference
        return replace(reference, **{self.field: getattr(reference, self.field) + self.offset})


@pytest.mark.parametrize(
    ("field", "offset", "what"),
    [
        ("position_enu", np.array([0.0, 0.05, 0.0]), "the jump in position"),
        ("velocity_enu", np.array([0.1, 0.0, 0.0]), "the jump in velocity"),
        ("acceleration_enu", np.array([0.0, 0.0, 1.0]), "the jump in acceleration"),
        ("yaw_rad", 0.1, "the jump in yaw"),
    ],
)
def test_jumps_are_found_with_place_and_size(field: str, offset: object, what: str) -> None:
    found = named(Joined(field, offset))[what]
    assert found.time_s == pytest.approx(1.0, abs=0.01)
    assert found.value == pytest.approx(float(np.linalg.norm(offset)), rel=0.1)


def test_a_long_flight_is_not_taken_for_a_jumping_one() -> None:
    assert check_feasibility(Lemniscate(), QBALL2, span_s=3000.0).ok


def test_a_whole_turn_of_yaw_is_no_jump() -> None:
    assert not named(Joined("yaw_rad", -2.0 * math.pi))


def test_steps_may_jump_because_they_are_meant_to() -> None:
    assert check_feasibility(Step(), QBALL2).ok
    assert check_feasibility(placed(Step(), np.zeros(3), 1.0), QBALL2).ok
    assert not check_feasibility(Step(z_m=-0.95), QBALL2).ok  # into the ground all the same


def test_transits_and_run_ins_are_smooth_by_this_measure() -> None:
    limits = TransitLimits()
    for trajectory in (
        run_in(Lemniscate(), limits),
        transit(resting(np.array([0.0, 0.0, 0.2]), 0.0), resting(np.array([1.0, 1.0, 1.0]), 2.0), limits),
    ):
        assert check_feasibility(trajectory, QBALL2).ok


def test_not_a_number_is_refused_with_its_time() -> None:
    with pytest.raises(UserError, match=r"not a finite number at 1\.000 s"):
        check_feasibility(Joined("jerk_enu", math.nan), QBALL2)
