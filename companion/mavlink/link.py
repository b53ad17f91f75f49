"""One conversation with one autopilot: bytes in, believed messages out; messages in, bytes out.

The link locks on to the first autopilot it hears (or the one named) and obeys nobody else: frames of other
systems are counted and dropped, other autopilots remembered by name. It answers the autopilot's TIMESYNC, refuses every
command that is meant for the companion, and nothing more; everything is done in the caller's thread, in the order the
frames arrived.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Container
from typing import Any, Protocol

from companion.mavlink.framing import Framer, is_signed
from companion.mavlink.layouts import mav as mav  # for whoever speaks over the link
from companion.mavlink.packed import packed
from companion.mavlink.received import Received, read
from companion.mavlink.sequence import SequenceCount
from companion.mavlink.signing import FORGED, REPLAYED, UNSIGNED, Signer
from companion.mavlink.stream_timing import STREAMS, StreamTiming
from companion.mavlink.timesync import TimeSync
from companion.mavlink.transport import Transport

Message = Any  # a message that was received, or one of the pymavlink dialect; its fields are MAVLink's

OUR_COMPONENT = mav.MAV_COMP_ID_ONBOARD_COMPUTER  # 191
HEARTBEAT_PERIOD_S = 1.0
AUTOPILOT_COMPONENT = mav.MAV_COMP_ID_AUTOPILOT1
_HEARTBEAT: int = mav.MAVLINK_MSG_ID_HEARTBEAT
_TIMESYNC: int = mav.MAVLINK_MSG_ID_TIMESYNC
_AUTOPILOT_NAMES = {mav.MAV_AUTOPILOT_PX4: "PX4", mav.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot"}
_NOT_VEHICLES = frozenset(
    (
        mav.MAV_TYPE_GCS,
        mav.MAV_TYPE_ONBOARD_CONTROLLER,
        mav.MAV_TYPE_GIMBAL,
        mav.MAV_TYPE_ADSB,
        *range(mav.MAV_TYPE_CAMERA, mav.MAV_TYPE_DECAROTOR),  # camera to Open Drone ID
        *range(mav.MAV_TYPE_BATTERY, mav.MAV_TYPE_GENERIC_MULTIROTOR),  # battery to winch
        mav.MAV_TYPE_ILLUMINATOR,
        mav.MAV_TYPE_GRIPPER,
    )
)
REFUSAL_PERIOD_S = (
    0.1  # between answers to commands for us, so that who floods us with them cannot fill the wire
)
QUESTIONS_REMEMBERED = 32  # of TIMESYNC; at 10 Hz an answer may take 3 s
_COMMANDS = (mav.MAVLINK_MSG_ID_COMMAND_LONG, mav.MAVLINK_MSG_ID_COMMAND_INT)
_STAMPED_WITH_A_SETPOINT = (
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET,
    mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED,
    mav.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT,
)
"""Their time is that of the last setpoint of their kind: PX4 flown at body rates repeats the last attitude's."""


class FrameTap(Protocol):
    """Receives every frame of the link, for the log."""

    def __call__(self, outgoing: bool, autopilot_time_s: float, frame: bytes) -> None:
        """Take one frame with the autopilot's time when it passed."""
        ...


