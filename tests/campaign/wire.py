"""What went over the wire, in the order in which it did, taken from a log's bytes without the companion's own code.

MAVLink 2 frames are taken apart by hand (payload layouts of `common.xml`), the MCAP file chunk by chunk.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import zstandard

HEARTBEAT, LOCAL_POSITION_NED, RC_CHANNELS, COMMAND_LONG, SET_ATTITUDE_TARGET = 0, 32, 65, 76, 82
TIMESYNC, SET_ACTUATOR_CONTROL_TARGET, STATUSTEXT, CURRENT_MODE = 111, 139, 253, 436
SETPOINTS = (SET_ATTITUDE_TARGET, SET_ACTUATOR_CONTROL_TARGET)
DO_SET_MODE, ARM_DISARM = 176, 400
ARMED_FLAG = 128
PX4, ARDUPILOT = 12, 3
AUTOPILOT = (1, 1)
"""System and component of the one that is flown; what others send is no evidence."""
_OFFBOARD_MAIN, _GUIDED = 6, 4
_CHANNEL, _MESSAGE, _CHUNK, _FOOTER = 4, 5, 6, 2
_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame as it passed. `time_s` is the autopilot's newest time when it did, as the log has it."""

    outgoing: bool
    time_s: float
    message_id: int
    payload: bytes
    system: int = 1
    component: int = 1

    @property
    def sender(self) -> tuple[int, int]:
        """System and component."""
        return self.system, self.component

    def unpack(self, layout: str) -> tuple[float, ...]:
        """Fields by `struct` layout; zeros that MAVLink 2 cut off at the end are put back."""
        size = struct.calcsize(layout)
        return struct.unpack(layout, self.payload[:size].ljust(size, b"\0"))


@dataclass(frozen=True, slots=True)
class Wire:
    """All frames of a log in order, and whether the file was whole."""

    frames: tuple[Frame, ...]
    whole: bool
    last_time_s: float
    """Newest time of any record, on the autopilot's clock."""


def read_wire(path: Path, utc_offset_ns: int) -> Wire:
    """Frames of a flight log, ours and the autopilot's. What stands behind a cut is not there.

    Raises:
        ValueError: the file does not begin as an MCAP file does.
    """
    data = path.read_bytes()
    if not data.startswith(_MAGIC):
        raise ValueError(f"{path} does not begin as an MCAP file does")
    directions: dict[int, bool] = {}
    frames: list[Frame] = []
    newest_ns = 0
    whole = data.endswith(_MAGIC) and len(data) > 2 * len(_MAGIC)
    unpacker = zstandard.ZstdDecompressor()
    for opcode, body in _records(memoryview(data)[len(_MAGIC) :]):
        if opcode == _CHANNEL:
            _note_channel(body, directions)
        elif opcode == _CHUNK:
            newest_ns = max(newest_ns, struct.unpack_from("<Q", body, 8)[0])
            for inner, record in _records(memoryview(_unpacked(body, unpacker))):
                if inner == _MESSAGE:
                    channel = record[0] | record[1] << 8
                    if channel in directions:
                        frame = _frame(directions[channel], bytes(record[22:]))
                        if frame.outgoing or frame.sender == AUTOPILOT:
                            frames.append(frame)
    return Wire(tuple(frames), whole, (newest_ns - utc_offset_ns) * 1e-9)


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    position = 0
    while position + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, position)
        if opcode == _FOOTER or position + 9 + length > len(data):
            return
        yield opcode, data[position + 9 : position + 9 + length]
        position += 9 + length


def _note_channel(body: memoryview, directions: dict[int, bool]) -> None:
    number, _, length = struct.unpack_from("<HHI", body)
    topic = bytes(body[8 : 8 + length])
    if topic in (b"/mavlink/in", b"/mavlink/out"):
        directions[number] = topic.endswith(b"out")


def _unpacked(body: memoryview, unpacker: zstandard.ZstdDecompressor) -> bytes:
    size, _, length = struct.unpack_from("<QII", body, 16)
    compression = bytes(body[32 : 32 + length])
    content = body[32 + length + 8 :]
    return unpacker.decompress(content, max_output_size=size) if compression == b"zstd" else bytes(content)


def _frame(outgoing: bool, record: bytes) -> Frame:
    time_s, length = struct.unpack_from("<dI", record, 4)
    return frame_of(outgoing, time_s, record[16 : 16 + length])


def frame_of(outgoing: bool, time_s: float, frame: bytes) -> Frame:
    """A frame from its bytes, MAVLink 1 or 2."""
    if frame[:1] == b"\xfe":
        return Frame(outgoing, time_s, frame[5], frame[6 : 6 + frame[1]], frame[3], frame[4])
    number = frame[7] | frame[8] << 8 | frame[9] << 16
    return Frame(outgoing, time_s, number, frame[10 : 10 + frame[1]], frame[5], frame[6])


@dataclass(frozen=True, slots=True)
class Command:
    """A COMMAND_LONG."""

    number: int
    parameters: tuple[float, ...]

    @property
    def arms(self) -> bool:
        """COMPONENT_ARM_DISARM with 1."""
        return self.number == ARM_DISARM and self.parameters[0] == 1.0


def command_of(frame: Frame) -> Command:
    """What a COMMAND_LONG asks for."""
    *parameters, number = frame.unpack("<7fH")
    return Command(int(number), tuple(parameters))


def is_ours(firmware: str, custom_mode: int) -> bool:
    """Whether a custom mode is the one in which setpoints are followed: PX4's OFFBOARD, ArduCopter's GUIDED."""
    return custom_mode >> 16 & 0xFF == _OFFBOARD_MAIN if firmware == "px4" else custom_mode == _GUIDED


def mode_of(frame: Frame) -> int | None:
    """The custom mode that an autopilot's frame tells of; None when it tells of none."""
    if frame.message_id == HEARTBEAT:
        mode, _, autopilot = frame.unpack("<IBB")
        return int(mode) if autopilot in (PX4, ARDUPILOT) else None
    if frame.message_id == CURRENT_MODE:
        return int(frame.unpack("<I")[0])
    return None


def armed_of(frame: Frame) -> bool | None:
    """Whether an autopilot's HEARTBEAT says armed; None for other frames."""
    if frame.message_id != HEARTBEAT:
        return None
    _, _, autopilot, base = frame.unpack("<IBBB")
    return bool(int(base) & ARMED_FLAG) if autopilot in (PX4, ARDUPILOT) else None


def text_of(frame: Frame) -> str:
    """What a STATUSTEXT says; empty for other frames."""
    if frame.message_id != STATUSTEXT:
        return ""
    return frame.payload[1:51].split(b"\0")[0].decode("utf-8", "replace")


def setpoint_numbers(frame: Frame) -> tuple[float, ...]:
    """Every float of a setpoint."""
    if frame.message_id == SET_ATTITUDE_TARGET:
        return frame.unpack("<I8f")[1:]
    return frame.unpack("<Q8f")[1:]
