"""What the ground carries, worked out by hand."""

from __future__ import annotations

import math

import pytest

from companion.autopilot.adapter import VehicleStatus
from companion.flight.ground_contact import GRAVITY, GroundContact
from companion.mavlink.link import mav

UP = (0.0, 0.0, 1.0)


def watch(
    seconds, status=None, height_m=0.3, velocity=lambda t: 0.0, thrust=1.0, axis=lambda t: UP, error_deg=0.0
):
    """The answer after `seconds` at 100 Hz, which began 5 s after lift-off."""
    contact, answer, status = GroundContact(), None, status or VehicleStatus()
    for step in range(round(100 * (5.0 + seconds)) + 1):
        time_s = 0.01 * step
        answer = contact.support(time_s, height_m, velocity(time_s), thrust, axis(time_s), error_deg, status)
    return answer


def test_a_vehicle_that_stands_on_the_ground_leaves_it_a_share_of_its_weight():
    assert watch(1.0, thrust=0.6) == pytest.approx(0.4)


def test_a_falling_vehicle_is_carried_by_nothing():
    assert watch(1.0, thrust=0.6, velocity=lambda t: -0.4 * GRAVITY * t) == pytest.approx(0.0)
    assert watch(1.0) == pytest.approx(0.0)


def test_more_thrust_than_weight_is_no_contact_whatever_the_curve_of_thrust():
    assert watch(1.0, thrust=1.2, velocity=lambda t: 0.5 * GRAVITY * t) == pytest.approx(-0.2)


def test_tilt_takes_lift():
    tilted = (math.sin(0.5), 0.0, math.cos(0.5))
    assert watch(1.0, axis=lambda t: tilted) == pytest.approx(1.0 - math.cos(0.5))


def test_a_vehicle_that_does_not_turn_although_it_is_asked_to_stands():
    assert watch(1.0, error_deg=12.0) == 1.0
    turning = watch(1.0, error_deg=12.0, axis=lambda t: (math.sin(0.1 * t), 0.0, math.cos(0.1 * t)))
    assert turning is not None and turning < 0.2  # 0.1 rad/s are 2.9° within the window


def test_the_land_detector_counts_once_it_has_said_flying():
    status = VehicleStatus(landed_state=mav.MAV_LANDED_STATE_ON_GROUND)
    status.heard_s[mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE] = 5.9
    assert watch(1.0, status) == pytest.approx(0.0)  # it has not noticed the lift-off yet
    contact = GroundContact()
    for step in range(601):
        status.landed_state = mav.MAV_LANDED_STATE_IN_AIR if step < 550 else mav.MAV_LANDED_STATE_ON_GROUND
        answer = contact.support(0.01 * step, 0.3, 0.0, 1.0, UP, 0.0, status)
    assert answer == 1.0


def test_nothing_is_said_high_up_or_just_after_lift_off():
    assert watch(1.0, thrust=0.6, height_m=2.5) is None
    assert watch(-0.5, thrust=0.6) is None