class Link:
    """See the module. `counters` holds what was seen and dropped, by reason."""

    def __init__(
        self,
        transport: Transport,
        tap: FrameTap | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        signer: Signer | None = None,
        system: int | None = None,
        component: int = OUR_COMPONENT,
    ) -> None:
        """Speak over `transport`; with a `signer` everything is signed and nothing unsigned is believed.

        `system`: of the autopilot that is meant; None: whoever is heard first. `component`: ours.
        """
        self._transport = transport
        self.component = component
        self.system_wanted = system
        self.other_autopilots: dict[int, str] = {}
        """Autopilots on this wire that are not ours: system id, and how a person would call it."""
        self.signer = signer
        self._framer = Framer(mav.mavlink_map, stream=not transport.datagrams)
        self._codec = mav.MAVLink(None, srcSystem=1, srcComponent=component)
        self._tap = tap
        self._now_ns = now_ns
        self._last_heartbeat_ns = 0
        self._last_refusal_ns = -(1 << 62)
        self._last_heartbeat_autopilot_s = -1e9
        self._last_timesync_autopilot_s = -1e9
        self._asked_at: dict[int, float] = {}  # our TIMESYNC questions: our time (ns), the autopilot's (s)
        self._sequence = SequenceCount()
        self._boot_time_s = 0.0
        self._clock_moved_ns = now_ns()
        self.target_system: int | None = None
        self.heartbeat: Message | None = None
        self.counters: Counter[str] = Counter()
        self.timesync = TimeSync()
        self._answered = (now_ns(), 0.0)  # our time, and what has been added to it (both ns)
        self.streams = StreamTiming(self.timesync)
        self.last_message_ns = 0
        self.wanted: Container[int] | None = None
        """Numbers of the messages that `receive` returns; the others are believed and logged all the same. None: all."""

    @property
    def tap(self) -> FrameTap | None:
        """Where every frame is reported."""
        return self._tap

    @tap.setter
    def tap(self, tap: FrameTap | None) -> None:
        self._tap = tap

    @property
    def autopilot_time_s(self) -> float:
        """The autopilot's time since boot, as of its latest time-stamped message (seconds)."""
        return self._boot_time_s

    @property
    def silence_s(self) -> float:
        """Our time since the autopilot's last message (seconds)."""
        return (self._now_ns() - self.last_message_ns) * 1e-9 if self.last_message_ns else float("inf")

    @property
    def clock_stands_s(self) -> float:
        """Our time since the autopilot's clock was last seen to move: ArduPilot tells no time until asked (seconds)."""
        return (self._now_ns() - self._clock_moved_ns) * 1e-9

    @property
    def loss_ratio(self) -> float:
        """Share of the autopilot's frames that never came, by sequence numbers."""
        total = self.counters["received"] + self.counters["lost"]
        return self.counters["lost"] / total if total else 0.0

    @property
    def refused(self) -> dict[str, int]:
        """How many frames were refused for their signature, by reason in a few words."""
        words = {UNSIGNED: "without a signature", FORGED: "with a wrong one", REPLAYED: "replayed"}
        return {text: self.counters[reason] for reason, text in words.items() if self.counters[reason]}

    def receive(self, timeout_s: float) -> Message | None:
        """The autopilot's next message, waiting at most `timeout_s` for it; None when there is none.

        One at a time, and nothing is believed of a frame before its turn: `autopilot_time_s` and the log then do
        not depend on how many frames happened to arrive together.
        """
        message = self._next_believed()
        if message is None and self._transport.wait(timeout_s):
            for chunk in self._transport.receive():
                self._framer.feed(chunk, self._transport.sender)
            if self._transport.strangers and self.signer is None:
                self._look_at_strangers()
            message = self._next_believed()
        return message

    def _next_believed(self) -> Message | None:
        framer, wanted = self._framer, self.wanted
        while (frame := framer.next_frame()) is not None:
            message = self._believe(frame)
            if message is not None and (wanted is None or message.msg_id in wanted):
                return message
        self.counters["stray bytes"] = framer.stray_bytes
        return None

    def _believe(self, frame: bytes) -> Message | None:
        """Read one frame; None for what is damaged, unknown, not our autopilot's, or answered here."""
        message = read(frame)
        if message is None:
            self.counters["bad frames"] += 1
            self._framer.reject()
            return None
        if (self.signer is not None or is_signed(frame)) and not self._signature_holds(frame):
            if not is_signed(frame):
                self._refuse_command(message, mav.MAV_RESULT_DENIED)
            return None
        if message.unknown:
            self._note_unknown(message)
            return None
        kind, ours = message.msg_id, self._is_our_autopilot(message)
        if kind in _COMMANDS:
            self._refuse_command(message, mav.MAV_RESULT_UNSUPPORTED)
        if not ours:
            return None
        self._count_loss(message)
        self.last_message_ns = self._now_ns()
        self._note_time(message)
        if self._tap is not None:
            self._tap(False, self._boot_time_s, frame)
        if kind == _TIMESYNC:
            if not self.is_for_us(message):
                return None
            if message.tc1 != 0:
                self._take_time_answer(message)
                return None
        elif kind == _HEARTBEAT:
            self.heartbeat = message
        return message

    def is_for_us(self, message: Message) -> bool:
        """Whether an answer of the autopilot is addressed to us, or to nobody: another companion's and a ground
        station's come by here, too. MAVLink 1, and older dialects, have no addressee in them.
        """
        if message.get_msgId() == _TIMESYNC:  # extension fields that the dialect has not
            system, component = (*message.msg_payload[16:18], 0, 0)[:2]
        else:
            system, component = message.target_system, message.target_component
        return system in (0, self.target_system) and component in (0, self.component)

    def _take_time_answer(self, message: Received) -> None:
        """Only an answer to a question of ours counts, and once: TIMESYNC goes to everybody on the network."""
        asked_s = self._asked_at.pop(message.ts1, None)
        if asked_s is None:
            self.counters["time answers to others"] += 1
            return
        self.timesync.add(message.ts1, message.tc1, self.last_message_ns, self._boot_time_s - asked_s)

    def _signature_holds(self, frame: bytes) -> bool:
        if self.signer is None:
            self.counters["signed, and we have no key"] += 1
            return True
        refusal = self.signer.judge(frame)
        if refusal is None:
            return True
        self.counters[refusal] += 1
        if refusal == REPLAYED and self.target_system is None:
            self._transport.greet_sender()  # an autopilot whose clock is behind takes our time from our frames
        return False

    def _refuse_command(self, message: Received, result: int) -> None:
        """Whoever commands the companion itself, signed or not: it takes no commands, and says so when asked by name."""
        if message.msg_id not in _COMMANDS or self.target_system is None:
            return
        if (message.target_system, message.target_component) != (self.target_system, self.component):
            return
        self.counters["commands refused"] += 1
        now_ns = self._now_ns()
        if (now_ns - self._last_refusal_ns) * 1e-9 < REFUSAL_PERIOD_S:
            return
        self._last_refusal_ns = now_ns
        asker = message.msg_system, message.msg_component
        self.send(mav.MAVLink_command_ack_message(message.command, result, 0, 0, *asker))

    def _note_unknown(self, message: Received) -> None:
        """A message newer than our dialect: counted and logged, not understood."""
        self.counters["unknown messages"] += 1
        if (message.msg_system, message.msg_component) == (self.target_system, AUTOPILOT_COMPONENT):
            self._count_loss(message)
            if self._tap is not None:
                self._tap(False, self._boot_time_s, message.msg_frame)

    def _is_our_autopilot(self, message: Received) -> bool:
        system, component = message.msg_system, message.msg_component
        wanted = self.system_wanted in (None, system)
        if self.target_system is None and wanted and is_autopilots(message):
            self.target_system = system
            self._codec.srcSystem = system
        if system != self.target_system or component != AUTOPILOT_COMPONENT:
            self._note_other(message)
            return False
        if message.msg_id == _HEARTBEAT and not is_autopilots(message):
            self.counters["other senders"] += 1  # somebody who took the autopilot's numbers
            return False
        self._transport.believe_sender()
        return True

    def _note_other(self, message: Received) -> None:
        """Count a frame of somebody else; another autopilot is remembered."""
        system = message.msg_system
        if is_autopilots(message):
            name = _AUTOPILOT_NAMES.get(message.autopilot, f"MAV_AUTOPILOT {message.autopilot}")
            self.other_autopilots[system] = f"{name}, system {system}"
        known = system in self.other_autopilots and message.msg_component == AUTOPILOT_COMPONENT
        self.counters["other autopilots" if known else "other senders"] += 1

    def look_out(self, wanted: bool) -> None:
        """Whether HEARTBEATs from addresses that are not our autopilot's are looked at, to notice another one.

        It costs the kernel's filter, so not in flight.
        """
        self._transport.look_out(wanted)

    def _look_at_strangers(self) -> None:
        strangers = self._transport.strangers
        while strangers:
            framer = Framer(mav.mavlink_map, stream=False)
            framer.feed(strangers.popleft())
            while (frame := framer.next_frame()) is not None:
                message = read(frame)
                if message is None:
                    framer.reject()
                elif message.msg_id == _HEARTBEAT and message.msg_system != self.target_system:
                    self._note_other(message)

    def _count_loss(self, message: Received) -> None:
        self.counters["received"] += 1
        self.counters["lost"] += self._sequence.lost_before(message.msg_sequence, message.msg_frame)

    def _note_time(self, message: Received) -> None:
        boot_ms, measured = message.boot_ms, message.msg_id in STREAMS
        if boot_ms is None:
            stamp_us = message.time_us if measured else None
            if stamp_us is not None:
                self.streams.note(message.msg_id, stamp_us * 1e-6, self.last_message_ns)
            return
        if message.msg_id in _STAMPED_WITH_A_SETPOINT:
            return
        boot_s = boot_ms * 1e-3
        if measured:
            self.streams.note(message.msg_id, boot_s, self.last_message_ns)
        # Streams are stamped when sampled, so small steps back are normal; a large one is a reboot.
        if boot_s > self._boot_time_s or boot_s < self._boot_time_s - 5.0:
            if boot_s < self._boot_time_s - 5.0:
                self.counters["reboots"] += 1
            self._boot_time_s = boot_s
            self._clock_moved_ns = self.last_message_ns

    def answer_timesync(self, question: Message) -> None:
        """Answer a TIMESYNC question that `receive` returned, after all that came before it has been dealt with.

        A simulator that waits for the answer then knows that its state has been dealt with, too.
        """
        self.send(mav.MAVLink_timesync_message(self.answering_clock_ns(self._now_ns()), question.ts1))

    def answering_clock_ns(self, our_ns: int) -> int:
        """What the clock says, at `our_ns` of ours, with which we answer TIMESYNC and stamp ODOMETRY.

        It is ours as long as the autopilot's runs as fast. Where that drifts away (a simulation whose loop sleeps whole
        periods), it keeps step with the autopilot's: a filter there that follows a drift late has none to follow.
        """
        before_ns, added_ns = self._answered
        if self.timesync.steady and our_ns > before_ns:
            added_ns += self.timesync.drift * (our_ns - before_ns)
            self._answered = our_ns, added_ns
        elif our_ns > before_ns:
            self._answered = our_ns, added_ns
        elif self.timesync.steady:
            added_ns -= self.timesync.drift * (before_ns - our_ns)
        return our_ns + round(added_ns)

    def send(self, message: Message) -> bool:
        """Pack and send one message; False when it could not go out now (counted)."""
        if self.signer is not None:
            self.signer.prepare(self._codec)
        frame = packed(message, self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        sent = self._transport.send(frame)
        self.counters["sent" if sent else "unsent"] += 1
        if sent and self._tap is not None:
            self._tap(True, self._boot_time_s, frame)
        return sent

    def keep_alive(self) -> None:
        """Send our HEARTBEAT at 1 Hz and a TIMESYNC question at 10 Hz, by the autopilot's clock while it speaks."""
        now_ns = self._now_ns()
        alone = not self.last_message_ns or (now_ns - self.last_message_ns) * 1e-9 > HEARTBEAT_PERIOD_S
        due = (
            (now_ns - self._last_heartbeat_ns) * 1e-9 >= HEARTBEAT_PERIOD_S
            if alone
            else abs(self._boot_time_s - self._last_heartbeat_autopilot_s) >= HEARTBEAT_PERIOD_S
        )
        if due:
            self._last_heartbeat_ns = now_ns
            self._last_heartbeat_autopilot_s = self._boot_time_s
            self.send(
                mav.MAVLink_heartbeat_message(
                    mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3
                )
            )
        if not alone and abs(self._boot_time_s - self._last_timesync_autopilot_s) >= 0.1:
            self._last_timesync_autopilot_s = self._boot_time_s
            self._asked_at[now_ns] = self._boot_time_s
            while len(self._asked_at) > QUESTIONS_REMEMBERED:
                del self._asked_at[next(iter(self._asked_at))]
            self.send(mav.MAVLink_timesync_message(0, now_ns))

    @property
    def not_open(self) -> str:
        """Why the wire's connection has never been there, and the remedy; empty where it has been."""
        return self._transport.not_open

    def take_notices(self) -> list[str]:
        """What happened to the wire since last asked, in sentences."""
        notices = list(self._transport.notices)
        self._transport.notices.clear()
        return notices

    def close(self) -> None:
        """Close the wire."""
        self._transport.close()
        if self.signer is not None:
            self.signer.close()


def is_autopilots(message: Received) -> bool:
    """Whether it is the HEARTBEAT of an autopilot that has a vehicle."""
    return bool(
        message.msg_id == _HEARTBEAT
        and message.msg_system != 0  # means everybody, and is nobody's
        and message.msg_component == AUTOPILOT_COMPONENT
        and message.autopilot != mav.MAV_AUTOPILOT_INVALID
        and message.type not in _NOT_VEHICLES
    )
