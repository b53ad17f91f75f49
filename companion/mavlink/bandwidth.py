"""What a serial line can carry, beside what a flight asks for: rates are lowered to fit, or the flight is refused.

A UART sends 10 bits a byte (start, 8, stop), each way by itself. USB (`/dev/ttyACM*`) ignores the baud rate and is only
better. Radios that say 57600 carry less than half of it; what they really do shows in `companion check` as lost frames.
Counted are the messages we ask for; an autopilot's other streams on the same port come on top of them (PX4: MAV_n_MODE,
MAV_n_RATE).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from companion.config.errors import UserError
from companion.mavlink.endpoint import Endpoint, EndpointKind
from companion.mavlink.link import mav
from companion.mavlink.signing import SIGNATURE_BYTES

BITS_PER_BYTE = 10.0
USABLE_SHARE = 0.8  # the rest is for parameters, texts and what the autopilot sends unasked
FRAME_BYTES = 12  # of MAVLink 2 around a payload
POSITION_RATE_HZ = 100.0  # more of LOCAL_POSITION_NED is not asked for
LEAST_SPARE_HZ = 5.0
_SPARE_SHARES = (1.0, 0.5, 0.1)


@dataclass(frozen=True, slots=True)
class LinePlan:
    """Rates that fit a line, and what they take of it."""

    rate_hz: float  # of states and setpoints
    spare_share: float  # of the rates of messages that are only good to have, see `spare_rate`
    down_bytes_s: float  # from the autopilot
    up_bytes_s: float  # to it
    usable_bytes_s: float  # each way


def plan_line(
    endpoint: Endpoint, rate_hz: float, least_hz: float, spare: Mapping[int, float], signed: bool
) -> LinePlan | None:
    """Fit a flight's messages to a serial line; None for wires whose speed is not ours to know.

    Args:
        endpoint: where the autopilot is.
        rate_hz: states and setpoints a second, as wished.
        least_hz: the least at which the level can be flown.
        spare: message number → Hz, of messages that are good to have.
        signed: frames carry a signature.

    Raises:
        UserError: even `least_hz` does not fit.
    """
    if endpoint.kind is not EndpointKind.SERIAL or Path(endpoint.host).resolve().name.startswith("ttyACM"):
        return None
    usable = USABLE_SHARE * endpoint.number / BITS_PER_BYTE
    wished = [rate_hz, *(hz for period_ms in range(2, 51) if (hz := 1000.0 / period_ms) < rate_hz)]
    for candidate in wished:
        if candidate < least_hz:
            break
        for share in _SPARE_SHARES:
            down = _down_bytes_s(candidate, spare, share, signed)
            up = _up_bytes_s(candidate, signed)
            if max(down, up) <= usable:
                return LinePlan(candidate, share, down, up, usable)
    down = _down_bytes_s(least_hz, spare, _SPARE_SHARES[-1], signed)
    enough = max(down, _up_bytes_s(least_hz, signed)) / USABLE_SHARE * BITS_PER_BYTE
    raise UserError(
        f"endpoint {endpoint}: {endpoint.number} baud carry {usable:.0f} bytes/s of messages, this level needs "
        f"{down:.0f} at {least_hz:.0f} Hz; use {enough:.0f} baud or more (921600 where the wire is short), "
        "here and in the autopilot (PX4: SER_TEL2_BAUD, ArduPilot: SERIAL2_BAUD), or a higher --level"
    )


def describe(plan: LinePlan, wished_hz: float) -> str:
    """One line for the pilot: what is asked for and what the line carries."""
    used = max(plan.down_bytes_s, plan.up_bytes_s) / plan.usable_bytes_s
    text = (
        f"serial line: {plan.down_bytes_s:.0f} bytes/s asked for, {plan.up_bytes_s:.0f} sent, "
        f"of {plan.usable_bytes_s:.0f} usable each way ({used * 100:.0f} %)"
    )
    if plan.rate_hz < wished_hz:
        return (
            f"warning: {text}; {plan.rate_hz:.0f} states a second instead of {wished_hz:.0f}, to fit: "
            "tracking will be worse; raise the baud rate"
        )
    if plan.spare_share < 1.0:
        return f"{text}; messages that are only good to have come less often"
    return text


def spare_rate(rate_hz: float, share: float) -> float:
    """Rate of a message that is only good to have, on a line that carries `share` of them (Hz)."""
    return min(rate_hz, max(LEAST_SPARE_HZ, rate_hz * share))


def frame_bytes(message_id: int, signed: bool = False) -> int:
    """Longest frame of a message: MAVLink 2 leaves out zeros at a payload's end, so most are shorter."""
    payload = int(mav.mavlink_map[message_id].unpacker.size)
    return FRAME_BYTES + payload + (SIGNATURE_BYTES if signed else 0)


def _down_bytes_s(rate_hz: float, spare: Mapping[int, float], share: float, signed: bool) -> float:
    needed = {
        mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: rate_hz,
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: min(rate_hz, POSITION_RATE_HZ),
        mav.MAVLINK_MSG_ID_TIMESYNC: 20.0,
        **{number: spare_rate(hz, share) for number, hz in spare.items()},
    }
    return sum(hz * frame_bytes(number, signed) for number, hz in needed.items())


def _up_bytes_s(rate_hz: float, signed: bool) -> float:
    needed = {
        mav.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: rate_hz,
        mav.MAVLINK_MSG_ID_TIMESYNC: 20.0,
        mav.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    }
    return sum(hz * frame_bytes(number, signed) for number, hz in needed.items())
