"""Mutated and forged MAVLink frames against the stub's firmwares and the companion's link, with a fixed seed.

    python scripts/hostile_frames.py --target px4 --frames 1000000
    python scripts/hostile_frames.py --target link --frames 20000 --json
    python scripts/hostile_frames.py --target ardupilot --over tcp --frames 50000      a process, over loopback

Half of the frames are real ones that were damaged (bits, bytes, lengths, cuts, splices). Whatever a target takes for a
message among them must have a checksum that pymavlink finds right, too, and while it takes none, mode and arming may not
change. The other half are forged: any message, any content (NaN, infinities, extremes, every command), right checksum.
Those may do what MAVLink lets anybody do; the target has to live, to answer, and to keep its state finite. Every
ROUND frames the vehicle is a fresh one, flying. Exit code 1: something of this did not hold; the frame is printed.
"""

from __future__ import annotations

import argparse
import functools
import gzip
import json
import math
import random
import socket
import struct
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from fastcrc.crc16 import mcrf4xx
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink

from companion.mavlink.link import Link
from sitl_stub import Stub
from sitl_stub.firmware.ardupilot.build import build_ardupilot
from sitl_stub.firmware.common.autopilot import Autopilot
from sitl_stub.firmware.px4.build import build_px4
from sitl_stub.mavlink.links import MemoryLink

CAPTURES = {"px4": "px4_sih_qball2.tlog.gz", "ardupilot": "arducopter_sitl.tlog.gz"}
ROUND = 25_000
FRAMES_A_CHECK = 1000
FRAMES_AN_INSTANT = 100
"""How many come between one instant of the autopilot's and the next (2 to 10 ms)."""
TAKE_OFF, ARM, SET_MODE, SET_INTERVAL = 22, 400, 176, 511
EVERY_MESSAGE = tuple(mavlink.mavlink_map)
NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1.0, 3.4e38, -3.4e38, 1e-45)


class Broken(Exception):
    """The target did what it must not do."""


class Target(Protocol):
    """What is attacked."""

    sender: tuple[int, int]
    """Whom forged frames pretend to be from."""

    def feed(self, data: bytes) -> None:
        """Hand over one datagram, or a piece of a stream."""

    def taken(self) -> int:
        """How many messages it has taken from anybody so far."""

    def state(self) -> tuple[Any, ...]:
        """Mode and arming."""

    def check(self) -> None:
        """Ask something; raises Broken without the answer."""

    def close(self) -> None:
        """End it."""


# Frames ---------------------------------------------------------------------------------------------------------


def real_frames(firmware: str, captures: Path) -> list[bytes]:
    """Both directions of the capture where it is on this machine; else one frame of every message."""
    path = captures / CAPTURES[firmware]
    if path.exists():
        return list(dict.fromkeys(frames_of_tlog(gzip.decompress(path.read_bytes()))))[:40_000]
    made = random.Random(0)
    return [forged_frame(made, cls.id) for cls in mavlink.mavlink_map.values()]


def frames_of_tlog(data: bytes) -> list[bytes]:
    """Frames of a telemetry log: 8 bytes of time before each."""
    frames, at = [], 8
    while at + 10 < len(data):
        length = data[at + 1] + (8 if data[at] == 0xFE else 25 if data[at + 2] & 1 else 12)
        frames.append(data[at : at + length])
        at += length + 8
    return frames


def damaged(draw: random.Random, frames: Sequence[bytes]) -> bytes:
    """A real frame with one to three things wrong, its checksum as it was."""
    data = bytearray(draw.choice(frames))
    for _ in range(draw.randint(1, 3)):
        at = draw.randrange(len(data)) if data else 0
        match draw.randrange(9) if data else 8:
            case 0:
                data[at] ^= 1 << draw.randrange(8)
            case 1:
                data[at] = draw.randrange(256)
            case 2:
                data[1 % len(data)] = draw.choice((0, 1, 254, 255, draw.randrange(256)))
            case 3:
                del data[at:]
            case 4:
                data[at:at] = draw.randbytes(draw.randint(1, 40))
            case 5:
                del data[at : at + draw.randint(1, 8)]
            case 6:
                other = draw.choice(frames)
                data[at:] = other[draw.randrange(len(other)) :]
            case 7:
                for header in range(2, min(10, len(data))):
                    data[header] = draw.randrange(256)
            case 8:
                data += draw.randbytes(draw.randint(1, 300))
    return bytes(data)


