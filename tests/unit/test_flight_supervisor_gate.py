"""The last gate before the wire, the fence, the pilot's sticks, and the watchdog over the loop."""

import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.safety import Fence, SafetyLimits
from companion.control.structs import ControlLevel, Setpoint
from companion.flight.fence import horizontal_margin, plan_margins, require_inside
from companion.flight.outcome import Refused
from companion.flight.phases import Phase
from companion.flight.pilot import Pilot
from companion.flight.plan import FlightPlan, stopping_plan
from companion.flight.realtime import LoopWatchdog
from companion.flight.setpoint_gate import SetpointGate
from companion.reference.hold import Hold
from companion.reference.lemniscate import Lemniscate
from companion.reference.transit import TransitLimits

GATE = SetpointGate(np.radians([220.0, 220.0, 120.0]))
LEVEL = (1.0, 0.0, 0.0, 0.0)
BAD = st.sampled_from([math.nan, math.inf, -math.inf])


def setpoint(level=ControlLevel.ATTITUDE, newton=20.0, quaternion=LEVEL, rate=(0.0, 0.0, 0.0)):
    return Setpoint(level, newton, np.array(quaternion), np.array(rate), np.zeros(3))


# The gate ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [ControlLevel.ATTITUDE, ControlLevel.BODY_RATE])
def test_a_sound_setpoint_passes(level):
    half = math.sqrt(0.5)
    assert GATE.refusal(setpoint(level, quaternion=(half, 0.0, half, 0.0), rate=(3.8, -3.8, 2.0)), 0.4) == ""
    assert GATE.refusal(setpoint(ControlLevel.ACTUATOR), 0.4, np.array([0.1, -1.0, 1.0, 0.5])) == ""


