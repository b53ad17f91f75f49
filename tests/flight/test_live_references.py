"""Flights whose references another program sends while they are flown, over real sockets, the stub in lockstep."""

from __future__ import annotations

import json
import math
import os
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from engagements import airborne
from link_flights import free_port
from live_client import LEAD_IN_S, Streamer, as_json, as_mavlink, streaming
from stub_flights import Flown, Pilot, fly_short, lockstep_stub

from companion.cli.main import main
from companion.flight.phases import Phase
from companion.flight.stage import FlightResult
from companion.live.trajectory import LiveTrajectory
from companion.mavlink.link import mav

pytestmark = pytest.mark.flight
BUILT_IN_M = 0.015
"""RMS of the built-in lemniscate on this stub (scripts/bench/live_references.py)."""


def flown(
    tmp_path: Path,
    trajectory: str,
    pump: Callable[[float, LiveTrajectory], None],
    duration_s: float = 3.0,
    *settings: str,
    firmware: str = "px4",
    stub: tuple[str, ...] = (),
    at: dict[Phase, Callable[[], object]] | None = None,
    from_air: bool = False,
) -> Flown:
    """One flight with `pump` called before each look for references."""
    wishes = [
        f"flight.duration_s={duration_s}",
        "flight.procedure.hold_s=0.5",
        "flight.control_rate_hz=100",
        *settings,
    ]
    with lockstep_stub(*stub, firmware=firmware) as autopilot, streaming(pump):
        return fly_short(
            autopilot,
            tmp_path,
            at,
            wishes,
            trajectory=trajectory,
            real_time=False,
            fix=not from_air,
            from_air=from_air,
        )


def rms_m(errors_m: np.ndarray) -> float:
    return float(np.sqrt((errors_m**2).mean()))


def no_supervisor_landing(result: FlightResult) -> bool:
    return result.outcome.value == "completed"


def began(flight: Flown, phase: str) -> float:
    """When a phase began, autopilot's time."""
    return next(event.time_s for event in flight.record.events_of("phase") if event.fields["phase"] == phase)


def said(flight: Flown, words: str) -> bool:
    return any(words in line for line in flight.reporter.lines)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """p, v, a at 50 Hz; then positions alone; then again with loss and jitter; silence; not numbers; a jump by 10 m."""
    port = free_port()
    rich, poor = as_json("pvayt"), as_json("pt")
    streamer: Streamer

    def message(t, r):
        return poor(t, r) if 12.0 <= t < 20.0 else rich(t, r)

    def changed(t, data):
        streamer._loss, streamer._jitter_s = (0.05, 0.04) if 20.0 <= t < 28.0 else (0.0, 0.0)
        if 28.0 <= t < 29.5:
            return None
        if 33.0 <= t < 34.5:
            return data.replace(b'"position": [', b'"position": [NaN, ').replace(b'"time"', b'"time"')
        if 38.0 <= t < 39.0:
            fields = json.loads(data)
            fields["position"][0] += 10.0
            return json.dumps(fields).encode()
        return data

    streamer = Streamer(port, message, changed=changed)
    flight = flown(tmp_path_factory.mktemp("whole"), f"live:udp:{port}", streamer.pump, 48.0)
    return flight, streamer


def test_a_stream_is_flown_as_well_as_what_is_built_in(whole) -> None:
    flight, streamer = whole
    assert rms_m(streamer.errors_m(flight.record, LEAD_IN_S, 12.0)) < 1.1 * BUILT_IN_M
    assert rms_m(streamer.errors_m(flight.record, 14.0, 20.0)) < 2.0 * BUILT_IN_M
    assert rms_m(streamer.errors_m(flight.record, 22.0, 28.0)) < BUILT_IN_M + 0.1