def forged_frame(
    draw: random.Random,
    message_id: int,
    fields: dict[str, Any] | None = None,
    sender: tuple[int, int] = (255, 190),
) -> bytes:
    """A frame of any content with a right checksum, MAVLink 1 or 2, short or long; `sender`: system, component."""
    cls = mavlink.mavlink_map[message_id]
    payload = bytearray(draw.randbytes(cls.unpacker.size))
    offset = 0
    for name, wire in zip(cls.ordered_fieldnames, wire_types(cls), strict=True):
        size = struct.calcsize("<" + wire)
        if fields and name in fields:
            struct.pack_into("<" + wire, payload, offset, fields[name])
        elif (name == "target_system" and draw.random() < 0.9) or (
            name == "target_component" and draw.random() < 0.9
        ):
            payload[offset] = draw.choice((0, 1))
        elif wire.endswith("f") and draw.random() < 0.7:
            for at in range(offset, offset + size, 4):
                value = draw.choice(NUMBERS) if draw.random() < 0.5 else draw.uniform(-10.0, 10.0)
                struct.pack_into("<f", payload, at, struct.unpack("<f", struct.pack("<f", value))[0])
        offset += size
    if message_id < 256 and draw.random() < 0.2:
        header = bytes((len(payload), draw.randrange(256), *sender, message_id))
        start = b"\xfe"
    else:
        if draw.random() < 0.2:
            payload = payload[: draw.randint(1, len(payload))]
        elif draw.random() < 0.1:
            payload += draw.randbytes(draw.randint(0, 255 - len(payload)))
        header = bytes((len(payload), 0, draw.randrange(256), draw.randrange(256), *sender))
        header += message_id.to_bytes(3, "little")
        start = b"\xfd"
    crc = mcrf4xx(header + bytes(payload) + bytes((cls.crc_extra,)))
    return start + header + bytes(payload) + struct.pack("<H", crc)


@functools.cache
def wire_types(cls: Any) -> list[str]:
    """struct formats of a message's fields, in wire order."""
    parts, text = [], cls.unpacker.format.lstrip("<")
    count = ""
    for letter in text:
        if letter.isdigit():
            count += letter
        else:
            parts += [count + letter] if letter == "s" or not count else [letter] * int(count)
            count = ""
    types, at = [], 0
    for name, length in zip(cls.ordered_fieldnames, cls.array_lengths, strict=True):
        kind = cls.fieldtypes[cls.fieldnames.index(name)]
        if length and kind != "char":
            types.append(f"{length}{parts[at]}")
            at += length
        else:
            types.append(parts[at])
            at += 1
    return types


def has_right_checksum(data: bytes) -> bool:
    """Whether pymavlink finds a message anywhere in `data`."""
    for at in range(len(data)):
        if data[at] in (0xFE, 0xFD):
            header = 8 if data[at] == 0xFE else 12
            for extra in (0, 13):
                length = (data[at + 1] if at + 1 < len(data) else 256) + header + extra
                try:
                    mavlink.MAVLink(None).decode(bytearray(data[at : at + length]))
                    return True
                except (mavlink.MAVError, IndexError, struct.error):
                    continue
    return False


# Targets --------------------------------------------------------------------------------------------------------


