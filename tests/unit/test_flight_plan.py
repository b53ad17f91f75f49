"""The flight laid out in time: its parts meet, in the right order, from the ground back to above it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config.safety import SafetyLimits
from companion.control.structs import Reference
from companion.flight.fence import plan_margins
from companion.flight.phases import Phase
from companion.flight.plan import lay_out, lay_out_in_air, stopping_plan, tracking_time, way_back
from companion.live.trajectory import trajectory_or_live
from companion.reference.registry import trajectory_from_text
from companion.reference.trajectory import Frame, place, resting
from companion.reference.transit import TransitLimits, run_out

LIMITS = TransitLimits(speed_m_s=0.8, acceleration_m_s2=0.8, jerk_m_s3=2.0, height_min_m=0.25)
ORDER = [
    *(Phase.CLIMB, Phase.GO_TO_START, Phase.HOLD, Phase.RUN_IN),
    *(Phase.TRACK, Phase.RUN_OUT, Phase.RETURN),
]


def at_rest(x, y, z, yaw):
    zero = np.zeros(3)
    return Reference(np.array([x, y, z], dtype=float), zero, zero, zero, zero, yaw, 0.0, 0.0)


def plan_of(text, ground, track_s=10.0, frame=Frame.TAKEOFF):
    trajectory = place(trajectory_from_text(text), frame, ground.position_enu, ground.yaw_rad)
    return lay_out(ground, trajectory, track_s, 2.0, 1.0, LIMITS)


PLANS = [
    ("lemniscate", at_rest(0, 0, 0, 0.0)),
    ("lemniscate", at_rest(3, -2, 0, 2.5)),
    ("circle", at_rest(-1, 4, 0, -1.2)),
    ("hover", at_rest(0, 0, 0, math.pi)),
]


@pytest.mark.parametrize(("text", "ground"), PLANS)
def test_the_parts_come_in_order_and_without_gaps(text, ground):
    plan = plan_of(text, ground)
    assert [leg.phase for leg in plan.legs] == ORDER
    ends = [leg.start_s + leg.duration_s for leg in plan.legs]
    assert [leg.start_s for leg in plan.legs] == pytest.approx([0.0, *ends[:-1]])
    assert plan.duration_s == pytest.approx(ends[-1])
    assert plan.leg(Phase.TRACK).duration_s == 10.0
    assert plan.leg(Phase.HOLD).duration_s == 2.0


@pytest.mark.parametrize(("text", "ground"), PLANS)
def test_the_parts_meet(text, ground):
    """In position, velocity, acceleration and heading, on both sides of each joint."""
    plan = plan_of(text, ground)
    for leg in plan.legs[1:]:
        before, after = plan.sample(leg.start_s - 1e-7), plan.sample(leg.start_s + 1e-7)
        for name in ("position_enu", "velocity_enu", "acceleration_enu"):
            np.testing.assert_allclose(
                getattr(before, name), getattr(after, name), atol=2e-5, err_msg=f"{leg.phase} {name}"
            )
        assert math.cos(before.yaw_rad - after.yaw_rad) == pytest.approx(1.0, abs=1e-9)
        assert before.yaw_rate_rad_s == pytest.approx(after.yaw_rate_rad_s, abs=1e-4)


@pytest.mark.parametrize(("text", "ground"), PLANS)
def test_velocity_is_the_derivative_of_position_and_nothing_jumps(text, ground):
    plan = plan_of(text, ground)
    step_s = 0.01
    samples = [plan.sample(step_s * k) for k in range(int(plan.duration_s / step_s))]
    positions = np.array([sample.position_enu for sample in samples])
    velocities = np.array([sample.velocity_enu for sample in samples])
    # Trapezoidal rule: exact up to h³/12 times the snap between joints, h²/4 times a jump of jerk at them.
    moved = 0.5 * step_s * (velocities[1:] + velocities[:-1])
    np.testing.assert_allclose(np.diff(positions, axis=0), moved, atol=5e-5)


@pytest.mark.parametrize(("text", "ground"), PLANS)
def test_begins_where_the_vehicle_stands_and_ends_above_it_at_rest(text, ground):
    plan = plan_of(text, ground)
    first, last = plan.sample(0.0), plan.sample(plan.duration_s + 100.0)
    np.testing.assert_allclose(first.position_enu, ground.position_enu, atol=1e-9)
    np.testing.assert_allclose(last.position_enu[:2], ground.position_enu[:2], atol=1e-6)
    np.testing.assert_allclose(last.velocity_enu, np.zeros(3), atol=1e-6)
    assert last.position_enu[2] > ground.position_enu[2] + 0.9
    assert math.cos(last.yaw_rad - ground.yaw_rad) == pytest.approx(1.0)


def test_everything_but_the_tracking_keeps_the_limits():
    plan = plan_of("lemniscate", at_rest(3, -2, 0, 2.5))
    for leg in plan.legs:
        if leg.phase in (Phase.TRACK, Phase.RUN_IN, Phase.RUN_OUT):
            continue  # these meet the trajectory's own velocity
        for moment in np.linspace(leg.start_s, leg.start_s + leg.duration_s - 1e-6, 200):
            sample = plan.sample(float(moment))
            assert np.linalg.norm(sample.velocity_enu) <= 0.8 + 1e-6
            assert np.linalg.norm(sample.acceleration_enu) <= 0.8 + 1e-6


def test_a_trajectory_laid_out_from_the_take_off_turns_with_the_vehicle():
    """Standing at (3, −2) with the nose 90° to the left, the trajectory's x is +y of the world."""
    ground = at_rest(3, -2, 0, math.pi / 2)
    own, turned = trajectory_from_text("lemniscate"), plan_of("lemniscate", ground).leg(Phase.TRACK)
    x, y, z = own.sample(1.0).position_enu
    np.testing.assert_allclose(turned.trajectory.sample(1.0).position_enu, [3.0 - y, -2.0 + x, z], atol=1e-12)
    local = plan_of("lemniscate", ground, frame=Frame.LOCAL).leg(Phase.TRACK)
    np.testing.assert_allclose(local.trajectory.sample(1.0).position_enu, [x, y, z], atol=1e-12)


