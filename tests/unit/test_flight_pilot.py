"""Who moves the sticks: a thumb, or a receiver that has lost its transmitter."""

from __future__ import annotations

import pytest

from companion.flight.pilot import Pilot
from companion.mavlink.link import mav

REST = (1500, 1500, 1450, 1500)


def rc(*sticks, rssi=200, count=8):
    return mav.MAVLink_rc_channels_message(0, count, *sticks, *[1500] * 14, rssi)


def watched(rest=REST):
    """A pilot whose sticks have rested for a second, and the time."""
    pilot = Pilot(0.15)
    for step in range(10):
        pilot.take(rc(*rest), 0.1 * step, True)
    pilot.sticks_are_at_rest()
    return pilot, 1.0


def feed(pilot, at_s, message, seconds, healthy=True):
    """The same message at 10 Hz; returns the time afterwards."""
    for step in range(round(10 * seconds)):
        pilot.take(message, at_s + 0.1 * step, healthy)
    return at_s + seconds


LOST = {
    "throttle at 900 µs": (rc(1500, 1500, 900, 1500), True),
    "signal strength 0": (rc(1500, 1500, 1000, 1500, rssi=0), True),
    "receiver unhealthy in SYS_STATUS": (rc(1500, 1500, 1100, 1500), False),
    "no signal in RC_CHANNELS": (rc(65535, 65535, 65535, 65535), True),
    "sticks jumped to (1500, 1500, 1100, 1500) µs and stand still": (rc(1500, 1500, 1100, 1500), True),
    "sticks jumped to (1100, 1100, 1100, 1100) µs and stand still": (rc(1100, 1100, 1100, 1100), True),
}


@pytest.mark.parametrize("sign", LOST)
def test_a_lost_transmitter_is_said_and_is_no_movement(sign):
    pilot, now_s = watched()
    message, healthy = LOST[sign]
    now_s = feed(pilot, now_s, message, 0.4, healthy)
    assert pilot.lost_transmitter(now_s) == ""  # a receiver may miss a few frames
    now_s = feed(pilot, now_s, message, 1.0, healthy)
    assert pilot.lost_transmitter(now_s) == sign
    assert pilot.moved_sticks() == ""
    now_s = feed(pilot, now_s, rc(*REST), 0.3)
    assert pilot.lost_transmitter(now_s) == ""
    assert pilot.moved_sticks() == ""


def test_values_that_stand_still_are_no_movement():
    pilot, now_s = watched()
    now_s = feed(pilot, now_s, rc(*REST), 30.0)
    assert pilot.moved_sticks() == "" and pilot.lost_transmitter(now_s) == ""
    assert pilot.alive_s < 1.0


@pytest.mark.parametrize(
    ("sticks", "says"),
    [
        ((1500, 1750, 1450, 1500), "pitch by +25%"),
        ((1900, 1100, 1800, 1300), "roll by +40%, pitch by -40%, throttle by +35%, yaw by -20%"),
        ((1200, 1500, 1000, 1500), "roll by -30%, throttle by -45%"),
    ],
)
def test_roll_pitch_and_yaw_are_a_pilots_at_once(sticks, says):
    pilot, now_s = watched()
    feed(pilot, now_s, rc(*sticks), 0.2)
    assert pilot.moved_sticks() == says


def test_a_throttle_that_is_pulled_down_by_hand_is_a_pilots():
    pilot, now_s = watched()
    for throttle in (1380, 1250, 1100, 1000):
        now_s = feed(pilot, now_s, rc(1500, 1500, throttle, 1500), 0.1)
    assert pilot.moved_sticks() == "throttle by -45%"


def test_a_throttle_that_jumps_and_stirs_again_is_a_pilots():
    pilot, now_s = watched()
    now_s = feed(pilot, now_s, rc(1500, 1500, 1000, 1500), 0.5)
    assert pilot.moved_sticks() == ""
    feed(pilot, now_s, rc(1500, 1506, 1000, 1500), 0.1)
    assert pilot.moved_sticks() == "throttle by -45%"


def test_a_pilot_who_comes_back_with_other_sticks_takes_over():
    pilot, now_s = watched()
    now_s = feed(pilot, now_s, rc(1500, 1500, 900, 1500), 2.0)
    feed(pilot, now_s, rc(1500, 1800, 1450, 1500), 0.2)
    assert pilot.moved_sticks() == "pitch by +30%"


def test_who_was_never_there_is_not_lost():
    pilot = Pilot(0.15)
    pilot.sticks_are_at_rest()
    now_s = feed(pilot, 0.0, rc(65535, 65535, 65535, 65535, rssi=0, count=0), 5.0, healthy=False)
    assert pilot.lost_transmitter(now_s) == "" and pilot.moved_sticks() == ""


def test_a_receiver_that_never_measures_its_signal_is_believed():
    pilot = Pilot(0.15)
    feed(pilot, 0.0, rc(*REST, rssi=0), 1.0, None)
    pilot.sticks_are_at_rest()
    now_s = feed(pilot, 1.0, rc(1500, 1800, 1450, 1500, rssi=0), 1.0, None)
    assert pilot.moved_sticks() == "pitch by +30%" and pilot.lost_transmitter(now_s) == ""


def test_the_arming_gesture_is_over_when_yaw_is_back_and_all_stand_still():
    pilot, held = Pilot(0.15), (1500, 1500, 1000, 2000)
    assert pilot.lets_go(0.0)  # nobody with sticks there
    now_s = feed(pilot, 0.0, rc(*held), 3.0)
    assert not pilot.lets_go(now_s)  # still, but held
    now_s = feed(pilot, now_s, rc(1500, 1500, 1000, 1510), 0.3)
    assert not pilot.lets_go(now_s)  # back for 0.3 s
    now_s = feed(pilot, now_s, rc(1500, 1500, 1000, 1510), 0.4)
    assert pilot.lets_go(now_s)