def flying(firmware: str) -> tuple[Autopilot, MemoryLink]:
    """An autopilot in the air on a link of its own: hovering by its own take-off, so that no setpoint is missed."""
    if firmware == "ardupilot":
        autopilot: Autopilot = build_ardupilot(estimator="perfect", ready_after_s=1.0)
    else:
        autopilot = build_px4(firmware)
    link = MemoryLink(role="onboard")
    autopilot.attach(link)
    packer = mavlink.MAVLink(None, 255, 190)

    def command(number: int, *params: float) -> None:
        message = mavlink.MAVLink_command_long_message(1, 1, number, 0, *params, *[0.0] * (7 - len(params)))
        for received in link.reader.read_datagram(bytes(message.pack(packer))):
            autopilot.handle(link, received)

    autopilot.advance_to(2_500_000)
    if firmware == "ardupilot":
        command(SET_MODE, 1, 4)
        command(ARM, 1)
        command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 5)
    else:
        command(ARM, 1)
        command(TAKE_OFF, 0, 0, 0, math.nan, math.nan, math.nan, math.nan)
    autopilot.advance_to(14_000_000)
    link.take()
    if not autopilot.armed:
        raise Broken(f"{firmware}: the vehicle did not take off")
    return autopilot, link


class Firmware:
    """Codec and handlers of one firmware, inside this process; a second link sees what a client would see."""

    def __init__(self, firmware: str) -> None:
        self.sender = (255, 190)
        self.autopilot, self.link = flying(firmware)
        self.witness = MemoryLink("witness")
        self.autopilot.attach(self.witness)
        self.packer = mavlink.MAVLink(None, 42, 190)
        self.asked = self.fed = 0
        self.messages = [name_to_id(name) for name in self.autopilot.messages]
        self.commands = list(self.autopilot.command_protocol.handlers)

    def feed(self, data: bytes) -> None:
        for message in self.link.reader.read_datagram(data):
            self.autopilot.handle(self.link, message)
        self.fed += 1
        if self.fed % FRAMES_AN_INSTANT == 0:
            self.autopilot.step()
            self.link.frames.clear()
            self.witness.frames.clear()

    def taken(self) -> int:
        return self.link.counters.received

    def state(self) -> tuple[Any, ...]:
        mode = getattr(self.autopilot, "mode", None) or self.autopilot.state.mode  # type: ignore[attr-defined]
        return mode, self.autopilot.armed

    def check(self) -> None:
        self.asked += 1
        self.witness.frames.clear()
        question = mavlink.MAVLink_timesync_message(0, self.asked)
        for message in self.witness.reader.read_datagram(bytes(question.pack(self.packer))):
            self.autopilot.handle(self.witness, message)
        answers = [m for m in self.witness.take() if m.name == "TIMESYNC" and m.tc1 != 0]
        if [m.ts1 for m in answers] != [self.asked]:
            raise Broken("TIMESYNC is not answered any more")
        core = self.autopilot.core
        if not np.all(np.isfinite(core.state)):
            raise Broken(f"the vehicle's state is no longer finite: {core.state}")

    def close(self) -> None:
        pass


def name_to_id(name: str) -> int:
    """Number of a message."""
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))


class Process:
    """A stub of its own over loopback, UDP or TCP; a pymavlink client on the same port asks whether it lives."""

    def __init__(self, firmware: str, transport: str) -> None:
        self.stub = Stub(
            firmware, transport="tcp" if transport == "tcp" else "udp-server", speed=10.0, ready_after_s=1.0
        )
        self.stub.start()
        self.sender = (255, 190)
        self.witness = mavutil.mavlink_connection(self.stub.endpoint, source_system=42)
        _, host, port = self.stub.endpoint.split(":")
        self.stream = transport == "tcp"
        kind = socket.SOCK_STREAM if self.stream else socket.SOCK_DGRAM
        self.attacker = socket.socket(socket.AF_INET, kind)
        self.attacker.connect((host, int(port)))
        self.attacker.setblocking(False)
        self.asked = self.fed = 0
        self.messages = [cls.id for cls in mavlink.mavlink_map.values()]
        self.commands = [TAKE_OFF, ARM, SET_MODE, SET_INTERVAL, 20, 21, 246, 512, 520]
        self.check(60.0)

    def feed(self, data: bytes) -> None:
        try:
            self.attacker.send(data)
            if self.fed % 10 == 0:
                self.attacker.recv(1 << 16)
        except (BlockingIOError, ConnectionRefusedError):
            pass
        self.fed += 1
        if self.fed % 200 == 0:
            self.check()

    def taken(self) -> int:
        return -1  # known when it ends

    def state(self) -> tuple[Any, ...]:
        return ()

    def check(self, timeout_s: float = 10.0) -> None:
        self.asked += 1
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            self.witness.mav.timesync_send(0, self.asked)
            answer = self.witness.recv_match(type="TIMESYNC", blocking=True, timeout=0.5)
            if answer is not None and answer.ts1 == self.asked:
                return
            if not self.stub.running:
                self.stub.stop()
                raise Broken(f"the stub has died: {self.stub.errors}")
        raise Broken("TIMESYNC is not answered any more")

    def close(self) -> None:
        self.attacker.close()
        self.witness.close()
        self.stub.stop()


