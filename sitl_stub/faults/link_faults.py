"""Faults of the link: frames lost, late, doubled, out of order, damaged."""

from __future__ import annotations

import dataclasses
import random
from dataclasses import dataclass

from sitl_stub.faults.fault import Effect, Fault, Site, choice, hold, number, whole
from sitl_stub.faults.frames import Direction, Parcel

DIRECTIONS = ("both", "to_client", "from_client")


def _direction() -> str:
    chosen: str = choice(
        "both", DIRECTIONS, "which frames: the autopilot's (to_client), the clients', or both"
    )
    return chosen


def _probability(default: float) -> float:
    chosen: float = number(default, "", "probability with which a frame is concerned", 0.0, 1.0)
    return chosen


@dataclass(frozen=True)
class LinkFault(Fault):
    """What faults of all frames share."""

    direction: str = _direction()

    def affects(self, direction: Direction, message: str) -> bool:
        """Whether it has to do with frames on that way."""
        return self.direction in ("both", direction)

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """What becomes of one frame."""
        raise NotImplementedError

    def act(self, site: Site) -> Effect:
        """Stand in the frames' way."""
        end = site.frames.begin(self, site.random)
        try:
            yield from hold()
        finally:
            end()


@dataclass(frozen=True)
class LinkLoss(LinkFault):
    """Frames are lost."""

    kind = "link_loss"
    probability: float = _probability(1.0)

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself or nothing."""
        return [] if draw.random() < self.probability else [parcel]


@dataclass(frozen=True)
class LinkDelay(LinkFault):
    """Frames arrive late, in order."""

    kind = "link_delay"
    delay_s: float = number(0.2, "s", "how late", 0.0, 60.0)

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself, late."""
        return [dataclasses.replace(parcel, late_s=parcel.late_s + self.delay_s)]


@dataclass(frozen=True)
class LinkJitter(LinkFault):
    """Frames arrive late by a random time each, in order: one that is late holds up those behind it."""

    kind = "link_jitter"
    jitter_s: float = number(0.05, "s", "greatest lateness; evenly distributed from 0", 0.0, 60.0)

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself, late."""
        return [dataclasses.replace(parcel, late_s=parcel.late_s + draw.uniform(0.0, self.jitter_s))]


@dataclass(frozen=True)
class LinkDuplicate(LinkFault):
    """Frames arrive twice, one after the other."""

    kind = "link_duplicate"
    probability: float = _probability(0.1)

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself, perhaps twice."""
        return [parcel, parcel] if draw.random() < self.probability else [parcel]


@dataclass(frozen=True)
class LinkReorder(LinkFault):
    """Frames are held back, and others overtake them."""

    kind = "link_reorder"
    probability: float = _probability(0.1)
    delay_s: float = number(0.05, "s", "how long a frame is held back", 0.0, 60.0)

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself, perhaps held back."""
        if draw.random() >= self.probability:
            return [parcel]
        return [dataclasses.replace(parcel, held_s=parcel.held_s + self.delay_s)]


@dataclass(frozen=True)
class LinkCorrupt(LinkFault):
    """Bits of frames are flipped, at random places."""

    kind = "link_corrupt"
    probability: float = _probability(0.1)
    bits: int = whole(1, "bits flipped in a frame", 1, 64)

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself, perhaps damaged."""
        if draw.random() >= self.probability:
            return [parcel]
        damaged = bytearray(parcel.frame)
        for place in draw.sample(range(8 * len(damaged)), min(self.bits, 8 * len(damaged))):
            damaged[place // 8] ^= 1 << place % 8
        return [dataclasses.replace(parcel, frame=bytes(damaged))]


@dataclass(frozen=True)
class LinkTruncate(LinkFault):
    """Frames are cut off at a random length."""

    kind = "link_truncate"
    probability: float = _probability(0.1)

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself, perhaps cut."""
        if draw.random() >= self.probability or len(parcel.frame) < 2:
            return [parcel]
        return [dataclasses.replace(parcel, frame=parcel.frame[: draw.randrange(1, len(parcel.frame))])]


@dataclass(frozen=True)
class AckLoss(Fault):
    """The autopilot's COMMAND_ACKs are lost; the commands are obeyed."""

    kind = "ack_loss"
    probability: float = _probability(1.0)
    message = "COMMAND_ACK"

    def affects(self, direction: Direction, message: str) -> bool:
        """That one message."""
        return message == self.message

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself or nothing."""
        return [] if draw.random() < self.probability else [parcel]

    def act(self, site: Site) -> Effect:
        """Stand in the message's way."""
        end = site.frames.begin(self, site.random)
        try:
            yield from hold()
        finally:
            end()


@dataclass(frozen=True)
class ParameterLoss(AckLoss):
    """The autopilot's PARAM_VALUEs are lost: holes in lists, reads and settings without an answer."""

    kind = "parameter_loss"
    probability: float = _probability(0.3)
    message = "PARAM_VALUE"
