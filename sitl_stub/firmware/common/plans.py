"""The mission protocol as every firmware shares it: missions, fences and rally points, up, down, partly, and cleared.

https://mavlink.io/en/services/mission.html. What is uploaded is believed whole or not at all. A lost request is sent again.
Plans outlive a restart, as on a real vehicle's storage. Fences and rally points are kept, not flown by.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from sitl_stub.firmware.common.clock import Clock
from sitl_stub.firmware.common.commands import MessageHandler, is_place
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link

MISSION_FRAME = 2
"""MAV_FRAME_MISSION: of an item that is no place."""
PLACE_FRAMES = (0, 3, 5, 6, 10, 11)
"""MAV_FRAME_GLOBAL…: x and y are latitude and longitude."""
ABOVE_HOME_FRAMES = (3, 6)
ALL = 255
TYPES = (0, 1, 2)
"""MAV_MISSION_TYPE: mission, fence, rally."""
AGAIN_AFTER_US = 250_000
GIVEN_UP_AFTER_US = 5_000_000
_FIRST_MAVLINK2_FIELD = "mission_type"


class PlanResult(IntEnum):
    """MAV_MISSION_RESULT."""

    ACCEPTED = 0
    ERROR = 1
    UNSUPPORTED_FRAME = 2
    UNSUPPORTED = 3
    NO_SPACE = 4
    INVALID = 5
    INVALID_SEQUENCE = 13
    DENIED = 14
    CANCELLED = 15


@dataclass(frozen=True, slots=True)
class PlanItem:
    """One item of a plan."""

    command: int
    frame: int
    params: tuple[float, float, float, float]
    x: int
    """Latitude, 1e-7 degrees, where the frame is one of places."""
    y: int
    z: float
    """Altitude, m: above sea level, or above home in ABOVE_HOME_FRAMES."""
    autocontinue: int = 1

    @property
    def is_place(self) -> bool:
        """Whether it names a place on the globe."""
        return self.frame in PLACE_FRAMES and bool(self.x or self.y)

    @property
    def place_deg(self) -> tuple[float, float]:
        """Latitude and longitude."""
        return self.x * 1e-7, self.y * 1e-7


@dataclass
class Plans:
    """What is stored in one vehicle, and how far its mission is."""

    items: dict[int, tuple[PlanItem, ...]] = field(default_factory=lambda: dict.fromkeys(TYPES, ()))
    """By MAV_MISSION_TYPE. Writer: `PlanProtocol`."""
    current: int = 0
    """The mission's item that is next. Writers: `PlanProtocol`, and who flies it."""
    changes: int = 0
    """How often the mission has been replaced. Writer: `PlanProtocol`."""

    @property
    def mission(self) -> tuple[PlanItem, ...]:
        """The mission's items."""
        return self.items[0]


@dataclass(frozen=True, slots=True)
class PlanRules:
    """What differs between firmwares."""

    most: Mapping[int, int]
    """Items of each type."""
    commands: frozenset[int]
    """What a mission may hold; empty: everything."""
    busy: PlanResult
    """To a second partner."""
    wrong_item: PlanResult | None
    """To an item out of order; None: it is passed over."""
    writes_parts: bool
    """Whether MISSION_WRITE_PARTIAL_LIST is known."""


@dataclass(slots=True)
class _Upload:
    link: Link
    partner: tuple[int, int]
    kind: int
    first: int
    items: list[PlanItem]
    count: int
    heard_us: int
    asked_us: int = 0