class Wire:
    """A transport in memory for the companion's link."""

    datagrams = True

    def __init__(self, datagrams: bool) -> None:
        self.datagrams = datagrams
        self.waiting: deque[bytes] = deque()
        self.sent: list[bytes] = []
        self.notices: deque[str] = deque(maxlen=32)
        self.sender: object = None
        self.strangers: deque[bytes] = deque()

    def wait(self, timeout_s: float) -> bool:
        return bool(self.waiting)

    def receive(self) -> list[bytes]:
        chunks = list(self.waiting)
        self.waiting.clear()
        return chunks

    def send(self, data: bytes) -> bool:
        self.sent.append(bytes(data))
        return True

    def believe_sender(self) -> None:
        pass

    def greet_sender(self) -> None:
        pass

    def close(self) -> None:
        pass


class CompanionLink:
    """`Link` with everything that takes its messages; a stream and datagrams in turn."""

    def __init__(self, stream: bool) -> None:
        from companion.flight.vehicle import Vehicle

        self.sender = (1, 1)
        self.wire = Wire(not stream)
        self.link = Link(self.wire)  # type: ignore[arg-type]
        self.vehicle = Vehicle(self.link, 5.0)
        self.autopilot = mavlink.MAVLink(None, 1, 1)
        self.count = self.asked = 0
        self.messages = [cls.id for cls in mavlink.mavlink_map.values()]
        self.commands = [0]
        self.check()

    def feed(self, data: bytes) -> None:
        self.wire.waiting.append(data)
        while (message := self.link.receive(0.0)) is not None:
            self.count += 1
            self.vehicle._handle(message)
        self.link.keep_alive()
        self.wire.sent.clear()

    def taken(self) -> int:
        return self.count + self.link.counters["other senders"] + len(self.link.timesync._samples)

    def state(self) -> tuple[Any, ...]:
        heartbeat = self.link.heartbeat
        return self.link.target_system, heartbeat and (heartbeat.custom_mode, heartbeat.base_mode)

    def check(self) -> None:
        """A good question after all that: answered, also when a broken frame is waiting for its end in a stream."""
        self.feed(bytes(300))
        self.feed(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(self.autopilot))
        self.asked += 1
        self.wire.waiting.append(
            bytes(mavlink.MAVLink_timesync_message(0, self.asked).pack(self.autopilot)) + bytes(8)
        )
        self.wire.sent.clear()
        while (message := self.link.receive(0.0)) is not None:
            self.vehicle._handle(message)
        codec = mavlink.MAVLink(None)
        sent = [codec.decode(bytearray(frame)) for frame in self.wire.sent]
        if not any(m.get_type() == "TIMESYNC" and m.ts1 == self.asked and m.tc1 for m in sent):
            raise Broken("TIMESYNC is not answered any more")
        state = self.vehicle.state
        if state is not None and not np.all(np.isfinite([*state.position_enu, *state.quaternion_wxyz])):
            raise Broken(f"a state that cannot be: {state}")

    def close(self) -> None:
        pass


# The run --------------------------------------------------------------------------------------------------------