def test_silence_noise_and_jumps_leave_no_supervisor_landing(whole) -> None:
    flight, _ = whole
    assert no_supervisor_landing(flight.result), flight.result.text
    assert said(flight, "references: holding") and said(flight, "refused, not a number: NaN")
    reactions = [
        event.fields["reaction"] for event in flight.record.events_of("safety") if event.fields.get("active")
    ]
    assert not set(reactions) & {"hold", "land", "hand_back"}
    counts = flight.record.metadata["wall references"]
    assert (
        int(counts["not a number"]) == 75
        and int(counts["out of order"]) > 20
        and int(counts["smooth stops"]) >= 2
    )
    # while it is silent it stands still
    truth, started_s = flight.record.channels["/truth"], whole[1].started_s
    still = (truth.time_s > started_s + 29.2) & (truth.time_s < started_s + 29.5)
    assert np.linalg.norm(truth["velocity_enu"][still], axis=1).max() < 0.15


def test_what_came_in_is_in_the_log_and_gives_the_same_bits(whole, capsys) -> None:
    flight, streamer = whole
    assert len(flight.record.live) == streamer.sent
    assert main(["replay", "--json", str(flight.log)]) == 0
    references = json.loads(capsys.readouterr().out)["references"]
    assert references["sampled"] == references["identical"] > 8000


def test_position_targets_of_mavlink_are_flown_in_the_autopilots_frame(tmp_path: Path) -> None:
    """On ArduCopter, without time stamps, as MAVSDK and MAVROS send them."""
    port = free_port()
    streamer = Streamer(port, as_mavlink("pvay"))
    flight = flown(tmp_path, f"live:mavlink:{port}", streamer.pump, LEAD_IN_S + 6.0, firmware="ardupilot")
    assert no_supervisor_landing(flight.result), flight.result.text
    assert rms_m(streamer.errors_m(flight.record, LEAD_IN_S)) < 0.05
    assert main(["replay", str(flight.log)]) == 0


class Once:
    """Sends lists of datagrams at given seconds of tracking, each list from a socket of its own name."""

    def __init__(self, port: int, script: list[tuple[float, str, bytes]]) -> None:
        self.script = sorted(script, key=lambda item: item[0])
        self.sockets: dict[str, socket.socket] = {}
        self.port = port
        self.started_s = math.nan

    def pump(self, now_s: float, live: LiveTrajectory) -> None:
        if live._follower is None:
            return
        self.started_s = now_s if math.isnan(self.started_s) else self.started_s
        while self.script and self.script[0][0] <= now_s - self.started_s:
            _, who, data = self.script.pop(0)
            wire = self.sockets.setdefault(who, socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            wire.sendto(data, ("127.0.0.1", self.port))

    def heard(self, who: str) -> list[str]:
        """What was answered."""
        wire, words = self.sockets[who], []
        wire.setblocking(False)
        while True:
            try:
                words.append(json.loads(wire.recv(2048))["refused"])
            except BlockingIOError:
                return words


def place(x: float, y: float, z: float) -> bytes:
    return json.dumps({"position": [x, y, z], "velocity": [0, 0, 0]}).encode()


def test_one_client_at_a_time_and_strangers_are_dropped_unread(tmp_path: Path) -> None:
    """The first who sends a point is followed. A stranger's end is not heard; once the first has let go, another's is."""
    port = free_port()
    script = [(0.1 * k, "first", place(0.2, 0, 1)) for k in range(30)]
    script += [(0.55, "stranger", place(5, 5, 2)), (0.65, "stranger", b'{"end": true}')]
    script += [(3.0, "first", b'{"release": true}')] + [
        (3.1 + 0.1 * k, "stranger", place(-0.2, 0, 1)) for k in range(20)
    ]
    script += [(5.5, "stranger", b'{"end": true}')]
    client = Once(port, script)
    flight = flown(tmp_path, f"live:udp:{port}", client.pump, 30.0)
    assert no_supervisor_landing(flight.result) and said(flight, "the client is let go")
    assert int(flight.record.metadata["wall references"]["dropped unread (strangers, or too many)"]) == 2
    track = flight.record.events_of("tracking")
    assert 5.5 <= track[-1].time_s - track[0].time_s < 6.0
    assert began(flight, "land") - track[-1].time_s < 5.0  # home at once, not when it would have been over
    asked = [json.loads(data) for _, _, data in flight.record.live]
    assert all(fields.get("position", [0])[0] != 5 for fields in asked)


def test_an_end_of_nobody_ends_nothing_and_a_point_outside_the_fence_is_refused_to_its_sender(
    tmp_path: Path,
) -> None:
    port = free_port()
    script = [(0.2, "stranger", b'{"end": true}'), (0.4, "stranger", b'{"release": true}')]
    script += [(0.5 + 0.05 * k, "client", place(0, 0, 1)) for k in range(10)]
    script += [(1.0 + 0.05 * k, "client", place(4, 0, 1)) for k in range(90)]
    client = Once(port, script)
    flight = flown(tmp_path, f"live:udp:{port}", client.pump, 5.5, "flight.safety.fence.radius_m=3")
    assert no_supervisor_landing(flight.result)  # 4.5 s of refusals are no silence: the client is there
    assert client.heard("stranger") == ["of nobody we follow: send a point first"]
    assert client.heard("client")[0] == "outside the fence: by 1.25 m (flight.safety.fence)"
    assert float(np.abs(flight.record.channels["/truth"]["position_enu"][:, :2]).max()) < 0.5


@pytest.mark.parametrize(("lost", "outcome"), [("land", "aborted"), ("hand_back", "handed back")])
def test_a_client_that_stays_silent_is_landed_or_handed_back(tmp_path: Path, lost: str, outcome: str) -> None:
    port = free_port()
    client = Once(port, [(0.05 * k, "client", place(0, 0, 1)) for k in range(20)])
    flight = flown(
        tmp_path, f"live:udp:{port}", client.pump, 20.0, "flight.live.lost_s=1.5", f"flight.live.lost={lost}"
    )
    assert flight.result.outcome.value == outcome
    assert "references: none for 1.5 s (flight.live.lost_s)" in flight.result.text


def commands_that_are_no_references() -> list[bytes]:
    """Arm, disarm for good, another mode, a limit, an attitude, home: none of it is for this port."""
    codec = mav.MAVLink(None, srcSystem=255, srcComponent=190)
    messages = [
        mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 21196, 0, 0, 0, 0, 0),
        mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_COMPONENT_ARM_DISARM, 0, 0, 21196, 0, 0, 0, 0, 0),
        mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_DO_SET_MODE, 0, 1, 4, 6, 0, 0, 0, 0),
        mav.MAVLink_set_mode_message(1, 1, 4 << 16),
        mav.MAVLink_param_set_message(1, 1, b"MPC_XY_VEL_MAX", 99.0, mav.MAV_PARAM_TYPE_REAL32),
        mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1.0, 0, 0, 0], 0, 0, 0, 1.0),
        mav.MAVLink_command_int_message(1, 1, 6, mav.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, 0, 0, 0, 0, 0.0),
        mav.MAVLink_heartbeat_message(mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4, 0, 0, 0, 3),
    ]
    return [bytes(message.pack(codec)) for message in messages]