def test_tracking_time_counts_from_the_beginning_of_tracking():
    plan = plan_of("lemniscate", at_rest(0, 0, 0, 0.0))
    track = plan.leg(Phase.TRACK)
    assert tracking_time(plan, track.start_s + 1.5) == pytest.approx(1.5)
    assert math.isnan(tracking_time(plan, track.start_s - 0.1))
    assert math.isnan(tracking_time(plan, track.start_s + track.duration_s + 0.1))
    assert plan.leg_at(-5.0).phase is Phase.CLIMB
    assert plan.leg_at(1e6).phase is Phase.RETURN


def test_stopping_from_full_flight():
    now = plan_of("lemniscate", at_rest(0, 0, 0, 0.0)).leg(Phase.TRACK).trajectory.sample(2.3)
    plan = stopping_plan(now, LIMITS, 10.0)
    np.testing.assert_allclose(plan.sample(0.0).position_enu, now.position_enu, atol=1e-9)
    np.testing.assert_allclose(plan.sample(0.0).velocity_enu, now.velocity_enu, atol=1e-9)
    assert plan.legs[-1].phase is Phase.HOLD
    rest = plan.sample(plan.duration_s)
    np.testing.assert_allclose(rest.velocity_enu, np.zeros(3), atol=1e-9)
    np.testing.assert_allclose(rest.position_enu, plan.legs[0].trajectory.sample(1e3).position_enu, atol=1e-6)


def test_a_plan_that_begins_in_the_air_begins_as_the_vehicle_moves_and_ends_where_it_stopped():
    zero = np.zeros(3)
    velocity = np.array([1.5, -1.0, 0.2])
    start = Reference(np.array([3.0, 4.0, 5.0]), velocity, zero, zero, zero, 0.7, 0.0, 0.0)
    stop = run_out(start, LIMITS)
    rest = stop.sample(stop.duration_s)
    trajectory = place(trajectory_from_text("circle"), Frame.TAKEOFF, rest.position_enu, rest.yaw_rad)
    plan = lay_out_in_air(stop, trajectory, 10.0, 2.0, LIMITS)
    assert [leg.phase for leg in plan.legs] == [Phase.STOP, *ORDER[1:]]
    np.testing.assert_allclose(plan.sample(0.0).position_enu, start.position_enu, atol=1e-12)
    np.testing.assert_allclose(plan.sample(0.0).velocity_enu, velocity, atol=1e-12)
    end = plan.sample(plan.duration_s)
    np.testing.assert_allclose(end.position_enu, rest.position_enu, atol=1e-9)
    np.testing.assert_allclose(end.velocity_enu, 0.0, atol=1e-9)
    for leg in plan.legs[1:]:
        before, after = plan.sample(leg.start_s - 1e-7), plan.sample(leg.start_s + 1e-7)
        np.testing.assert_allclose(before.position_enu, after.position_enu, atol=1e-5)
        np.testing.assert_allclose(before.velocity_enu, after.velocity_enu, atol=1e-5)


@pytest.mark.parametrize("ground_m", [2.0, -3.0])
def test_the_take_off_height_is_above_the_ground_wherever_the_frame_has_its_zero(ground_m):
    climb = plan_of("hover", at_rest(1, 2, ground_m, 0.0)).leg(Phase.CLIMB)
    assert climb.trajectory.sample(climb.duration_s).position_enu[2] == pytest.approx(ground_m + 1.0)


def test_a_plan_that_is_changed_goes_on_from_there_without_a_step():
    """An hour of tracking that ends after 4 s: what was behind it follows at once."""
    plan = plan_of("lemniscate", at_rest(0, 0, 0, 0.0), track_s=3600.0)
    track = plan.leg(Phase.TRACK)
    cut_s = track.start_s + 4.0
    home = resting(np.array([0.0, 0.0, 1.0]), 0.0)
    before = plan.sample(cut_s - 1e-9)
    plan.change_from(cut_s, way_back(track.trajectory.sample(4.0), home, LIMITS))
    assert [leg.phase for leg in plan.legs] == ORDER
    assert plan.leg(Phase.RUN_OUT).start_s == pytest.approx(cut_s) and plan.duration_s < cut_s + 20.0
    after = plan.sample(cut_s + 1e-9)
    for name in ("position_enu", "velocity_enu", "acceleration_enu"):
        np.testing.assert_allclose(getattr(before, name), getattr(after, name), atol=1e-6)
    np.testing.assert_allclose(plan.sample(plan.duration_s).position_enu, [0, 0, 1], atol=1e-9)


def test_an_hour_of_references_that_are_not_known_yet_is_not_sampled():
    live = trajectory_or_live("live:udp:14700")
    live.stand_at(np.array([0.0, 0.0, 1.0]), 0.0)
    ground = at_rest(0, 0, 0, 0.0)
    plan = lay_out(ground, place(live, Frame.TAKEOFF, ground.position_enu, 0.0), 1e7, 2.0, 1.0, LIMITS)
    fence = SafetyLimits().fence
    assert plan_margins(fence, plan, ground.position_enu).horizontal_m == pytest.approx(fence.radius_m)
