"""MAVLink 2 signing: our frames carry a signature, and only frames signed with the same key are believed.

A signed frame ends with 13 bytes: link id, time stamp (48 bits, units of 10 µs since 2015-01-01 UTC) and the first
6 bytes of SHA-256(key ‖ frame up to and with the time stamp). The time stamp may never stand or go back on one
stream (link id, system, component): that is what makes a recorded frame worthless. So ours is kept in a file, too:
a companion computer without a battery-backed clock would otherwise start in the past and be refused as a replay.
Source: MAVLink guide, "Message Signing".
"""

from __future__ import annotations

import hashlib
import hmac
import stat
import threading
import time
from pathlib import Path
from typing import Any

from companion.config.errors import UserError
from companion.config.places import state_folder
from companion.mavlink.framing import is_signed

KEY_BYTES = 32
SIGNATURE_BYTES = 13
TICK_S = 1e-5
EPOCH_2015_S = 1420070400  # 2015-01-01T00:00:00Z in Unix time
NEW_STREAM_TOLERANCE = round(60.0 / TICK_S)  # a stream not heard before may be this far behind our clock
FUTURE_TOLERANCE = round(366 * 86400.0 / TICK_S)  # our stamp is not pulled further ahead than this by a peer
RESERVED = round(30.0 / TICK_S)  # written down this far ahead, so that after a crash no stamp is used twice
PASSPHRASE_PREFIX = b"passphrase:"

UNSIGNED = "refused: not signed"
FORGED = "refused: wrong signature"
REPLAYED = "refused: replayed"


def read_key(path: Path) -> bytes:
    """Read a signing key (32 bytes).

    The file holds the 32 bytes themselves, or 64 hexadecimal digits, or a line `passphrase: TEXT`, whose SHA-256 is the
    key, as MAVProxy, Mission Planner and QGroundControl make it.

    Raises:
        UserError: the file is missing, unreadable or of another length.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"signing key {path}: {error.strerror}; make one with "
            f"`head -c 32 /dev/urandom > {path.name} && chmod 600 {path.name}` and give it to the autopilot, too"
        ) from None
    if len(content) == KEY_BYTES:
        return content
    text = content.strip()
    if text.startswith(PASSPHRASE_PREFIX):
        passphrase = text[len(PASSPHRASE_PREFIX) :].strip()
        if passphrase:
            return hashlib.sha256(passphrase).digest()
    digits = text.replace(b" ", b"").replace(b":", b"")
    if len(digits) == 2 * KEY_BYTES:
        try:
            return bytes.fromhex(digits.decode("ascii"))
        except ValueError:
            pass
    raise UserError(
        f"signing key {path}: {len(content)} bytes; it must hold {KEY_BYTES} raw bytes, {2 * KEY_BYTES} hexadecimal "
        "digits, or a line `passphrase: TEXT`"
    )


def open_to_others(path: Path) -> bool:
    """Whether other users of this machine can read the key."""
    return bool(path.stat().st_mode & (stat.S_IRGRP | stat.S_IROTH))


def state_path(key: bytes) -> Path:
    """Where the last time stamp used with `key` is remembered (named by a fingerprint, which tells nothing of it)."""
    fingerprint = hashlib.sha256(b"fingerprint" + key).hexdigest()[:16]
    return state_folder() / f"signing-{fingerprint}"


def stamp_of(unix_time_s: float) -> int:
    """The time stamp of a moment: units of 10 µs since 2015-01-01 UTC."""
    return max(0, round((unix_time_s - EPOCH_2015_S) / TICK_S))


class Signer:
    """Signs what a pymavlink codec packs and judges what arrives. One per link."""

    def __init__(self, key: bytes, link_id: int = 0, remembered: Path | None = None) -> None:
        """Start above every time stamp that was ever used with the key on this machine.

        Args:
            key: (32 bytes).
            link_id: names our stream among several of ours.
            remembered: file with the last time stamp; None forgets it (for tests and other short lives).
        """
        self._key = key
        self._link_id = link_id
        self._file = remembered
        self._writing = threading.Lock()
        self._streams: dict[tuple[int, int, int], int] = {}
        self._stamp = max(stamp_of(time.time()), self._read() + 1)
        self._save(self._stamp + RESERVED)

    @property
    def stamp(self) -> int:
        """The newest time stamp known here: ours, or a peer's that is ahead."""
        return self._stamp

    def prepare(self, codec: Any) -> None:
        """Make `codec` (pymavlink) sign its next frame with a stamp later than all before."""
        self._stamp = max(self._stamp + 1, stamp_of(time.time()))
        codec.signing.secret_key = self._key
        codec.signing.link_id = self._link_id
        codec.signing.sign_outgoing = True
        codec.signing.timestamp = self._stamp
        if self._stamp >= self._reserved - RESERVED // 2:
            # ahead of time and beside the control loop, which waits for no disk
            self._reserved = self._stamp + RESERVED
            threading.Thread(
                target=self._save, args=(self._reserved,), name="signing stamp", daemon=True
            ).start()

    def judge(self, frame: bytes | bytearray) -> str | None:
        """Why a frame must not be believed (one of UNSIGNED, FORGED, REPLAYED), None when it may.

        Only a frame with a right signature changes anything here.
        """
        if not is_signed(frame):
            return UNSIGNED
        expected = hashlib.sha256(self._key + bytes(frame[:-6])).digest()[:6]
        if not hmac.compare_digest(expected, bytes(frame[-6:])):
            return FORGED
        stamp = int.from_bytes(frame[-12:-6], "little")
        stream = (frame[-13], frame[5], frame[6])
        latest = self._streams.get(stream)
        too_old = stamp <= latest if latest is not None else stamp + NEW_STREAM_TOLERANCE < self._stamp
        if too_old:
            return REPLAYED
        self._streams[stream] = stamp
        if self._stamp < stamp < self._stamp + FUTURE_TOLERANCE:
            self._stamp = stamp
        return None

    def close(self) -> None:
        """Write down the last time stamp used."""
        self._save(self._stamp)

    def _read(self) -> int:
        if self._file is None:
            return 0
        try:
            return int(self._file.read_text())
        except (OSError, ValueError):
            return 0

    def _save(self, stamp: int) -> None:
        self._reserved = stamp
        with self._writing:
            if self._file is None:
                return
            try:
                self._file.parent.mkdir(parents=True, exist_ok=True)
                beside = self._file.with_suffix(".new")
                beside.write_text(f"{stamp}\n")
                beside.replace(self._file)  # never half a number, even when the power goes
            except OSError:
                self._file = None  # a read-only disk: the clock alone has to do
