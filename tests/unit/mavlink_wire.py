"""An autopilot's side of the wire, in memory: packs frames as an autopilot would, and a transport to hand them over."""

from __future__ import annotations

import os
from collections import deque

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import all as mav

from companion.mavlink.link import Link


class Sender:
    """Packs messages as one system and component, counting sequence numbers."""

    def __init__(self, system=1, component=1):
        self.codec = mav.MAVLink(None, srcSystem=system, srcComponent=component)

    def frame(self, message):
        packed = message.pack(self.codec)
        self.codec.seq = (self.codec.seq + 1) % 256
        return bytes(packed)

    def skip(self, count):
        """As if `count` frames had been lost."""
        self.codec.seq = (self.codec.seq + count) % 256


class MemoryTransport:
    """What `Link` needs of a transport; chunks are put into `waiting`, frames sent are in `sent`."""

    def __init__(self, datagrams=True):
        self.datagrams = datagrams
        self.waiting = deque()
        self.sent = []
        self.takes = True
        self.notices = deque()
        self.sender = None
        self.strangers = deque()

    def believe_sender(self):
        pass

    def greet_sender(self):
        pass

    def look_out(self, wanted):
        pass

    def wait(self, timeout_s):
        return bool(self.waiting)

    def receive(self):
        chunks, self.waiting = list(self.waiting), deque()
        return chunks

    def send(self, data):
        if self.takes:
            self.sent.append(bytes(data))
        return self.takes

    def close(self):
        pass


class Clock:
    """Our clock, set by hand (ns)."""

    def __init__(self):
        self.ns = 1_000_000_000

    def __call__(self):
        return self.ns

    def advance(self, seconds):
        self.ns += round(seconds * 1e9)


def link_over(transport, clock=None):
    return Link(transport, now_ns=clock or Clock())


def heartbeat(autopilot=mav.MAV_AUTOPILOT_PX4, kind=mav.MAV_TYPE_QUADROTOR, custom_mode=0, base_mode=0):
    return mav.MAVLink_heartbeat_message(kind, autopilot, base_mode, custom_mode, mav.MAV_STATE_ACTIVE, 3)


def local_position(time_ms, position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0)):
    return mav.MAVLink_local_position_ned_message(time_ms, *position, *velocity)


def attitude(time_ms, quaternion=(1.0, 0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0)):
    return mav.MAVLink_attitude_quaternion_message(time_ms, *quaternion, *rates)


def all_messages(link):
    """Everything the link can be made to say now."""
    messages = []
    while (message := link.receive(0.0)) is not None:
        messages.append(message)
    return messages


def decoded(frames):
    """Messages of frames that our side sent."""
    codec = mav.MAVLink(None)
    return [codec.decode(bytearray(frame)) for frame in frames]