def attack(target_name: str, over: str, count: int, seed: int, captures: Path) -> dict[str, Any]:
    """Feed `count` frames; returns the figures. Raises Broken."""
    draw = random.Random(seed)
    frames = real_frames("px4" if target_name != "ardupilot" else "ardupilot", captures)
    totals: Counter[str] = Counter()
    started, shown = time.monotonic(), time.monotonic()
    done = 0
    while done < count:
        for forging in (False, True):
            target = make(target_name, over, done // ROUND)
            try:
                for _ in range(min(ROUND // 2, max(1, (count - done) // (1 if forging else 2)))):
                    one_frame(target, draw, frames, forging, totals)
                    done += 1
                    if done % FRAMES_A_CHECK == 0:
                        target.check()
                        if time.monotonic() - shown > 10.0:
                            shown = time.monotonic()
                            print(f"{target_name}: {done} of {count} frames, alive", file=sys.stderr)
                    if done >= count:
                        break
                target.check()
            finally:
                target.close()
    totals["frames"] = done
    return {
        "target": target_name,
        "over": over,
        "seed": seed,
        **totals,
        "wall_s": round(time.monotonic() - started, 1),
    }


def make(name: str, over: str, number: int) -> Target:
    """A fresh target."""
    if name == "link":
        return CompanionLink(stream=number % 2 == 1)
    return Firmware(name) if over == "memory" else Process(name, over)


def one_frame(
    target: Any, draw: random.Random, frames: Sequence[bytes], forging: bool, totals: Counter[str]
) -> None:
    """Feed one frame and look at what it did."""
    if forging:
        number = draw.choice(target.messages) if draw.random() < 0.8 else draw.choice(EVERY_MESSAGE)
        fields = {}
        if number in (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT):
            fields["command"] = draw.choice(target.commands) if draw.random() < 0.9 else draw.randrange(65536)
        data = forged_frame(draw, number, fields, target.sender if draw.random() < 0.9 else (77, 1))
    else:
        data = damaged(draw, frames)
    before, state = target.taken(), target.state()
    try:
        target.feed(data)
    except Broken:
        raise
    except Exception as error:
        steps = traceback.extract_tb(error.__traceback__)[-4:]
        where = ", ".join(f"{Path(step.filename).name}:{step.lineno}" for step in steps)
        raise Broken(f"{type(error).__name__}: {error} ({where}) at frame {data.hex()}") from error
    took, changed = target.taken() - before, target.state() != state
    totals["forged" if forging else "damaged"] += 1
    totals["messages taken of forged" if forging else "messages taken of damaged"] += took
    totals["changes of mode or arming by forged" if forging else "changes of mode or arming by damaged"] += (
        changed
    )
    if not forging and took and target.__class__ is Firmware and not has_right_checksum(data):
        raise Broken(f"a message was taken from a frame with a wrong checksum: {data.hex()}")
    if not forging and changed and not took:
        raise Broken(f"mode or arming changed by a frame with a wrong checksum: {data.hex()}")


def main() -> int:
    """Attack, and print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--target", default="px4", choices=("px4", "px4-1.13", "ardupilot", "link"))
    parser.add_argument(
        "--over", default="memory", choices=("memory", "udp", "tcp"), help="memory: inside this process"
    )
    parser.add_argument("--frames", type=int, default=1_000_000, metavar="N", help="default a million")
    parser.add_argument("--seed", type=int, default=1, help="default 1")
    parser.add_argument(
        "--captures",
        type=Path,
        default=Path(__file__).resolve().parents[2] / "shared" / "captures",
        metavar="FOLDER",
        help="of recorded .tlog.gz; without them frames are made",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    if arguments.frames < 1:
        parser.error("--frames: give 1 or more")
    try:
        figures = attack(
            arguments.target, arguments.over, arguments.frames, arguments.seed, arguments.captures
        )
    except Broken as error:
        print(f"hostile_frames: {arguments.target}: {error}", file=sys.stderr)
        return 1
    if arguments.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:40} {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
