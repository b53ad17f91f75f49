"""`companion check`: verdicts, remedies, JSON, exit codes, --fix; a flight refuses for the same reasons."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from contextlib import contextmanager

import pytest
from link_flights import NoteTaker, companion, free_port, stub_behind
from wire_relay import Relay, UdpWire

from companion.cli.main import main
from companion.config.settings import load_settings
from companion.flight.session import check
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint
from sitl_stub.stub_process import Stub

pytestmark = pytest.mark.flight
PATIENT = ("--set", "flight.procedure.connect_timeout_s=120")
ATTITUDE_QUATERNION, EKF_STATUS_REPORT = 31, 193


@contextmanager
def thinned(message_id: int, keep_every: int):
    """The stub behind a wire that carries one of `keep_every` messages of this number; yields the endpoint."""
    seen = 0

    def thin(datagram: bytes) -> list[bytes]:
        nonlocal seen
        kept, at = [], 0
        while at < len(datagram):  # MAVLink 2 frames, whole in each datagram
            length = datagram[at + 1] + 12
            frame, at = datagram[at : at + length], at + length
            number = int.from_bytes(frame[7:10], "little")
            seen += number == message_id
            if number != message_id or seen % keep_every == 0:
                kept.append(frame)
        return [b"".join(kept)] if kept else []

    port = free_port()
    with stub_behind() as stub_port, Relay(stub_port, UdpWire(port), thin):
        yield f"udpin:127.0.0.1:{port}"


def verdicts(output: str) -> dict[str, tuple[str, str]]:
    return {row["subject"]: (row["verdict"], row["remedy"]) for row in json.loads(output)["findings"]}


def checked(endpoint: str, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    code = main(["check", "--endpoint", endpoint, "--json", *PATIENT, *words])
    return code, capsys.readouterr().out


def test_ardupilot_as_it_comes_is_refused_and_fixed_for_good(capsys) -> None:
    with stub_behind("--firmware", "ardupilot", "--ready-after", "2", "--speed", "10") as port:
        endpoint = f"udpin:127.0.0.1:{port}"
        code, output = checked(endpoint, capsys)
        found = verdicts(output)
        assert code == 2 and json.loads(output)["flyable"] is False
        assert json.loads(output)["changed"] == []
        assert found["GUID_OPTIONS"] == ("refusal", "set GUID_OPTIONS to 8 (it is 0), or fly with --fix")
        assert found["ATC_ANGLE_BOOST"] == ("refusal", "set ATC_ANGLE_BOOST to 0, or fly with --fix")
        assert "tilt limit" not in found  # read off ATC_ANGLE_MAX, where no profile asks for more
        assert {what for what, (verdict, _) in found.items() if verdict == "refusal"} == {
            "GUID_OPTIONS",
            "ATC_ANGLE_BOOST",
        }
        code, output = checked(endpoint, capsys, "--fix")
        assert code == 0
        assert json.loads(output)["changed"] == [
            {"parameter": "GUID_OPTIONS", "before": 0.0, "now": 8.0},
            {"parameter": "ATC_ANGLE_BOOST", "before": 1.0, "now": 0.0},
            {"parameter": "GUID_TIMEOUT", "before": 3.0, "now": 0.5},
        ]


def test_px4_is_flyable_and_actuators_are_not(capsys) -> None:
    with stub_behind("--speed", "10") as port:
        code, output = checked(f"udpin:127.0.0.1:{port}", capsys)
        assert code == 0 and json.loads(output)["flyable"] is True
        assert verdicts(output)["round trip"][0] == "ok"
        words = [
            "check",
            "--endpoint",
            f"udpin:127.0.0.1:{port}",
            "--level",
            "actuator",
            "--profile",
            "qball2",
            *PATIENT,
        ]
        assert main(words) == 2
        table = " ".join(capsys.readouterr().out.split())
    assert "refusal" in table and "what mends it" in table


def refusals(endpoint: str, level: str, overrides: Sequence[str] = ()) -> dict[str, str]:
    settings = load_settings("qball2", {"level": level}, [PATIENT[1], *overrides])
    findings, _, _ = check(settings, Connection(parse_endpoint(endpoint)), NoteTaker())
    return {f.subject: f.found for f in findings if f.verdict.value == "refusal"}


def test_streams_too_slow_for_the_level_are_refused(tmp_path) -> None:
    """10 Hz come of 100 asked for; attitude is flown from 20 Hz on."""
    with thinned(ATTITUDE_QUATERNION, 10) as endpoint:
        slow = refusals(endpoint, "attitude")
        assert list(slow) == ["attitude stream"] and slow["attitude stream"].endswith("Hz of 100")
        flown = companion(endpoint, tmp_path)
    assert flown.outcome == "refused"
    assert "level attitude needs 20 Hz at least" in flown.text and "raise the link's rate" in flown.text


def test_without_an_estimate_nothing_flies(tmp_path) -> None:
    soon = "flight.procedure.ready_timeout_s=3"
    with stub_behind("--ready-after", "900", "--speed", "10") as port:
        assert "readiness" in refusals(f"udpin:127.0.0.1:{port}", "attitude", [soon])
        flown = companion(f"udpin:127.0.0.1:{port}", tmp_path, settings={"procedure.ready_timeout_s": 3.0})
    assert flown.outcome == "refused"
    assert "not ready after 3 s" in flown.text and "estimator has no" in flown.text


def test_the_delay_of_each_stream_is_measured() -> None:
    """40 ms each way, in real time: what `check` says, against what the stub was told.

    A machine that is busy with other things adds to it; then it is looked at again.
    """
    settings = load_settings("qball2", {"level": "attitude"}, [PATIENT[1]])
    with Stub(seed=1) as stub:
        stub.inject("link_delay", delay_s=0.04)
        for _ in range(8):
            findings, _, _ = check(settings, Connection(parse_endpoint(stub.endpoint)), NoteTaker())
            delays = {f.subject.split()[-1]: f.found for f in findings if f.subject.startswith("delay of ")}
            told = {name: re.search(r"age (\S+) ms", found) for name, found in delays.items()}
            ages_ms = {name: float(age.group(1)) if age else math.nan for name, age in told.items()}
            if all(abs(age_ms - 40.0) < 5.0 for age_ms in ages_ms.values()):
                break
    assert {"ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "ODOMETRY"} <= set(delays)
    assert all(abs(age_ms - 40.0) < 5.0 for age_ms in ages_ms.values()), delays
    assert all("95 %" in found and "jitter" in found for found in delays.values())


def test_a_profile_of_another_vehicle_is_doubted(capsys) -> None:
    """The stub flies 1.79 kg and an attitude loop of 0.3 s by its gains: 3 kg and 0.57 s are of another vehicle."""
    with stub_behind("--speed", "10") as port:
        endpoint = f"udpin:127.0.0.1:{port}"
        wrong = ("--set", "profile.mass_kg=3", "--set", "profile.responses.px4.dead_time_s=0.4")
        _, output = checked(endpoint, capsys, "--profile", "qball2", *wrong)
        found = {row["subject"]: row["found"] for row in json.loads(output)["findings"]}
        assert "1.79 kg in the simulator" in found["mass"] and "says 3 kg" in found["mass"]
        assert "s by its parameters" in found["attitude lag"] and "0.57 s" in found["attitude lag"]
        for words in (("--profile", "qball2"), ()):
            _, output = checked(endpoint, capsys, *words)
            assert not {"mass", "attitude lag"} & set(verdicts(output))
