"""The vehicle as the flight sees it: one link, one adapter, and waiting for things without missing any message.

Everything happens in the caller's thread, message by message, in the order of arrival. Waiting is measured on
the autopilot's clock while it speaks, so that a simulation may run at any speed; only silence is measured on ours.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from companion.autopilot.adapter import (
    STATUS_MESSAGES,
    TRUTH_MESSAGES,
    Adapter,
    Intent,
    VehicleStatus,
    Version,
    version_text,
)
from companion.autopilot.registry import adapter_for
from companion.config.errors import UserError
from companion.control.structs import VehicleState
from companion.flight.one_world import PoseComparison, PoseFigures
from companion.flight.outcome import LinkLost, WaitedTooLong
from companion.mavlink.link import Link, Message, mav
from companion.mavlink.outside_poses import OutsidePoses
from companion.mavlink.pose_datagram import OutsidePose
from companion.mavlink.protocol import (
    RESULT_WORDS,
    Command,
    CommandClient,
    ParameterClient,
    message_interval,
    request_message,
)
from companion.mavlink.state import STATE_MESSAGES, StateAssembler
from companion.mavlink.status_text import StatusText, StatusTexts

LANDED_STATE_HOLDS_S = 2.5  # of the autopilot's time; asked for at 5 Hz, on a slow line it comes at 1 Hz
POLL_S = 0.05
POSE_POLL_S = 0.005
ACK_TIMEOUT_S = 1.0
IN_PROGRESS_S = 3.0  # from one "in progress" to the next word
LISTEN_S = 1.2  # for a second autopilot: a HEARTBEAT comes every second
TRIES = 4
HEARTBEATS_OF_A_CLOCK_THAT_STANDS = 5
_EXTENDED_SYS_STATE: int = mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
_TIMESYNC: int = mav.MAVLINK_MSG_ID_TIMESYNC
_HEARTBEAT: int = mav.MAVLINK_MSG_ID_HEARTBEAT
_STATUSTEXT: int = mav.MAVLINK_MSG_ID_STATUSTEXT
_COMMAND_ACK: int = mav.MAVLINK_MSG_ID_COMMAND_ACK
_PARAM_VALUE: int = mav.MAVLINK_MSG_ID_PARAM_VALUE
HANDLED = STATE_MESSAGES | STATUS_MESSAGES | TRUTH_MESSAGES | {_TIMESYNC, _COMMAND_ACK, _PARAM_VALUE}
"""Messages that the vehicle itself has to do with."""


class Vehicle:
    """See the module. `on_state` is called with every new state, `on_message` with every message before that.

    `on_lone_attitude` is called with every attitude that has no position (a state whose position is not a number).
    """

    def __init__(self, link: Link, silence_limit_s: float) -> None:
        self.link = link
        self.adapter: Adapter
        self.status = VehicleStatus()
        self.state: VehicleState | None = None
        self.assembler = StateAssembler()
        self.commands = CommandClient(link)
        self.parameters = ParameterClient(link)
        self._texts = StatusTexts()
        self._others_told = 0
        self.taken_off = False
        """Before, a second autopilot on the link is a reason not to fly; from then on it is only told."""
        self.version: Version | None = None  # None: not told, or built without one
        self.identity = ""  # AUTOPILOT_VERSION's uid2 or uid; empty where neither is told
        self.address = ""  # the endpoint, for people and for telling vehicles apart that tell no identity
        self.simulated = False  # only a simulation publishes its true state
        self.silence_limit_s = silence_limit_s
        self.landed_state_s = -math.inf  # when EXTENDED_SYS_STATE was heard last, the autopilot's time
        self.on_state: Callable[[VehicleState], None] = lambda _: None
        self.on_lone_attitude: Callable[[VehicleState], None] = lambda _: None
        self.on_message: Callable[[Message], None] = lambda _: None
        self.watch: Callable[[], None] = lambda: None
        self.on_notice: Callable[[str], None] = lambda _: None
        self.outside_poses: OutsidePoses | None = None
        self.poses = PoseComparison()
        self.poses_are_used: bool | None = None  # by the estimator; None: not known

    @property
    def on_ground(self) -> bool | None:
        """What the land detector says (EXTENDED_SYS_STATE); None where it says nothing, or said it too long ago."""
        state, age_s = self.status.landed_state, self.link.autopilot_time_s - self.landed_state_s
        if state == mav.MAV_LANDED_STATE_UNDEFINED or not 0.0 <= age_s <= LANDED_STATE_HOLDS_S:
            return None
        return bool(state == mav.MAV_LANDED_STATE_ON_GROUND)

    @property
    def is_ours(self) -> bool:
        """Whether the autopilot is in the mode in which it follows our setpoints."""
        return self.adapter.is_mode(self.status.custom_mode, Intent.EXTERNAL)

    # Waiting ----------------------------------------------------------------------------------------

    def until(self, condition: Callable[[], bool], timeout_s: float = math.inf, what: str = "") -> None:
        """Handle messages until `condition()` holds. Where the autopilot's clock stands still, ours counts.

        Raises:
            WaitedTooLong: after `timeout_s` of the autopilot's time.
            LinkLost: after `silence_limit_s` without a message (our clock).
            FlightEnd: whatever `watch` or `on_state` raise.
        """
        self._pass_notices()  # where messages never pause, there is no other time for them
        link, bounded = self.link, timeout_s < math.inf
        started_s = link.autopilot_time_s
        asked_s = time.monotonic()
        while not condition():
            self.watch()
            if len(link.other_autopilots) > self._others_told:
                self._judge_others()
            if bounded and min(link.clock_stands_s, time.monotonic() - asked_s) > timeout_s:
                raise WaitedTooLong(f"{what or 'the autopilot'}: nothing after {timeout_s:.0f} s")
            if self.outside_poses is not None:
                self._forward_poses(self.outside_poses)
            message = link.receive(self._poll_s)
            if message is None:
                self._pass_notices()
                link.keep_alive()
                if link.silence_s > self.silence_limit_s:
                    raise LinkLost(f"nothing heard from the autopilot for {self.silence_limit_s:.1f} s")
                continue
            self._handle(message)
            link.keep_alive()  # an autopilot that never pauses and asks nothing still hears us
            if bounded:
                started_s = started_s or link.autopilot_time_s  # 0 until the first time stamp
                if link.autopilot_time_s - started_s > timeout_s:
                    raise WaitedTooLong(f"{what or 'the autopilot'}: nothing after {timeout_s:.0f} s")

    def disarmed_for(self, lasts_s: float) -> Callable[[], bool]:
        """A condition for `until`: HEARTBEATs have said disarmed for `lasts_s` of the autopilot's time.

        One alone may have been held up on its way, and tell of how it was before. An autopilot that was started anew
        may send nothing with its time in it: then `HEARTBEATS_OF_A_CLOCK_THAT_STANDS` of them count, once a second each.
        """
        link, since_s, latest, count = self.link, math.nan, self.link.heartbeat, 0

        def holds() -> bool:
            nonlocal since_s, latest, count
            if self.status.armed:
                since_s = math.nan
                return False
            if math.isnan(since_s):
                since_s, latest, count = link.autopilot_time_s, link.heartbeat, 0
            elif link.heartbeat is not latest:
                latest, count = link.heartbeat, count + 1
            passed_s = abs(link.autopilot_time_s - since_s)  # a clock that starts again counts from there
            if passed_s == 0.0:
                return count >= HEARTBEATS_OF_A_CLOCK_THAT_STANDS
            return passed_s >= lasts_s and count > 0

        return holds

    def _pass_notices(self) -> None:
        for text in self.link.take_notices():
            self.on_notice(text)

    @property
    def _poll_s(self) -> float:
        """How long to wait for a message: poses are not waited for, so with them not long."""
        return POLL_S if self.outside_poses is None else POSE_POLL_S

    def _forward_poses(self, poses: OutsidePoses) -> None:
        poses.on_pose = self._compare_pose
        poses.stamped_ns = self.link.answering_clock_ns
        for message in poses.poll():
            self.link.send(message)
        while poses.notices:
            self.on_notice(poses.notices.popleft())

    def pose_figures(self, now_s: float) -> PoseFigures | None:
        """How poses from outside stand to the estimate; None where there are none, or the estimator uses none."""
        if self.outside_poses is None or self.poses_are_used is False:
            return None
        return self.poses.figures(now_s)

    def _compare_pose(self, pose: OutsidePose) -> None:
        if self.state is not None:
            self.poses.add(pose, self.state)

    def _handle(self, message: Message) -> None:
        kind = message.get_msgId()
        if kind == _TIMESYNC:
            self.link.keep_alive()
            self.link.answer_timesync(message)
            return
        self.status.heard_s[kind] = self.link.autopilot_time_s
        if kind in TRUTH_MESSAGES:
            self.simulated = True
        elif kind == _STATUSTEXT:
            self._hear_texts(self._texts.take(message, time.monotonic()))
            return
        elif kind in STATUS_MESSAGES:
            self.status.take(message, self.link.autopilot_time_s)
            if kind == _HEARTBEAT:
                self._hear_texts(self._texts.overdue(time.monotonic()))
            if kind == _EXTENDED_SYS_STATE:
                self.landed_state_s = self.link.autopilot_time_s
        elif kind == _COMMAND_ACK:
            self.commands.take(message)
        elif kind == _PARAM_VALUE:
            self.parameters.take(message)
        self.on_message(message)
        if kind in STATE_MESSAGES:
            state = self.assembler.take(message)
            if state is not None:
                self.state = state
                self.on_state(state)
            elif self.assembler.lone_attitude is not None:
                self.on_lone_attitude(self.assembler.lone_attitude)

    def _hear_texts(self, texts: list[StatusText]) -> None:
        for each in texts:
            message = mav.MAVLink_statustext_message(each.severity, b"")
            message.text = each.text  # in UTF-8, of which pymavlink would leave the ASCII characters only
            self.status.take(message)
            self.on_message(message)

    def _judge_others(self) -> None:
        """Somebody else's autopilot is on this link.

        Raises:
            UserError: we are not in the air, and nobody has said which one is meant.
        """
        link, others = self.link, self.link.other_autopilots
        self._others_told = len(others)
        ours = f"{self.adapter.name}, system {link.target_system}"
        names = [ours, *(others[system] for system in sorted(others))]
        if not self.taken_off and link.system_wanted is None:
            ids = " or ".join(f"--system {system}" for system in sorted((link.target_system or 0, *others)))
            raise UserError(
                f"{len(names)} autopilots on this link ({'; '.join(names)}); say which one with {ids}"
            )
        self.on_notice(f"another autopilot is heard on this link ({'; '.join(names[1:])}); we fly {ours}")

    # Getting to know it -----------------------------------------------------------------------------

    def connect(self, timeout_s: float, waiting: Callable[[float], None] = lambda _: None) -> None:
        """Wait for an autopilot's HEARTBEAT, choose its adapter, ask what it is (AUTOPILOT_VERSION).

        `waiting` is called with the time waited so far, s.

        Raises:
            UserError: nobody there, not an autopilot we know, not a multirotor.
        """
        started_s = time.monotonic()
        while self.link.heartbeat is None:
            waited_s = time.monotonic() - started_s
            waiting(waited_s)
            self.watch()
            self._pass_notices()
            self.link.keep_alive()
            message = self.link.receive(POLL_S)
            if message is not None:
                self._handle(message)
            if waited_s > timeout_s and self.link.heartbeat is None:
                raise UserError(self._why_nobody(timeout_s))
        self._pass_notices()
        heartbeat = self.link.heartbeat
        self.link.look_out(True)
        listened = self._listened()
        self.adapter = adapter_for(heartbeat.autopilot, heartbeat.type)
        self.parameters.bytewise = self.adapter.bytewise_parameters
        self.status.ahrs_tells_estimator = self.adapter.ahrs_tells_estimator
        if self.outside_poses is not None:
            self.outside_poses.local_ned = self.adapter.takes_local_ned_odometry
        answered: list[Message] = []

        def note(message: Message) -> None:
            if message.get_msgId() == mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
                answered.append(message)

        before, self.on_message = self.on_message, note
        for _ in range(TRIES):
            self.commands.send(request_message(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION))
            try:
                self.until(lambda: bool(answered), ACK_TIMEOUT_S)
                break
            except WaitedTooLong:
                continue
        self.on_message = before
        if answered:
            number = answered[0].flight_sw_version
            version = (number >> 24 & 0xFF, number >> 16 & 0xFF, number >> 8 & 0xFF)
            self.version = version if any(version) else None  # 0.0.0 is a build without tags
            uid2 = bytes(answered[0].uid2)
            self.identity = uid2.hex() if any(uid2) else f"{answered[0].uid:x}" if answered[0].uid else ""
        elif self.link.counters["signed, and we have no key"]:
            raise UserError(
                "the autopilot signs its messages and answers nothing that is not signed: give --signing-key FILE"
            )
        self.until(listened)

    def _listened(self) -> Callable[[], bool]:
        """A condition for `until`: another autopilot would have been heard by now, if there were one.

        By the autopilot's clock or ours, whichever is sooner there: a simulation may run faster. One that tells no time
        tells it by its HEARTBEATs.
        """
        link, begun_s, first, told_s = self.link, time.monotonic(), self.link.heartbeat, math.nan

        def enough() -> bool:
            nonlocal told_s
            if math.isnan(told_s) and link.autopilot_time_s > 0.0:
                told_s = link.autopilot_time_s
            untimed = math.isnan(told_s) and link.heartbeat is not first
            passed_s = max(time.monotonic() - begun_s, link.autopilot_time_s - told_s)
            return untimed or passed_s >= LISTEN_S

        return enough

    @property
    def firmware(self) -> str:
        """Name and version, for people."""
        return f"{self.adapter.name} {version_text(self.version)}"

    def _why_nobody(self, timeout_s: float) -> str:
        counters = self.link.counters
        refused = self.link.refused
        others = self.link.other_autopilots
        if others:
            names = "; ".join(others[system] for system in sorted(others))
            heard = f"heard was {names}, but --system {self.link.system_wanted} is wanted"
        elif self.link.not_open:
            heard = self.link.not_open
        elif refused:
            heard = (
                f"{sum(refused.values())} frames refused: not signed with this key "
                f"({', '.join(f'{count} {reason}' for reason, count in refused.items())}); "
                "is this the autopilot's key, and is signing on there?"
            )
        elif counters["bad frames"] or counters["stray bytes"]:
            heard = "bytes arrived, but no valid MAVLink: wrong baud rate, or another program's port?"
        elif counters["other senders"]:
            heard = "MAVLink arrived, but no autopilot (component 1): is this a ground station's or a gimbal's port?"
        else:
            heard = (
                "nothing arrived: is the autopilot on, and does it send to this address? "
                "PX4's companion link is UDP 14540, ArduPilot's SITL TCP 5760"
            )
        return f"no autopilot within {timeout_s:.0f} s; {heard}"

    def command(self, command: Command, enough: Callable[[], bool] = lambda: False) -> int | None:
        """Send a command until it is answered; return the MAV_RESULT, None when nobody answers.

        Where `enough()` holds, what the command is for has come about: no answer is waited for, and it is not sent again.
        """
        for attempt in range(TRIES):
            self.commands.send(command, again=attempt > 0)
            heard, timeout_s = 0, ACK_TIMEOUT_S
            while True:
                try:
                    self.until(lambda: self.commands.result is not None or enough(), timeout_s)
                except WaitedTooLong:
                    if self.commands.in_progress == heard:
                        break
                    heard, timeout_s = self.commands.in_progress, IN_PROGRESS_S
                    continue
                return self.commands.result
        return None

    def result_word(self, result: int | None) -> str:
        """A MAV_RESULT in words."""
        return "not answered" if result is None else RESULT_WORDS.get(result, f"result {result}")

    def last_texts(self) -> str:
        """The autopilot's last warnings, to be put behind a reason; empty when it gave none."""
        texts = [text for severity, text in self.status.texts if severity <= mav.MAV_SEVERITY_WARNING]
        return f"; it says: {' / '.join(texts[-3:])}" if texts else ""

    def read_parameters(self, names: tuple[str, ...]) -> None:
        """Read parameters into `parameters.values`; those the autopilot does not know stay absent."""
        for _ in range(3):
            missing = [name for name in names if name not in self.parameters.values]
            if not missing:
                return
            for name in missing:
                self.parameters.request(name)
            try:
                self.until(lambda: all(name in self.parameters.values for name in names), 1.0)
            except WaitedTooLong:
                continue

    def set_parameter(self, name: str, value: float) -> bool:
        """Set a parameter that was read before; True when the autopilot echoed the new value."""
        for _ in range(3):
            self.parameters.set(name, value)
            try:
                self.until(lambda: math.isclose(self.parameters.values[name], value, rel_tol=1e-6), 1.0)
            except WaitedTooLong:
                continue
            return True
        return False

    def ask_for_stream(self, message_id: int, rate_hz: float) -> bool:
        """Ask for a message at `rate_hz`; False when it is refused or not answered."""
        return bool(self.command(message_interval(message_id, rate_hz)) == mav.MAV_RESULT_ACCEPTED)
