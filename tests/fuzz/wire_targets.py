"""Fuzz targets on the wire: the companion's MAVLink edge, the stub's in both firmwares, poses from outside.

A target takes any bytes. It may drop and count them; it may not raise, hang, or come to believe what cannot be true.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from wire_script import (
    Wait,
    checksum_holds,
    datagram_record,
    frame,
    mav,
    message_record,
    play,
    wait_record,
)

AUTOPILOT, STRANGER, GROUND = (1, 1), (1, 154), (255, 190)
INPUTS_PER_AUTOPILOT = 20


def _heartbeat(firmware: int = mav.MAV_AUTOPILOT_PX4) -> object:
    return mav.MAVLink_heartbeat_message(mav.MAV_TYPE_QUADROTOR, firmware, 81, 0, 4, 3)


# The companion ----------------------------------------------------------------------------------------------


def companion_link() -> Callable[[bytes], None]:
    """Framing, link, signatures, status, commands, parameters and state assembly, as in flight."""
    from companion.flight.vehicle import Vehicle
    from companion.mavlink.link import Link
    from companion.mavlink.signing import Signer

    class Wire:
        """A transport in memory."""

        datagrams = True

        def __init__(self) -> None:
            self.waiting: list[bytes] = []
            self.notices: list[str] = []
            self.datagrams = True

        def wait(self, timeout_s: float) -> bool:
            return bool(self.waiting)

        def receive(self) -> list[bytes]:
            chunks, self.waiting = self.waiting, []
            return chunks

        def send(self, data: bytes) -> bool:
            return True

        sender = None
        strangers = ()

        def believe_sender(self) -> None:
            pass

        greet_sender = believe_sender

    def take(data: bytes) -> None:
        options = data[0] if data else 0
        wire, now = Wire(), [1_000_000_000]
        wire.datagrams = not options & 1
        heard: list[bytes] = []
        link = Link(
            wire,  # type: ignore[arg-type]
            tap=lambda outgoing, _time_s, raw: None if outgoing else heard.append(raw),
            now_ns=lambda: now[0],
            signer=Signer(bytes(32)) if options & 2 else None,
        )
        vehicle = Vehicle(link, 1.0)
        vehicle.parameters.bytewise = bool(options & 4)
        states = []
        vehicle.on_state = states.append
        if options & 8:
            wire.waiting.append(frame(0, bytes.fromhex("0000000002035104031f"[:18]), *AUTOPILOT))
        for item in play(data[1:], AUTOPILOT, STRANGER):
            if isinstance(item, Wait):
                now[0] += round(item.seconds * 1e9)
            else:
                wire.waiting.append(item)
            while (message := link.receive(0.0)) is not None:
                vehicle._handle(message)
            link.keep_alive()
            vehicle.last_texts()
        for raw in heard:
            assert checksum_holds(raw) or link.counters["unknown messages"], f"believed: {raw.hex()}"
        if options & 2:
            assert not heard and not states, "believed without a signature"
        assert math.isfinite(link.autopilot_time_s)
        for state in states:
            numbers = (state.position_enu, state.velocity_enu, state.quaternion_wxyz, state.body_rate_flu)
            assert all(np.isfinite(part).all() for part in numbers), f"state {state}"
            assert abs(np.linalg.norm(state.quaternion_wxyz) - 1.0) < 1e-6, f"state {state}"

    return take


def companion_seeds() -> list[bytes]:
    """A short conversation of each firmware, cut, doubled and by a stranger."""
    seeds = []
    for firmware in (mav.MAV_AUTOPILOT_PX4, mav.MAV_AUTOPILOT_ARDUPILOTMEGA):
        talk = [
            message_record(_heartbeat(firmware)),
            message_record(mav.MAVLink_local_position_ned_message(100, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3)),
            message_record(mav.MAVLink_attitude_quaternion_message(104, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)),
            message_record(mav.MAVLink_timesync_message(0, 12345)),
            message_record(mav.MAVLink_timesync_message(77, 12345)),
            message_record(mav.MAVLink_sys_status_message(0, 0, 0, 500, 16000, 100, 80, 0, 0, 0, 0, 0, 0)),
            message_record(mav.MAVLink_statustext_message(2, b"PreArm: not ready")),
            message_record(mav.MAVLink_param_value_message(b"MPC_THR_HOVER", 0.5, 9, 100, 3)),
            message_record(mav.MAVLink_command_ack_message(400, 0)),
            message_record(mav.MAVLink_extended_sys_state_message(0, 1)),
            message_record(mav.MAVLink_estimator_status_message(1000, 831, *(0.1,) * 8)),
            message_record(mav.MAVLink_ekf_status_report_message(831, *(0.1,) * 5)),
            message_record(mav.MAVLink_battery_status_message(0, 0, 0, 2000, [4000] * 10, 100, 1, 1, 80)),
            message_record(mav.MAVLink_command_long_message(1, 191, 400, 0, *(1.0,) * 7), by_other=True),
            wait_record(200),
        ]
        for options in (0, 1, 2, 4, 5):
            seeds += [bytes((options,)) + b"".join(talk), bytes((options,)) + b"".join(reversed(talk))]
    raw = frame(0, bytes(9)) + frame(30, bytes(28))
    return [
        *seeds,
        b"\0" + datagram_record(raw),
        b"\1" + datagram_record(raw[:30]) + datagram_record(raw[30:]),
    ]


# The stub ---------------------------------------------------------------------------------------------------


def stub(firmware: str) -> Callable[[bytes], None]:
    """The stub's codec and firmware: what a client can send, in any mode, with time going on in between.

    An autopilot lives for INPUTS_PER_AUTOPILOT inputs, so that states are reached that one input does not reach; what
    fails is tried on a new one, and where it passes there, the note of the exception holds all inputs since the last.
    """
    from sitl_stub.firmware.ardupilot.build import build_ardupilot
    from sitl_stub.firmware.px4.build import build_px4
    from sitl_stub.mavlink.links import MemoryLink

    build = {"px4": build_px4, "ardupilot": partial(build_ardupilot, ready_after_s=1.0)}[firmware]

    def fresh() -> tuple[object, MemoryLink]:
        autopilot, link = build(), MemoryLink()
        autopilot.attach(link)
        autopilot.advance_to(2_000_000)
        return autopilot, link

    def run(autopilot: object, link: MemoryLink, data: bytes) -> None:
        read = link.reader.read_stream if data[:1] == b"\1" else link.reader.read_datagram
        for item in play(data[1:], GROUND, (1, 191)):
            if isinstance(item, Wait):
                autopilot.advance_to(autopilot.time_us + round(item.seconds * 1e6))
                continue
            for message in read(item):
                autopilot.handle(link, message)
        autopilot.advance_to(autopilot.time_us + 20_000)
        link.frames.clear()
        assert np.isfinite(autopilot.core.state).all(), "the vehicle's true state is not finite"

    history: list[bytes] = []
    current: list[object] = []

    def take(data: bytes) -> None:
        if not history or len(history) >= INPUTS_PER_AUTOPILOT:
            history.clear()
            current[:] = fresh()
        history.append(data)
        try:
            run(*current, data)
        except Exception as error:
            past = [item.hex() for item in history]
            history.clear()
            run(*fresh(), data)  # raises again where it needs no history
            error.add_note(f"inputs since the autopilot was made: {past}")
            raise

    return take


def stub_seeds() -> list[bytes]:
    """What clients send: commands, setpoints, parameters, requests."""

    def command(number: int, *p: float) -> bytes:
        return message_record(mav.MAVLink_command_long_message(1, 1, number, 0, *p, *(0.0,) * (7 - len(p))))

    level = [1.0, 0.0, 0.0, 0.0]
    position = (0, 1, 1, 1, 0b100111111000, 0, 0, -3, *(0.0,) * 8)
    talks = [
        [message_record(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)), wait_record(100)],
        [message_record(mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, level, 0, 0, 0, 0.5)),
         command(mav.MAV_CMD_DO_SET_MODE, 1, 6),
         command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1), wait_record(250)],
        [message_record(mav.MAVLink_set_position_target_local_ned_message(*position)),
         command(mav.MAV_CMD_DO_SET_MODE, 1, 4),
         command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1),
         command(mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5), wait_record(250)],
        [message_record(mav.MAVLink_set_position_target_global_int_message(
            0, 1, 1, 6, 0, 473977420, 85455940, 10, *(0.0,) * 8))],
        [message_record(mav.MAVLink_param_request_list_message(1, 1)), wait_record(100)],
        [message_record(mav.MAVLink_param_request_read_message(1, 1, b"SYS_AUTOSTART", -1))],
        [message_record(mav.MAVLink_param_set_message(1, 1, b"MC_ROLL_P", 6.5, 9))],
        [message_record(mav.MAVLink_param_set_message(1, 1, b"ATC_RAT_RLL_P", 0.1, 9))],
        [command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 4000),
         command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
         command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE), wait_record(50)],
        [message_record(mav.MAVLink_set_actuator_control_target_message(0, 0, 1, 1, [0.0] * 8))],
        [message_record(mav.MAVLink_timesync_message(0, 99)), message_record(mav.MAVLink_ping_message(1, 2, 0, 0))],
        [message_record(mav.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0))],
        [message_record(mav.MAVLink_rc_channels_override_message(1, 1, *(1500,) * 8))],
        [message_record(mav.MAVLink_command_int_message(1, 1, 0, 192, 0, 0, 0, 0, 0, 0, 473977420, 85455940, 10.0))],
        [command(mav.MAV_CMD_NAV_LAND),
         command(mav.MAV_CMD_NAV_RETURN_TO_LAUNCH),
         command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196), wait_record(250)],
        [message_record(mav.MAVLink_mission_request_list_message(1, 1)), message_record(mav.MAVLink_odometry_message(
            1, 1, 12, 0, 0, 0, level, 0, 0, 0, 0, 0, 0, [0.0] * 21, [0.0] * 21))],
    ]  # fmt: skip
    return [bytes((stream,)) + b"".join(talk) for talk in talks for stream in (0, 1)]


# Poses from outside -----------------------------------------------------------------------------------------


def poses() -> Callable[[bytes], None]:
    """Datagrams of poses: parsed, timed, checked, made ODOMETRY. The input is split at `|||`."""
    from companion.mavlink.outside_poses import OutsidePoses

    now = [0]
    for_px4, for_ardupilot = (OutsidePoses(("127.0.0.1", 0), now_ns=lambda: now[0]) for _ in range(2))
    for_ardupilot.local_ned = False

    def take(data: bytes) -> None:
        for part in data.split(b"|||"):
            now[0] += 20_000_000
            for message in filter(None, (for_px4.take(part), for_ardupilot.take(part))):
                place = (message.x, message.y, message.z, *message.q)
                speed = (message.vx, message.vy, message.vz)  # all NaN where it is not known
                assert all(math.isfinite(value) for value in place), f"sent {message}"
                assert all(abs(v) < 1e4 for v in speed) or all(map(math.isnan, speed)), f"sent {message}"
                message.pack(mav.MAVLink(None))

    return take


def pose_seeds() -> list[bytes]:
    """Both forms, with and without what is optional, several in a row."""
    from companion.mavlink.pose_datagram import OutsidePose, pack_pose

    seeds = []
    for time_s in (0.0, 1e9):
        row = [
            OutsidePose(
                time_s + 0.02 * k,
                np.array([0.01 * k, 0.0, 1.0]),
                np.array([1.0, 0.0, 0.0, 0.0]),
                np.full(21, 1e-4) if k % 2 else None,
                k,
                np.zeros(3) if k % 3 else None,
            )
            for k in range(6)
        ]
        for binary in (True, False):
            packed = [pack_pose(pose, binary) for pose in row]
            seeds += [b"|||".join(packed), *packed]
    return seeds