def test_nothing_that_comes_in_can_arm_or_command_or_raise_a_limit(tmp_path: Path) -> None:
    """What is no reference is passed over, on the ground and in the air; what goes to the autopilot is the same as ever."""
    port = free_port()
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    orders = commands_that_are_no_references()

    def flood(now_s: float, live: LiveTrajectory) -> None:
        for data in orders:
            wire.sendto(data, ("127.0.0.1", port))

    flight = flown(tmp_path, f"live:mavlink:{port}", flood, 2.0)
    assert no_supervisor_landing(flight.result) and flight.armed == [True, False]
    assert flight.modes[1:3] == ["OFFBOARD", "AUTO.LAND"]
    _, sent = flight.record.mavlink["out"]
    kinds = {frame[7] | frame[8] << 8 | frame[9] << 16 for frame in sent}
    assert not kinds & {mav.MAVLINK_MSG_ID_SET_MODE, mav.MAVLINK_MSG_ID_COMMAND_INT}
    assert not any(b"MPC_XY_VEL_MAX" in frame for frame in sent) and not set(sent) & set(orders)


def test_settings_cannot_be_sent_and_impossible_points_are_refused(tmp_path: Path) -> None:
    port = free_port()
    script = [(0.05 * k, "client", place(0, 0, 1)) for k in range(40)]
    script += [
        (1.03, "client", b'{"flight.safety.fence.radius_m": 1000}'),
        (1.13, "client", b'{"position": [0, 0, 1], "velocity": [60, 0, 0]}'),
        (1.23, "client", b'{"position": [0, 0, 1], "acceleration": [30, 0, 0]}'),
        (1.33, "client", b'{"position": [0, 0, 0]}'),
        (1.43, "client", b'{"position": [0, 0, 30]}'),
        (1.53, "client", b'{"position": [0, 0, 1], "velocity": [15, 0, 0]}'),
    ]
    client = Once(port, script)
    flight = flown(tmp_path, f"live:udp:{port}", client.pump, 2.0)
    assert no_supervisor_landing(flight.result)
    words = client.heard("client")
    for word in (
        "unknown key",
        "velocity: 60 m/s is beyond 50",
        "too hard: 30.0 m/s²",
        "too low",
        "above the ceiling",
    ):
        assert any(word in line for line in words), (word, words)
    assert any("too fast to stop in time" in line for line in words)


