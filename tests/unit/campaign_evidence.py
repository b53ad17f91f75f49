"""Evidence of flights that never were: one that went well, in pieces that a test can break."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

os.environ.setdefault("MAVLINK20", "1")
from campaign.draw import PlannedFlight, Variation
from campaign.evidence import Evidence, LogEvent
from campaign.tape import ARMED, BOX_WIDTH, MODE, POSITION, QUATERNION, TIME
from campaign.wire import ARM_DISARM, DO_SET_MODE, Frame, Wire, frame_of
from pymavlink.dialects.v20 import all as mav

OFFBOARD, LAND = 6 << 16, 4 << 16 | 6 << 24
OFFBOARD_MODE, LAND_MODE = (6,), (4, 6)
"""Main and sub mode of DO_SET_MODE."""
TAKEN_S, OVER_S, END_S = 4.0, 20.0, 24.0
_codec = mav.MAVLink(None, srcSystem=1, srcComponent=1)

PLAN = PlannedFlight(
    firmware="px4",
    seed=1,
    stub_firmware="px4",
    profile="qball2",
    vehicle="qball2",
    variation=Variation(),
    wind_m_s=0.0,
    gust_m_s=0.0,
    estimator="mocap",
    level="attitude",
    controller="dtlannc",
    trajectory="hover",
    duration_s=5.0,
    fence_radius_m=2.0,
)


def frame(message: object, time_s: float, outgoing: bool = False) -> Frame:
    """A message as it passes."""
    return frame_of(outgoing, time_s, bytes(message.pack(_codec)))


def heartbeat(time_s: float, mode: int, armed: bool) -> Frame:
    """PX4's."""
    return frame(mav.MAVLink_heartbeat_message(2, 12, 1 | 128 * armed, mode, 4, 3), time_s)


def position(time_s: float, north_m: float) -> Frame:
    """LOCAL_POSITION_NED."""
    return frame(mav.MAVLink_local_position_ned_message(int(time_s * 1e3), north_m, 0, -1, 0, 0, 0), time_s)


def sticks(time_s: float, roll_us: int) -> Frame:
    """RC_CHANNELS with the roll stick somewhere."""
    values = [roll_us, 1500, 1500, 1500] + [1500] * 14
    return frame(mav.MAVLink_rc_channels_message(int(time_s * 1e3), 8, *values, 100), time_s)


def setpoint(time_s: float, thrust: float = 0.4, quaternion: tuple[float, ...] = (1, 0, 0, 0)) -> Frame:
    """SET_ATTITUDE_TARGET."""
    message = mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, quaternion, 0, 0, 0, thrust)
    return frame(message, time_s, outgoing=True)


def command(time_s: float, number: int, *parameters: float) -> Frame:
    """COMMAND_LONG from the companion."""
    filled = (*parameters, *(0.0,) * (7 - len(parameters)))
    return frame(mav.MAVLink_command_long_message(1, 1, number, 0, *filled), time_s, outgoing=True)


def flight_frames() -> list[Frame]:
    """A whole flight: mode, arming, setpoints, landing."""
    frames = [
        heartbeat(1.0, 0, False),
        position(1.0, 0.0),
        command(3.0, DO_SET_MODE, 1, *OFFBOARD_MODE),
        heartbeat(3.1, OFFBOARD, False),
    ]
    frames += [command(3.5, ARM_DISARM, 1), heartbeat(TAKEN_S, OFFBOARD, True)]
    for step in range(160):
        time_s = TAKEN_S + 0.1 * step
        frames += [position(time_s, 0.2), setpoint(time_s)]
    return [
        *frames,
        command(OVER_S, DO_SET_MODE, 1, *LAND_MODE),
        heartbeat(OVER_S + 0.1, LAND, True),
        heartbeat(END_S, LAND, False),
    ]


def box() -> np.ndarray:
    """(n, BOX_WIDTH): up to 1 m at 5 s, there until OVER_S, down and disarmed at END_S."""
    times = np.arange(0.0, END_S + 1.0, 0.02)
    rows = np.zeros((len(times), BOX_WIDTH))
    rows[:, TIME] = times
    rows[:, ARMED] = (times >= TAKEN_S) & (times < END_S)
    rows[:, MODE] = np.where(times < OVER_S, OFFBOARD, LAND)
    rows[:, QUATERNION] = (1.0, 0.0, 0.0, 0.0)
    height = np.interp(times, [TAKEN_S, 5.0, OVER_S, END_S], [0.0, 1.0, 1.0, 0.0])
    rows[:, POSITION] = np.column_stack([np.zeros_like(times), np.zeros_like(times), -height])
    return rows


def good(**changes: object) -> Evidence:
    """A flight that kept everything; `frames` stands for the wire's."""
    frames = changes.pop("frames", None)
    text = "flown as planned, landed and disarmed"
    evidence = Evidence(
        planned=PLAN,
        code=0,
        words=("[land]", f"completed: {text}"),
        box=box(),
        ticks=np.column_stack([np.arange(0.0, 24.0, 0.01)] * 3),
        companion_ended_s=END_S + 0.2,
        armed_at_s=TAKEN_S,
        wire=Wire(tuple(frames if frames is not None else [*flight_frames(), *answers(24.0)]), True, END_S),
        events=(LogEvent("ended", END_S, {"outcome": "completed", "text": text}),),
        tracked_s=5.0,
        position_error_m=0.1,
        rms_error_m=0.05,
    )
    return replace(evidence, **changes)


def answers(until_s: float) -> list[Frame]:
    """The TIMESYNC answers that go with the ticks of `good`."""
    times = np.arange(0.01, until_s, 0.01)
    return [
        frame(mav.MAVLink_timesync_message(5_000_000_000, round(time_s * 1e9)), float(time_s), outgoing=True)
        for time_s in times
    ]


def with_row(before: np.ndarray, time_s: float, column: int | slice, value: object) -> np.ndarray:
    """The black box with something else from `time_s` on."""
    rows = before.copy()
    rows[rows[:, TIME] >= time_s, column] = value
    return rows