class PlanProtocol:
    """Speaks it for one vehicle."""

    def __init__(
        self,
        plans: Plans,
        clock: Clock,
        rules: PlanRules,
        home_item: Callable[[], PlanItem | None] = lambda: None,
    ) -> None:
        """`home_item`: what a firmware keeps as item 0 of every mission, whatever was uploaded there."""
        self._plans = plans
        self._clock = clock
        self._rules = rules
        self._home_item = home_item
        self._upload: _Upload | None = None
        self._finished: tuple[tuple[int, int], int, int] | None = None  # partner, type, last item
        self.on_current: Callable[[], None] = lambda: None
        """Called when somebody has chosen the mission's current item, or replaced the mission."""

    def messages(self) -> Mapping[str, MessageHandler]:
        """Message name to handler."""
        known: dict[str, MessageHandler] = {
            "MISSION_COUNT": self._count,
            "MISSION_ITEM": self._item,
            "MISSION_ITEM_INT": self._item,
            "MISSION_REQUEST_LIST": self._request_list,
            "MISSION_REQUEST": self._request,
            "MISSION_REQUEST_INT": self._request,
            "MISSION_CLEAR_ALL": self._clear,
            "MISSION_SET_CURRENT": self._set_current,
            "MISSION_ACK": self._cancelled,
        }
        return known | ({"MISSION_WRITE_PARTIAL_LIST": self._write_part} if self._rules.writes_parts else {})

    def update(self) -> None:
        """Called a hundred times a second: ask again for what has not come, or give up."""
        upload, now_us = self._upload, self._clock.time_us
        if upload is None:
            return
        if now_us - upload.heard_us > GIVEN_UP_AFTER_US:
            self._upload = None
        elif now_us - upload.asked_us >= AGAIN_AFTER_US:
            self._ask(upload)

    def choose(self, number: int) -> bool:
        """Make item `number` the mission's current one; False where there is none."""
        if not 0 <= number < len(self._plans.mission):
            return False
        self._plans.current = number
        self.on_current()
        return True

    # --- up ----------------------------------------------------------------------------------------------------
    def _count(self, link: Link, message: Received) -> None:
        kind, count = _kind_of(message), int(message.values["count"])
        if not self._may_begin(link, message, kind):
            return
        if count > self._rules.most.get(kind, 0):
            result = PlanResult.NO_SPACE if kind in TYPES else PlanResult.UNSUPPORTED
            self._acknowledge(link, message, kind, result)
        elif count == 0:
            self._store(kind, ())
            self._acknowledge(link, message, kind, PlanResult.ACCEPTED)
        else:
            self._begin(link, message, kind, 0, count)

    def _write_part(self, link: Link, message: Received) -> None:
        kind, first, last = _kind_of(message), message.values["start_index"], message.values["end_index"]
        if not self._may_begin(link, message, kind):
            return
        if kind not in TYPES or not 0 <= first <= last < len(self._plans.items[kind]):
            self._acknowledge(link, message, kind, PlanResult.ERROR)
        else:
            self._begin(link, message, kind, first, last + 1)

    def _may_begin(self, link: Link, message: Received, kind: int) -> bool:
        upload = self._upload
        if upload is None or upload.partner == _partner_of(message):
            return True
        self._acknowledge(link, message, kind, self._rules.busy)
        return False

    def _begin(self, link: Link, message: Received, kind: int, first: int, count: int) -> None:
        now_us = self._clock.time_us
        self._upload = _Upload(link, _partner_of(message), kind, first, [], count, now_us)
        self._ask(self._upload)

    def _ask(self, upload: _Upload) -> None:
        upload.asked_us = self._clock.time_us
        system, component = upload.partner
        upload.link.send(
            "MISSION_REQUEST_INT",
            target_system=system,
            target_component=component,
            seq=upload.first + len(upload.items),
            mission_type=upload.kind,
        )

    def _item(self, link: Link, message: Received) -> None:
        upload, kind, number = self._upload, _kind_of(message), int(message.values["seq"])
        if upload is None or upload.partner != _partner_of(message):
            again = self._finished == (_partner_of(message), kind, number)  # our last answer was lost
            self._acknowledge(link, message, kind, PlanResult.ACCEPTED if again else PlanResult.ERROR)
            return
        upload.heard_us = self._clock.time_us
        if kind != upload.kind:
            self._acknowledge(link, message, kind, PlanResult.ERROR)
            return
        if number != upload.first + len(upload.items):
            if self._rules.wrong_item is not None:
                self._acknowledge(link, message, kind, self._rules.wrong_item)
            return
        item = _item_of(message)
        result = self._judge(kind, item)
        if result is not PlanResult.ACCEPTED:
            self._upload = None
            self._acknowledge(link, message, kind, result)
            return
        upload.items.append(item)
        if upload.first + len(upload.items) < upload.count:
            self._ask(upload)
            return
        self._upload, self._finished = None, (upload.partner, kind, number)
        kept = list(self._plans.items[kind]) if upload.first else []
        kept[upload.first : upload.count] = upload.items
        self._store(kind, tuple(kept))
        self._acknowledge(link, message, kind, PlanResult.ACCEPTED)

    def _judge(self, kind: int, item: PlanItem) -> PlanResult:
        if item.frame not in (*PLACE_FRAMES, MISSION_FRAME):
            return PlanResult.UNSUPPORTED_FRAME
        if item.is_place and not is_place(*item.place_deg, item.z if math.isfinite(item.z) else 0.0):
            return PlanResult.INVALID
        of_fence, of_rally = 5000 <= item.command <= 5004, item.command == 5100
        if (of_fence, of_rally) != (kind == 1, kind == 2):
            return PlanResult.ERROR if kind == 0 else PlanResult.UNSUPPORTED
        if kind == 0 and self._rules.commands and item.command not in self._rules.commands:
            return PlanResult.UNSUPPORTED
        return PlanResult.ACCEPTED

    def _store(self, kind: int, items: tuple[PlanItem, ...]) -> None:
        self._plans.items[kind] = items
        if kind == 0:
            self._plans.current = 0
            self._plans.changes += 1
            self.on_current()

    # --- down --------------------------------------------------------------------------------------------------
    def _held(self, kind: int) -> tuple[PlanItem, ...]:
        items, home = self._plans.items.get(kind, ()), self._home_item()
        return (home, *items[1:]) if kind == 0 and items and home is not None else items

    def _request_list(self, link: Link, message: Received) -> None:
        kind = _kind_of(message)
        _answer(link, message, "MISSION_COUNT", kind, count=len(self._held(kind)))

    def _request(self, link: Link, message: Received) -> None:
        kind, number = _kind_of(message), int(message.values["seq"])
        items = self._held(kind)
        if not 0 <= number < len(items):
            self._acknowledge(link, message, kind, PlanResult.INVALID_SEQUENCE)
            return
        item, whole = items[number], message.name == "MISSION_REQUEST_INT"
        places: tuple[float, float] = (item.x, item.y)
        if not whole and item.frame in PLACE_FRAMES:
            places = item.place_deg
        _answer(
            link,
            message,
            "MISSION_ITEM_INT" if whole else "MISSION_ITEM",
            kind,
            seq=number,
            command=item.command,
            frame=item.frame,
            current=int(kind == 0 and number == self._plans.current),
            autocontinue=item.autocontinue,
            x=places[0],
            y=places[1],
            z=item.z,
            **{f"param{n}": value for n, value in enumerate(item.params, 1)},
        )

    # --- the rest ----------------------------------------------------------------------------------------------
    def _clear(self, link: Link, message: Received) -> None:
        kind = _kind_of(message)
        if not self._may_begin(link, message, kind):
            return
        kinds = TYPES if kind == ALL else (kind,)
        if not set(kinds) <= set(TYPES):
            self._acknowledge(link, message, kind, PlanResult.UNSUPPORTED)
            return
        for each in kinds:
            self._store(each, ())
        self._acknowledge(link, message, kind, PlanResult.ACCEPTED)

    def _set_current(self, link: Link, message: Received) -> None:
        self.choose(int(message.values["seq"]))

    def _cancelled(self, link: Link, message: Received) -> None:
        """The partner has had enough of an upload."""
        upload = self._upload
        if upload is not None and upload.partner == _partner_of(message) and message.values["type"]:
            self._upload = None

    def _acknowledge(self, link: Link, message: Received, kind: int, result: PlanResult) -> None:
        _answer(link, message, "MISSION_ACK", kind, type=int(result))


def _answer(link: Link, message: Received, name: str, kind: int, **fields: Any) -> None:
    link.send(
        name, target_system=message.system, target_component=message.component, mission_type=kind, **fields
    )


def _partner_of(message: Received) -> tuple[int, int]:
    return message.system, message.component


def _kind_of(message: Received) -> int:
    return int(message.values.get(_FIRST_MAVLINK2_FIELD, 0))


def _item_of(message: Received) -> PlanItem:
    v = message.values
    frame, x, y = int(v["frame"]), v["x"], v["y"]
    if message.name == "MISSION_ITEM" and frame in PLACE_FRAMES:
        x, y = x * 1e7, y * 1e7
    a, b, c, d = (float(v[f"param{n}"]) for n in range(1, 5))
    x, y = (round(value) if math.isfinite(value) else 0 for value in (x, y))
    return PlanItem(int(v["command"]), frame, (a, b, c, d), x, y, float(v["z"]), int(v["autocontinue"]))