def test_references_do_not_outlive_the_pilots_switch(tmp_path: Path) -> None:
    """The stream goes on; nothing more is sent to the autopilot once its mode is another."""
    port, pilot = free_port(), Pilot()
    streamer = Streamer(port, as_json("pvay"))
    try:
        flight = flown(
            tmp_path, f"live:udp:{port}", streamer.pump, 30.0, stub=tuple(pilot.options),
            at={Phase.TRACK: lambda: pilot.mode(4, 6)},
        )  # fmt: skip
    finally:
        pilot.close()
    assert flight.result.outcome.value == "pilot took over"
    assert flight.setpoints_after("mode", mode="AUTO.LAND") == 0


def test_standard_input_is_flown_line_by_line_and_its_end_ends_the_flight(
    tmp_path: Path, monkeypatch
) -> None:
    """Pieces of a planner, all at once: they are flown one after the other, then it is over. 65 of them: the pipe waits."""
    out, into = os.pipe()
    first = {
        "duration": 1.0,
        "x": [0, 0, 0, 1, -0.5],
        "y": [0],
        "z": [1],
    }  # x = t³ − t⁴/2: at rest at both ends but for jerk
    rest = {"duration": 0.05, "x": [0.5], "y": [0], "z": [1]}
    os.write(into, "".join(json.dumps(piece) + "\n" for piece in (first, *[rest] * 70)).encode())
    os.close(into)
    monkeypatch.setattr("companion.live.sources.STANDARD_INPUT", out)
    flight = flown(tmp_path, "live:stdin", lambda *_: None, 30.0)
    os.close(out)
    assert no_supervisor_landing(flight.result) and said(flight, "the client says that it is over")
    assert int(flight.record.metadata["wall references"]["followed"]) == 71
    track = flight.record.events_of("tracking")
    assert track[-1].time_s - track[0].time_s == pytest.approx(4.5, abs=0.3)
    truth = flight.record.channels["/truth"]
    at_end = truth["position_enu"][np.searchsorted(truth.time_s, track[-1].time_s)]
    start = flight.record.events_of("layout")[0].fields["origin_enu"]
    assert math.hypot(*(at_end - start)[:2]) == pytest.approx(0.5, abs=0.05)


def test_references_of_a_vehicle_that_hovers_already(tmp_path: Path) -> None:
    """Engaged at 3 m; heights count from the place of take-off, x and y from where it was engaged, along its heading."""
    port = free_port()
    script = [(0.02 * k, "client", place(0.5, 0, 3.5)) for k in range(300)] + [
        (6.1, "client", b'{"end": true}')
    ]
    flight = flown(
        tmp_path,
        f"live:udp:{port}",
        Once(port, script).pump,
        3600.0,
        stub=tuple(airborne("px4")),
        from_air=True,
    )
    assert no_supervisor_landing(flight.result), flight.result.text
    track, truth = flight.record.events_of("tracking"), flight.record.channels["/truth"]
    there = truth["position_enu"][np.searchsorted(truth.time_s, track[0].time_s + 6.0)]
    begun = truth["position_enu"][np.searchsorted(truth.time_s, track[0].time_s)]
    assert there[2] == pytest.approx(3.5, abs=0.15)
    assert math.hypot(*(there - begun)[:2]) == pytest.approx(0.5, abs=0.1)
    assert flight.record.end_time_s - track[-1].time_s < 30.0
