"""Passing MAVLink on between the autopilot and its clients, and setting position setpoints aside for our law.

One process does nothing else: bytes in, the same bytes out, so what the law computes delays nobody. Datagrams are passed
on as they are; streams are cut into frames, by length and checksum. Nothing is encoded anew, so signatures, sequence
numbers and messages that we do not know come through. A client is not heard by the others, as on an autopilot's links.

The law is a process of its own, at two sockets (SOCK_SEQPACKET): one is its wire to the autopilot, over the other it is
told what clients ask for and says when it takes over (`TAKE`, `LET_GO`). When that process is gone, what clients ask
for is passed on.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable

from companion.mavlink.framing import Framer, frame_length, message_id
from companion.mavlink.layouts import mav
from companion.mavlink.link import is_autopilots
from companion.mavlink.received import Received, read
from companion.mavlink.signing import Signer
from companion.mavlink.transport import StreamTransport, UdpTransport
from companion.serve.client_wires import Client, Door
from companion.serve.setpoint_switch import SetpointSwitch

LAW_COMPONENT: int = mav.MAV_COMP_ID_ONBOARD_COMPUTER2
"""Our own component behind `serve`: clients on a companion computer are 191 as a rule, and answers must not be mixed up."""
TAKE = struct.Struct("<cB")  # b"T", the autopilot's system
READY = b"R"
"""From here on the law listens: until then nothing is sent that it could not read in time."""
LET_GO = b"L"
LAPSED = b"L"
"""Told to the law: it had taken over and sent nothing."""
MOST_PER_S = 6000
"""Chunks read from one client; what comes faster waits in its own queue and is lost there."""
BURST = 600
ROUND_S = 0.1
"""Between looks at what no byte announces."""
LONGEST_DATAGRAM = 1400
_CHUNKS_AT_ONCE = 64
_COMMAND_ACK: int = mav.MAVLINK_MSG_ID_COMMAND_ACK
_TIMESYNC: int = mav.MAVLINK_MSG_ID_TIMESYNC
_HEARTBEAT: int = mav.MAVLINK_MSG_ID_HEARTBEAT
_STATUSTEXT: int = mav.MAVLINK_MSG_ID_STATUSTEXT
_COMMANDS = (mav.MAVLINK_MSG_ID_COMMAND_LONG, mav.MAVLINK_MSG_ID_COMMAND_INT)
_STREAM_REQUEST: int = mav.MAVLINK_MSG_ID_REQUEST_DATA_STREAM
_MESSAGE_INTERVAL: int = mav.MAV_CMD_SET_MESSAGE_INTERVAL
_QUESTIONS_REMEMBERED = 32


def whole_frames(chunk: bytes) -> list[bytes] | None:
    """The frames that a datagram is made of, by their lengths; None where something else is in it."""
    frames, start, end = [], 0, len(chunk)
    while start < end:
        length = frame_length(chunk, start)
        if not length or start + length > end:
            return None
        if start == 0 and length == end:
            return [chunk]
        frames.append(chunk[start : start + length])
        start += length
    return frames


class Frames:
    """Cuts what one wire brings into whole frames. A datagram that is made of frames is believed to be."""

    def __init__(self, datagrams: bool) -> None:
        self._datagrams = datagrams
        self._framer = Framer(mav.mavlink_map, stream=not datagrams)

    def of(self, chunk: bytes) -> list[bytes]:
        """The frames that `chunk` ends or holds."""
        if self._datagrams and (frames := whole_frames(chunk)) is not None:
            return frames
        self._framer.feed(chunk)
        found = []
        while (frame := self._framer.next_frame()) is not None:
            if read(frame) is None:
                self._framer.reject()
            else:
                found.append(frame)
        return found


class _Allowance:
    """How much may still be read from a client now: MOST_PER_S, and BURST at once."""

    def __init__(self) -> None:
        self._left, self._at_s = float(BURST), time.monotonic()

    def spend(self, count: int) -> None:
        self._left -= count

    def used_up(self, now_s: float) -> bool:
        self._left = min(float(BURST), self._left + MOST_PER_S * (now_s - self._at_s))
        self._at_s = now_s
        return self._left < 1.0


class Forwarder:
    """See the module. `step` does what there is to do and waits for more; everything in the caller's thread."""

    def __init__(
        self,
        autopilot: UdpTransport | StreamTransport,
        doors: list[Door],
        say: Callable[[str], None],
        system: int | None = None,
        signer: Signer | None = None,
        demand_signing: bool = False,
    ) -> None:
        """Pass on between `autopilot` and who comes through `doors`.

        Args:
            autopilot: its wire.
            doors: where clients come in.
            say: takes what people should know.
            system: the autopilot's, where it is not the first that is heard.
            signer: with the key with which our own frames are signed; setpoints are flown with its signature only.
            demand_signing: whether everything of clients needs it, to be passed on.
        """
        self._autopilot = autopilot
        self._doors = doors
        self._say = say
        self._system = system
        self._signer = signer if demand_signing else None
        self.switch = SetpointSwitch(None if demand_signing else signer)
        self._law: socket.socket | None = None
        self._law_control: socket.socket | None = None
        self._law_listens = False
        self._autopilot_frames = Frames(autopilot.datagrams)
        self._believed: object = None if autopilot.datagrams else autopilot.sender
        self._spoken_by_law: dict[int, None] = {}  # TIMESYNC questions
        self._of_clients: dict[Client, tuple[Frames, _Allowance]] = {}
        self._poll = select.poll()
        self._registered: dict[int, object] = {}
        self._heard_s = 0.0
        self._round_s = 0.0
        self.counters: Counter[str] = Counter()

    def employ(self, law: socket.socket, control: socket.socket) -> None:
        """Let the process at the other end of these sockets fly."""
        self.dismiss()
        law.setblocking(False)
        control.setblocking(False)
        self._law, self._law_control, self._law_listens = law, control, False
        self._spoken_by_law.clear()

    def dismiss(self) -> None:
        """Nobody flies: what clients ask for is passed on."""
        self._let_go()
        for each in (self._law, self._law_control):
            if each is not None:
                each.close()
        self._law = self._law_control = None

    @property
    def has_law(self) -> bool:
        """Whether there is a process that flies."""
        return self._law is not None

    def close(self) -> None:
        """Close all wires."""
        self.dismiss()
        self._autopilot.close()
        for door in self._doors:
            door.close()

    # One step -------------------------------------------------------------------------------------------

    def step(self, timeout_s: float = ROUND_S) -> None:
        """Pass on what has come, or wait for it, at most `timeout_s`."""
        now_s = time.monotonic()
        if now_s - self._round_s >= ROUND_S:
            self._round_s = now_s
            self._look_round(now_s)
        ready = self._wait(timeout_s, now_s)
        self._from_autopilot()
        self._from_law()
        for door in self._doors:
            if door.fileno() in ready:
                for client, chunk in door.open():
                    self._from_client(client, [chunk])
            for client in list(door.clients):
                if client.fileno() in ready:
                    self._from_client(client, client.receive())
                    self._from_autopilot()
                    self._from_law()

    def _wait(self, timeout_s: float, now_s: float) -> set[int]:
        wanted: dict[int, object] = {self._autopilot.fileno(): self._autopilot}
        for each in (self._law, self._law_control):
            if each is not None:
                wanted[each.fileno()] = each
        waiting = False
        for door in self._doors:
            wanted[door.fileno()] = door
            for client in door.clients:
                if client in self._of_clients and self._of_clients[client][1].used_up(now_s):
                    waiting = True
                else:
                    wanted[client.fileno()] = client
        wanted.pop(-1, None)
        for file in self._registered.keys() - wanted.keys():
            self._poll.unregister(file)
        for file, owner in wanted.items():
            if self._registered.get(file) is not owner:
                self._poll.register(file, select.POLLIN)
        self._registered = wanted
        return {file for file, _ in self._poll.poll(1e3 * (min(timeout_s, 0.005) if waiting else timeout_s))}

    def _look_round(self, now_s: float) -> None:
        self._autopilot.wait(
            0.0
        )  # opens a broken connection again, and hears a restarted router at a new port
        while self._autopilot.notices:
            self._say(self._autopilot.notices.popleft())
        for door in self._doors:
            for client in [each for each in door.clients if each.gone]:
                door.clients.remove(client)
                self._of_clients.pop(client, None)
                client.close()
                self.counters["clients gone"] += 1
        for client in self._of_clients.keys() - {each for door in self._doors for each in door.clients}:
            del self._of_clients[client]
        if now_s - self._heard_s < ROUND_S and self.switch.has_lapsed(now_s):
            self._say("our law has sent nothing for a while: setpoints of clients are passed on")
            self._tell_law(LAPSED)
            self._let_go()

    # The autopilot --------------------------------------------------------------------------------------

    def _from_autopilot(self) -> None:
        autopilot = self._autopilot
        for chunk in autopilot.receive():
            if autopilot.datagrams and autopilot.sender != self._believed:
                if not self._is_autopilots(chunk):
                    self.counters["datagrams before a HEARTBEAT of an autopilot"] += 1
                    continue
                autopilot.believe_sender()
                self._believed = autopilot.sender
            self._heard_s = time.monotonic()
            whole = self._autopilot_frames.of(chunk)
            self._to_law(whole, chunk)
            others = [frame for frame in whole if not self._is_laws_own(frame)]
            if len(others) == len(whole) and autopilot.datagrams:
                self._to_clients([chunk])
            else:
                self._to_clients(joined(others))

    def _is_autopilots(self, chunk: bytes) -> bool:
        for frame in whole_frames(chunk) or ():
            message = read(frame)
            if message is not None and not message.unknown and is_autopilots(message):
                return self._system in (None, message.msg_system)
        return False

    def _is_laws_own(self, frame: bytes) -> bool:
        """Whether it answers our law's own questions: clients may be of the same kind, and not look at the addressee."""
        kind = message_id(frame)
        if kind not in (_COMMAND_ACK, _TIMESYNC):
            return False
        message = read(frame)
        if message is None:
            return False
        if kind == _COMMAND_ACK:
            return bool(message.target_component == LAW_COMPONENT)
        return message.tc1 != 0 and message.ts1 in self._spoken_by_law

    def _to_clients(self, chunks: list[bytes]) -> None:
        for chunk in chunks:
            for door in self._doors:
                for client in door.clients:
                    if not client.send(chunk):
                        self.counters["chunks for clients without room"] += 1

    # The law --------------------------------------------------------------------------------------------

    def _to_law(self, frames: list[bytes], chunk: bytes) -> None:
        if self._law is None or not self._law_listens:
            return
        for part in [chunk] if self._autopilot.datagrams else joined(frames):
            try:
                self._law.send(part)
            except BlockingIOError:
                self.counters["chunks for the law without room"] += 1
            except OSError:
                self._lost_law()
                return

    def _from_law(self) -> None:
        if self._law is None or self._law_control is None:
            return
        try:
            while True:
                order = self._law_control.recv(64)
                if not order:
                    self._lost_law()
                    return
                if order == READY:
                    self._law_listens = True
                elif order == LET_GO:
                    self._let_go()
                elif len(order) == TAKE.size:
                    self.switch.take(TAKE.unpack(order)[1], time.monotonic())
        except BlockingIOError:
            pass
        except OSError:
            self._lost_law()
            return
        for _ in range(_CHUNKS_AT_ONCE):
            try:
                frame = self._law.recv(65535)
            except BlockingIOError:
                return
            except OSError:
                frame = b""
            if not frame:
                self._lost_law()
                return
            self._pass_laws(frame)

    def _pass_laws(self, frame: bytes) -> None:
        kind = message_id(frame)
        if kind == _TIMESYNC and (message := read(frame)) is not None and message.tc1 == 0:
            self._spoken_by_law[message.ts1] = None
            while len(self._spoken_by_law) > _QUESTIONS_REMEMBERED:
                del self._spoken_by_law[next(iter(self._spoken_by_law))]
        if kind == _STATUSTEXT:
            self._to_clients([frame])
        if self.switch.from_law(frame, time.monotonic()):
            self._autopilot.send(frame)

    def _lost_law(self) -> None:
        if self.switch.taken:
            self._say("our law is gone: setpoints of clients are passed on")
        self.dismiss()

    def _let_go(self) -> None:
        held_back = self.switch.let_go(time.monotonic())
        if held_back is not None:
            self._autopilot.send(held_back)

    def _tell_law(self, data: bytes) -> None:
        if self._law_control is None or not self._law_listens:
            return
        try:
            self._law_control.send(data)
        except BlockingIOError:
            self.counters["references for the law without room"] += 1
        except OSError:
            self._lost_law()

    # Clients --------------------------------------------------------------------------------------------

    def _from_client(self, client: Client, chunks: list[bytes]) -> None:
        known = self._of_clients.get(client)
        if known is None:
            known = self._of_clients[client] = Frames(client.datagrams), _Allowance()
        frames, allowance = known
        allowance.spend(len(chunks))
        for chunk in chunks:
            passed = []
            for frame in frames.of(chunk):
                if self._signer is not None and (refusal := self._signer.judge(frame)) is not None:
                    self.counters[f"of clients, {refusal}"] += 1
                    continue
                now_s = time.monotonic()
                passes, seen = self.switch.from_client(client, frame, now_s)
                if passes:
                    passed.append(frame)
                if seen or _changes_streams(frame):
                    self._tell_law(frame)
            for part in joined(passed):
                if not self._autopilot.send(part):
                    self.counters["chunks for the autopilot without room"] += 1


def joined(frames: list[bytes]) -> list[bytes]:
    """Frames in order, as many in a datagram as there is room for."""
    if len(frames) < 2:
        return frames
    parts, part = [], b""
    for frame in frames:
        if part and len(part) + len(frame) > LONGEST_DATAGRAM:
            parts.append(part)
            part = b""
        part += frame
    return [*parts, part]


def _changes_streams(frame: bytes) -> bool:
    """Whether a client asks for other rates: those that the law needs have to be asked for anew."""
    kind = message_id(frame)
    if kind not in _COMMANDS:
        return kind == _STREAM_REQUEST
    message: Received | None = read(frame)
    return message is not None and message.command == _MESSAGE_INTERVAL
