"""Whose setpoints reach the autopilot: at any moment one side's only.

A client's position setpoints are passed on like everything else until the law takes over; from then on they are what
the law flies. When it lets go, the newest one that was held back is passed on after all, so that the autopilot has the
last word of its client, as without us. Nothing here reads a clock or knows a socket.
"""

from __future__ import annotations

from collections import Counter

from companion.mavlink.framing import message_id
from companion.mavlink.layouts import mav
from companion.mavlink.received import read
from companion.mavlink.signing import Signer

POSITION_SETPOINTS: frozenset[int] = frozenset(
    (mav.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED, mav.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT)
)
ATTITUDE_SETPOINTS: frozenset[int] = frozenset(
    (mav.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET, mav.MAVLINK_MSG_ID_SET_ACTUATOR_CONTROL_TARGET)
)
SETPOINTS = POSITION_SETPOINTS | ATTITUDE_SETPOINTS
ONE_SOURCE_S = 1.0
"""A client that has sent no setpoint for so long may be followed by another."""
OWN_BUSINESS_S = 0.5
"""A client's attitude setpoint keeps ours from the autopilot for so long."""
LAPSE_S = 0.3
"""A law that has taken over and sends nothing for so long, while the autopilot speaks, has let go."""
HELD_BACK_S = 1.0
"""A setpoint held back for longer is not passed on any more."""


class SetpointSwitch:
    """See the module. Times are ours, in seconds."""

    def __init__(self, signer: Signer | None = None) -> None:
        """With a `signer`, as our own setpoints are signed: one that is not signed with its key is never flown by us."""
        self._signer = signer
        self._source: object = None
        self._source_s = -ONE_SOURCE_S
        self._own_business_s = -OWN_BUSINESS_S
        self._flown_s = 0.0  # the law's newest setpoint
        self._held_back: tuple[bytes, float] | None = None
        self.system = 0  # whose setpoints are meant, besides everybody's
        self.taken = False
        """The law flies."""
        self.counters: Counter[str] = Counter()

    def take(self, system: int, now_s: float) -> None:
        """From now on the law flies the autopilot `system`."""
        self.system, self.taken, self._flown_s, self._held_back = system, True, now_s, None

    def let_go(self, now_s: float) -> bytes | None:
        """The law flies no more: the frame that is to be passed on now, if there is one."""
        held_back, self._held_back, self.taken = self._held_back, None, False
        if held_back is None or now_s - held_back[1] > HELD_BACK_S:
            return None
        return held_back[0]

    def from_client(self, client: object, frame: bytes, now_s: float) -> tuple[bool, bool]:
        """Whether a client's frame goes to the autopilot, and whether the law has to see it."""
        kind = message_id(frame)
        if kind not in SETPOINTS:
            return True, False
        message = read(frame)
        if message is None or (self.system and message.target_system not in (0, self.system)):
            return True, False
        if self._signer is not None and self._signer.judge(frame) is not None:
            self.counters["setpoints not signed with our key"] += 1
            return True, False  # the autopilot refuses it as well
        if kind in ATTITUDE_SETPOINTS:
            self._own_business_s = now_s
            return True, True
        if client is not self._source:
            if now_s - self._source_s < ONE_SOURCE_S:
                self.counters["setpoints of a second client"] += 1
                return not self.taken, False
            self._source = client
        self._source_s = now_s
        if self.taken:
            self._held_back = frame, now_s
            self.counters["setpoints flown by the law"] += 1
        else:
            self.counters["setpoints passed on"] += 1
        return not self.taken, True

    def from_law(self, frame: bytes, now_s: float) -> bool:
        """Whether a frame of the law's own goes to the autopilot."""
        if message_id(frame) not in SETPOINTS:
            return True
        self._flown_s = now_s
        if self.taken and now_s - self._own_business_s >= OWN_BUSINESS_S:
            return True
        self.counters["setpoints of the law held back"] += 1
        return False

    def has_lapsed(self, now_s: float) -> bool:
        """Whether the law has taken over and sends nothing; to be asked while the autopilot speaks."""
        return self.taken and now_s - self._flown_s > LAPSE_S
