"""What a serial line carries, against counts made by hand from the message definitions."""

import pytest

from companion.config.errors import UserError
from companion.mavlink.bandwidth import describe, frame_bytes, plan_line, spare_rate
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.link import mav

SPARE = {mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: 50.0, mav.MAVLINK_MSG_ID_HEARTBEAT: 10.0}


def test_frames_are_as_long_as_the_protocol_says() -> None:
    # payloads in common.xml: HEARTBEAT 9, LOCAL_POSITION_NED 28, ATTITUDE_QUATERNION 32 + 16 (extension)
    assert frame_bytes(mav.MAVLINK_MSG_ID_HEARTBEAT) == 12 + 9
    assert frame_bytes(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED) == 12 + 28
    assert frame_bytes(mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, signed=True) == 12 + 48 + 13


def test_a_fast_line_carries_everything() -> None:
    plan = plan_line(parse_endpoint("/dev/ttyAMA0,921600"), 250.0, 100.0, SPARE, signed=False)
    assert plan is not None and (plan.rate_hz, plan.spare_share) == (250.0, 1.0)
    assert plan.usable_bytes_s == pytest.approx(0.8 * 92160)
    # 250 × 60 + 100 × 40 + 20 × 28 (TIMESYNC: 16) + 50 × 49 (ATTITUDE_TARGET: 37) + 10 × 21
    assert plan.down_bytes_s == 15000 + 4000 + 560 + 2450 + 210
    # 250 × 51 (SET_ATTITUDE_TARGET: 39) + 20 × 28 + 21
    assert plan.up_bytes_s == 12750 + 560 + 21
    assert "warning" not in describe(plan, 250.0)


def test_57600_baud_fly_the_attitude_level_slowly_and_say_so() -> None:
    plan = plan_line(parse_endpoint("/dev/ttyUSB0,57600"), 100.0, 20.0, SPARE, signed=False)
    assert plan is not None and 20.0 <= plan.rate_hz < 40.0
    assert (1000.0 / plan.rate_hz) % 1.0 == pytest.approx(0.0)  # whole milliseconds, for ArduPilot
    assert plan.down_bytes_s <= 0.8 * 5760 and plan.up_bytes_s <= 0.8 * 5760
    assert describe(plan, 100.0).startswith("warning: ") and "raise the baud rate" in describe(plan, 100.0)


@pytest.mark.parametrize(("baud", "least"), [(57600, 50.0), (9600, 20.0)])
def test_too_slow_a_line_is_refused_with_one_that_is_fast_enough(baud: int, least: float) -> None:
    endpoint = parse_endpoint(f"/dev/ttyUSB0,{baud}")
    with pytest.raises(
        UserError, match=rf"{baud} baud carry \d+ bytes/s .* use (\d+) baud or more"
    ) as caught:
        plan_line(endpoint, 200.0, least, SPARE, signed=False)
    enough = int(str(caught.value).split("use ")[1].split()[0])
    plan = plan_line(parse_endpoint(f"/dev/ttyUSB0,{enough + 1}"), 200.0, least, SPARE, signed=False)
    assert plan is not None and plan.rate_hz >= least


def test_signatures_cost() -> None:
    endpoint = parse_endpoint("/dev/ttyUSB0,115200")
    plain = plan_line(endpoint, 100.0, 20.0, SPARE, signed=False)
    signed = plan_line(endpoint, 100.0, 20.0, SPARE, signed=True)
    assert plain is not None and signed is not None
    assert signed.rate_hz <= plain.rate_hz
    assert frame_bytes(0, signed=True) - frame_bytes(0) == 13


def test_networks_are_not_judged() -> None:
    assert plan_line(parse_endpoint("udpin:0.0.0.0:14540"), 250.0, 20.0, SPARE, signed=False) is None
    assert plan_line(parse_endpoint("/dev/ttyACM0"), 250.0, 20.0, SPARE, signed=False) is None  # USB
    assert plan_line(parse_endpoint("tcp:127.0.0.1:5760"), 250.0, 20.0, SPARE, signed=False) is None


def test_spare_messages_come_less_often_but_come() -> None:
    assert spare_rate(50.0, 0.1) == 5.0
    assert spare_rate(10.0, 0.5) == 5.0
    assert spare_rate(2.0, 0.1) == 2.0
    assert spare_rate(50.0, 1.0) == 50.0
