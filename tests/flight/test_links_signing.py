"""Flights over a signed link, and refusals where the keys do not match. The other side signs with pymavlink."""

import os
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from link_flights import companion, free_port, stub_behind
from wire_relay import Relay, SigningPeer, UdpWire

from companion.config.errors import UserError
from companion.mavlink.signing import FORGED, REPLAYED, UNSIGNED, stamp_of

pytestmark = pytest.mark.flight
KEY = bytes(range(32))


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    yield


def key_file(folder: Path, key: bytes = KEY) -> Path:
    path = folder / "key"
    path.write_bytes(key)
    path.chmod(0o600)
    return path


def test_a_signed_flight_with_forgers_on_the_wire(tmp_path: Path) -> None:
    peer = SigningPeer(KEY, stamp_of(time.time()))
    disturbances: list[Callable[[], bytes]] = [
        lambda: peer.latest,  # recorded and played again
        lambda: peer.latest[:-1] + bytes([peer.latest[-1] ^ 1]),  # forged
        lambda: SigningPeer(os.urandom(32), stamp_of(time.time())).down(plain[0])[0],  # another key
        lambda: plain[0],  # not signed
    ]
    plain: list[bytes] = []
    sent = 0

    def down(datagram: bytes) -> list[bytes]:
        nonlocal sent
        pieces = peer.down(datagram)
        if not pieces:  # a message newer than pymavlink's dialect: it cannot sign that
            return []
        plain[:] = [datagram]
        sent += 1
        return [*pieces, disturbances[sent // 50 % 4]()] if sent % 50 == 0 else pieces

    port = free_port()
    with stub_behind() as stub_port, Relay(stub_port, UdpWire(port), down, peer.up):
        flown = companion(f"udpin:127.0.0.1:{port}", tmp_path, signing_key=key_file(tmp_path))
    assert flown.outcome == "completed"
    assert peer.believed > 1000 and peer.refused == 0
    assert all(flown.counters[reason] > 10 for reason in (UNSIGNED, FORGED, REPLAYED))
    assert (
        sum(flown.counters[r] for r in (UNSIGNED, FORGED, REPLAYED)) >= sent // 50 - 10
    )  # those after the end
    assert [f.found.split(",")[0] for f in flown.findings if f.subject == "signing"] == ["on"]


def refusal(folder: Path, peer: SigningPeer | None, key: bytes | None) -> str:
    """Why a flight did not begin, in the words the pilot gets."""
    port = free_port()
    down, up = (peer.down, peer.up) if peer else (lambda d: [d], lambda d: [d])
    with stub_behind(lockstep=False) as stub_port, Relay(stub_port, UdpWire(port), down, up):
        try:
            flown = companion(
                f"udpin:127.0.0.1:{port}",
                folder,
                signing_key=None if key is None else key_file(folder, key),
                settings={"procedure.connect_timeout_s": 6.0},
            )
        except UserError as error:
            return str(error)
    assert flown.outcome == "refused"
    return flown.text


def test_a_wrong_key_is_named_before_anything_else_happens(tmp_path: Path) -> None:
    text = refusal(tmp_path, SigningPeer(KEY, stamp_of(time.time())), bytes(32))
    assert "frames refused: not signed with this key" in text and "with a wrong one" in text


def test_an_autopilot_that_does_not_sign_is_refused(tmp_path: Path) -> None:
    text = refusal(tmp_path, None, KEY)
    assert "frames refused: not signed with this key" in text and "without a signature" in text


def test_an_autopilot_that_signs_is_not_flown_without_a_key(tmp_path: Path) -> None:
    text = refusal(tmp_path, SigningPeer(KEY, stamp_of(time.time())), None)
    assert "give --signing-key FILE" in text


def test_an_autopilot_whose_clock_is_years_behind_takes_ours(tmp_path: Path) -> None:
    peer = SigningPeer(KEY, stamp_of(1577836800.0))  # 2020: never had a GPS fix
    port = free_port()
    with stub_behind() as stub_port, Relay(stub_port, UdpWire(port), peer.down, peer.up):
        flown = companion(f"udpin:127.0.0.1:{port}", tmp_path, signing_key=key_file(tmp_path))
    assert flown.outcome == "completed"


def test_the_port_is_free_again_after_a_refusal(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="key"):
        companion(f"udpin:127.0.0.1:{free_port()}", tmp_path, signing_key=tmp_path / "absent")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", free_port()))
