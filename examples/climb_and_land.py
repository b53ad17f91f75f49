"""Climb, look at the height, land: a script as one finds it, for PX4 and ArduPilot, written without the stub in mind."""

import math
import sys

from pymavlink import mavutil

mavlink = mavutil.mavlink


def ask(link, command, *params):
    """Send a command; raise RuntimeError when the autopilot refuses it."""
    link.mav.command_long_send(1, 1, command, 0, *params, *[0] * (7 - len(params)))
    ack = link.recv_match(
        type="COMMAND_ACK", condition=f"COMMAND_ACK.command=={command}", blocking=True, timeout=5
    )
    if ack is None or ack.result != mavlink.MAV_RESULT_ACCEPTED:
        raise RuntimeError(
            f"command {command}: {'no answer' if ack is None else f'refused with {ack.result}'}"
        )


def climb_and_land(endpoint, height_m):
    """Return the greatest height that was seen, in metres above the start."""
    link = mavutil.mavlink_connection(endpoint)
    px4 = link.wait_heartbeat().autopilot == mavlink.MAV_AUTOPILOT_PX4
    link.mav.request_data_stream_send(1, 1, mavlink.MAV_DATA_STREAM_ALL, 10, 1)
    start = link.recv_match(type="GLOBAL_POSITION_INT", blocking=True, timeout=60)
    ready = f"SYS_STATUS.onboard_control_sensors_health & {mavlink.MAV_SYS_STATUS_PREARM_CHECK}"
    if link.recv_match(type="SYS_STATUS", condition=ready, blocking=True, timeout=60) is None:
        raise RuntimeError("not ready to arm within a minute")
    if not px4:
        link.set_mode("GUIDED")
    ask(link, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    here = [math.nan] * 3 if px4 else [0] * 3  # yaw, latitude and longitude as they are
    ask(link, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, *here, height_m + (start.alt / 1000 if px4 else 0))
    highest = 0.0
    while highest < 0.95 * height_m:
        highest = max(highest, link.recv_match(type="GLOBAL_POSITION_INT", blocking=True).relative_alt / 1000)
    ask(link, mavlink.MAV_CMD_NAV_LAND)
    link.motors_disarmed_wait()
    return highest


if __name__ == "__main__":
    print(f"{climb_and_land(sys.argv[1], float(sys.argv[2])):.1f} m")
