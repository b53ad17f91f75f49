"""Signing, with pymavlink's own signing as the other side."""

import hashlib
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config.errors import UserError
from companion.mavlink import signing
from companion.mavlink.signing import FORGED, REPLAYED, UNSIGNED, Signer, open_to_others, read_key, stamp_of

KEY = bytes(range(32))
OTHER_KEY = bytes(range(1, 33))


def peer(key: bytes | None = KEY, stamp: int | None = None, link_id: int = 3) -> mavlink.MAVLink:
    """An autopilot that signs with pymavlink; `stamp` in units of 10 µs since 2015, by default now."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    if key is not None:
        codec.signing.secret_key = key
        codec.signing.sign_outgoing = True
        codec.signing.link_id = link_id
        codec.signing.timestamp = stamp_of(time.time()) if stamp is None else stamp
    return codec


def heartbeat(codec: mavlink.MAVLink) -> bytearray:
    codec.seq = (codec.seq + 1) % 256
    return bytearray(mavlink.MAVLink_heartbeat_message(2, 12, 81, 0x60000, 4, 3).pack(codec))


def ours(signer: Signer) -> bytearray:
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    signer.prepare(codec)
    return bytearray(mavlink.MAVLink_timesync_message(0, 7).pack(codec))


def test_pymavlink_believes_our_frames_and_their_time_is_now() -> None:
    signer, receiver = Signer(KEY), peer()
    receiver.signing.timestamp = stamp_of(time.time())
    for _ in range(3):
        frame = ours(signer)
        assert receiver.decode(frame).get_type() == "TIMESYNC"
        seconds = int.from_bytes(frame[-12:-6], "little") * 1e-5
        assert abs(seconds - (time.time() - 1420070400)) < 1.0  # 2015-01-01T00:00:00Z
    assert receiver.signing.badsig_count == 0


def test_another_key_is_refused_by_both_sides() -> None:
    with pytest.raises(mavlink.MAVError):
        peer(OTHER_KEY).decode(ours(Signer(KEY)))
    assert Signer(KEY).judge(heartbeat(peer(OTHER_KEY))) == FORGED


def test_unsigned_and_mavlink_1_are_refused() -> None:
    assert Signer(KEY).judge(heartbeat(peer(None))) == UNSIGNED
    version_1 = mavlink.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(peer(None), force_mavlink1=True)
    assert Signer(KEY).judge(version_1) == UNSIGNED


def test_a_frame_counts_once_and_never_after_a_later_one() -> None:
    signer, sender = Signer(KEY), peer()
    first, second = heartbeat(sender), heartbeat(sender)
    assert signer.judge(first) is None
    assert signer.judge(first) == REPLAYED
    assert signer.judge(second) is None
    assert signer.judge(first) == REPLAYED


def test_streams_have_their_own_time() -> None:
    signer, now = Signer(KEY), stamp_of(time.time())
    assert signer.judge(heartbeat(peer(stamp=now, link_id=1))) is None
    assert signer.judge(heartbeat(peer(stamp=now - 100, link_id=2))) is None


@pytest.mark.parametrize(("behind_s", "verdict"), [(50.0, None), (70.0, REPLAYED)])
def test_a_new_stream_may_be_a_minute_behind(behind_s: float, verdict: str | None) -> None:
    stamp = stamp_of(time.time()) - round(behind_s * 1e5)
    assert Signer(KEY).judge(heartbeat(peer(stamp=stamp))) == verdict


def test_a_peer_that_is_ahead_pulls_our_time_along_but_not_for_ever() -> None:
    signer, now = Signer(KEY), stamp_of(time.time())
    assert signer.judge(heartbeat(peer(stamp=now + 3600 * 100_000))) is None
    assert int.from_bytes(ours(signer)[-12:-6], "little") > now + 3600 * 100_000
    assert signer.judge(heartbeat(peer(stamp=2**48 - 2, link_id=9))) is None
    assert int.from_bytes(ours(signer)[-12:-6], "little") < now + 3700 * 100_000


@given(st.integers(0, 300), st.integers(1, 255))
def test_no_changed_byte_is_believed(where: int, change: int) -> None:
    frame = heartbeat(peer())
    where %= len(frame)
    frame[where] ^= change
    signer = Signer(KEY)
    before = signer.stamp
    assert signer.judge(frame) in (FORGED, UNSIGNED)
    assert signer.stamp == before


def test_no_stamp_is_used_twice_even_when_the_clock_starts_in_the_past(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "state" / "signing"
    signer = Signer(KEY, remembered=kept)
    last = int.from_bytes(ours(signer)[-12:-6], "little")
    monkeypatch.setattr(time, "time", lambda: 1420070400.0 + 5.0)  # a board without a clock: 2015
    after_crash = int.from_bytes(ours(Signer(KEY, remembered=kept))[-12:-6], "little")
    assert last < after_crash <= last + 31 * 100_000
    proper = Signer(KEY, remembered=kept)
    last = int.from_bytes(ours(proper)[-12:-6], "little")
    proper.close()
    assert int.from_bytes(ours(Signer(KEY, remembered=kept))[-12:-6], "little") == last + 2


def test_a_disk_that_cannot_be_written_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    signer = Signer(KEY, remembered=tmp_path / "file" / "below" / "it")
    assert peer().decode(ours(signer)).get_type() == "TIMESYNC"


@pytest.mark.parametrize(
    "content",
    [
        KEY,
        KEY.hex().encode(),
        KEY.hex().upper().encode() + b"\n",
        b" ".join(KEY[i : i + 4].hex().encode() for i in range(0, 32, 4)) + b"\r\n",
    ],
)
def test_key_files(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(content)
    assert read_key(path) == KEY


def test_a_passphrase_is_hashed_as_others_do(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_bytes(b"passphrase: correct horse battery\n")
    # `printf 'correct horse battery' | sha256sum`
    assert read_key(path).hex() == hashlib.new("sha256", b"correct horse battery").hexdigest()


@pytest.mark.parametrize(
    "content", [b"", b"short", KEY + b"x", KEY.hex()[:-1].encode(), b"z" * 64, b"passphrase:  "]
)
def test_wrong_keys_say_what_is_wrong(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "my.key"
    path.write_bytes(content)
    with pytest.raises(UserError, match=rf"my\.key: {len(content)} bytes; it must hold 32 raw bytes"):
        read_key(path)


def test_a_missing_key_tells_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="No such file or directory; make one with `head -c 32"):
        read_key(tmp_path / "absent")


def test_a_key_that_others_can_read_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_bytes(KEY)
    path.chmod(0o644)
    assert open_to_others(path)
    path.chmod(0o600)
    assert not open_to_others(path)


def test_the_state_file_tells_nothing_of_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/somewhere")
    name = signing.state_path(KEY)
    assert name.parent == Path("/somewhere/dtlannc-companion")
    assert KEY.hex()[:8] not in name.name and hashlib.sha256(KEY).hexdigest()[:8] not in name.name