@given(value=BAD, place=st.integers(0, 8))
def test_nothing_that_is_no_number_passes_at_any_level(value, place):
    numbers = [0.4, 20.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    numbers[place] = value
    thrust, newton, quaternion, rate = numbers[0], numbers[1], numbers[2:6], numbers[6:9]
    sent = {  # what each level puts on the wire; the quaternion is not on it with body rates
        ControlLevel.ATTITUDE: True,
        ControlLevel.BODY_RATE: not 2 <= place <= 5,
    }
    for level, refused in sent.items():
        assert bool(GATE.refusal(setpoint(level, newton, quaternion, rate), thrust)) == refused
    controls = np.zeros(4)
    controls[place % 4] = value
    assert GATE.refusal(setpoint(ControlLevel.ACTUATOR), 0.4, controls)


@pytest.mark.parametrize(
    ("thrust", "quaternion", "rate", "says"),
    [
        (-0.01, LEVEL, (0, 0, 0), "thrust -0.01"),
        (1.001, LEVEL, (0, 0, 0), "thrust 1.001"),
        (0.4, (1.002, 0.0, 0.0, 0.0), (0, 0, 0), "length 1.002"),
        (0.4, (0.0, 0.0, 0.0, 0.0), (0, 0, 0), "length 0"),
        (0.4, LEVEL, (0.0, 4.0, 0.0), "229.2"),  # 4 rad/s, of 220 °/s
        (0.4, LEVEL, (0.0, 0.0, -2.2), "-126.1"),
    ],
)
def test_bounds_are_named_in_numbers(thrust, quaternion, rate, says):
    assert says in GATE.refusal(setpoint(quaternion=quaternion, rate=rate), thrust)


# The fence ---------------------------------------------------------------------------------------------

L_SHAPE = Fence(
    shape="polygon", polygon_m=((-1.0, -1.0), (4.0, -1.0), (4.0, 1.0), (1.0, 1.0), (1.0, 4.0), (-1.0, 4.0))
)


@pytest.mark.parametrize(
    ("fence", "east", "north", "margin"),
    [
        (Fence(radius_m=5.0), 3.0, 4.0, 0.0),
        (Fence(radius_m=5.0), 0.0, -2.0, 3.0),
        (Fence(radius_m=5.0), 6.0, 8.0, -5.0),
        (Fence(shape="box", box_m=(-1.0, -2.0, 3.0, 4.0)), 2.5, 0.0, 0.5),
        (Fence(shape="box", box_m=(-1.0, -2.0, 3.0, 4.0)), 6.0, 8.0, -5.0),
        (Fence(shape="box", box_m=(-1.0, -2.0, 3.0, 4.0)), 0.0, 4.5, -0.5),
        (L_SHAPE, 0.0, 0.0, 1.0),
        (L_SHAPE, 3.0, 0.5, 0.5),
        (L_SHAPE, 2.0, 2.0, -1.0),  # in the notch of the L
        (L_SHAPE, 0.5, 3.0, 0.5),
        (L_SHAPE, 4.0, 5.0, -math.hypot(3.0, 1.0)),  # nearest is the corner (1, 4)
    ],
)
def test_margins_worked_out_by_hand(fence, east, north, margin):
    assert horizontal_margin(fence, east, north) == pytest.approx(margin, abs=1e-12)


@given(x=st.floats(-8, 8), y=st.floats(-8, 8))
def test_a_rectangle_as_polygon_is_a_box(x, y):
    box = Fence(shape="box", box_m=(-1.0, -2.0, 3.0, 4.0))
    polygon = Fence(shape="polygon", polygon_m=((-1.0, -2.0), (3.0, -2.0), (3.0, 4.0), (-1.0, 4.0)))
    assert horizontal_margin(polygon, x, y) == pytest.approx(horizontal_margin(box, x, y), abs=1e-9)


def test_a_plan_that_leaves_the_fence_is_refused_before_it_flies():
    plan = FlightPlan([(Phase.TRACK, Hold(2.0, 0.0, 1.0), 1.0), (Phase.RETURN, Hold(0.0, 0.0, 1.5), 1.0)])
    home = np.array([0.5, 0.0, 0.5])
    margins = plan_margins(Fence(radius_m=2.0, height_max_m=3.0), plan, home)
    assert (margins.horizontal_m, margins.ceiling_m) == pytest.approx((0.5, 2.0))
    require_inside(SafetyLimits(fence=Fence(radius_m=2.0)), plan, home)
    with pytest.raises(Refused, match=r"0\.20 m to the fence 0\.0 s"):
        require_inside(SafetyLimits(fence=Fence(radius_m=1.7)), plan, home)
    with pytest.raises(Refused, match="height_max_m"):
        require_inside(SafetyLimits(fence=Fence(radius_m=9.0, height_max_m=1.2)), plan, home)


def test_a_hold_comes_to_rest_within_its_limits_from_any_point_of_the_lemniscate():
    limits = TransitLimits(speed_m_s=0.8, acceleration_m_s2=0.8, jerk_m_s3=2.0)
    path = Lemniscate()
    fastest = max(np.linalg.norm(path.sample(t).velocity_enu) for t in np.linspace(0.0, 8.0, 200))
    for time_s in np.linspace(0.0, 8.0, 17):
        now = path.sample(float(time_s))
        plan = stopping_plan(now, limits, 10.0)
        start = plan.sample(0.0)
        np.testing.assert_allclose(start.position_enu, now.position_enu, atol=1e-9)
        np.testing.assert_allclose(start.velocity_enu, now.velocity_enu, atol=1e-9)
        np.testing.assert_allclose(start.acceleration_enu, now.acceleration_enu, atol=1e-9)
        rest = plan.sample(plan.duration_s - 0.01)
        assert np.linalg.norm(rest.velocity_enu) == 0.0
        assert plan.duration_s - 10.0 < 5.0
        assert np.linalg.norm(rest.position_enu - now.position_enu) < 2.0
        moments = np.linspace(0.0, plan.duration_s, 200)
        speed = max(np.linalg.norm(plan.sample(t).velocity_enu) for t in moments)
        assert speed <= fastest * 1.05


# The pilot's sticks ------------------------------------------------------------------------------------


def sticks(*values, count=8):
    names = ("chan1_raw", "chan2_raw", "chan3_raw", "chan4_raw")
    return SimpleNamespace(chancount=count, rssi=255, **dict(zip(names, values, strict=True)))


def test_sticks_that_moved_before_we_flew_mean_nothing():
    pilot = Pilot(0.15)
    pilot.take(sticks(1500, 1500, 1100, 1500), 0.0)
    pilot.take(sticks(1900, 1100, 1900, 1500), 0.0)
    pilot.sticks_are_at_rest()
    pilot.take(sticks(1910, 1090, 1890, 1500), 0.0)
    pilot.take(sticks(1910, 1090, 1890, 1500), 0.0)
    assert pilot.moved_sticks() == ""


def test_a_stick_counts_from_its_second_message_on():
    pilot = Pilot(0.15)
    pilot.take(sticks(1500, 1500, 1500, 1500), 0.0)
    pilot.sticks_are_at_rest()
    pilot.take(sticks(1500, 1700, 1500, 1500), 0.0)
    assert pilot.moved_sticks() == ""
    pilot.take(sticks(1500, 1500, 1500, 1500), 0.0)
    pilot.take(sticks(1500, 1300, 1500, 1500), 0.0)
    pilot.take(sticks(1500, 1300, 1500, 1500), 0.0)
    assert pilot.moved_sticks() == "pitch by -20%"


def test_a_receiver_without_signal_is_no_pilot():
    pilot = Pilot(0.15)
    pilot.take(sticks(1500, 1500, 1500, 1500), 0.0)
    pilot.sticks_are_at_rest()
    for _ in range(3):
        pilot.take(sticks(0, 0, 0, 0), 0.0)
        pilot.take(sticks(65535, 65535, 65535, 65535), 0.0)
        pilot.take(sticks(1900, 1900, 1900, 1900, count=0), 0.0)
    assert pilot.moved_sticks() == ""


# The watchdog ------------------------------------------------------------------------------------------


def test_the_watchdog_sees_a_loop_that_hangs_and_is_told_when_it_is_over():
    seen = threading.Event()
    stalls = []

    def on_stall(still_s):
        stalls.append(still_s)
        seen.set()

    watchdog = LoopWatchdog(0.05, on_stall)
    watchdog.start()
    try:
        assert seen.wait(5.0)  # nobody beats
        assert watchdog.tripped
        assert stalls[0] > 0.05
        watchdog.beat()
        assert watchdog.longest_s >= stalls[0]
        assert watchdog.tripped  # until the flight has dealt with it
        watchdog.reset()
        seen.clear()
        assert seen.wait(5.0) and len(stalls) == 2
    finally:
        watchdog.stop()
    assert not any(thread.name == "loop watchdog" for thread in threading.enumerate())
