"""The phases of a flight, in the order they are gone through."""

from __future__ import annotations

import enum


class Phase(enum.Enum):
    """Where in the flight we are; the value is what people and the log see."""

    CONNECT = "connect"
    """Waiting for the autopilot's HEARTBEAT and what it says of itself."""
    CHECK = "check"
    """Asking for streams, reading parameters, judging them."""
    READY = "ready"
    """Waiting until the autopilot can be armed and the state flows."""
    PROVE = "prove setpoints"
    """Idle setpoints go out, so that the autopilot sees that we are there."""
    ENGAGE = "engage"
    """Asking for OFFBOARD or GUIDED."""
    ARM = "arm"
    """Arming, or waiting for the pilot to."""
    LIFT_OFF = "lift-off"
    """Level attitude, thrust rising until the vehicle leaves the ground. The law's memory is held at zero."""
    CLIMB = "climb"
    """The control law flies from here on: straight up."""
    GO_TO_START = "go to start"
    """To the point where the run-in begins."""
    HOLD = "hold"
    """Standing still; what is left of the error is learnt here."""
    RUN_IN = "run-in"
    """From rest into the trajectory's own velocity."""
    TRACK = "track"
    """The trajectory; what is measured."""
    RUN_OUT = "run-out"
    """From the trajectory's velocity to rest."""
    RETURN = "return"
    """Back to above the place of take-off."""
    LAND = "land"
    """The autopilot is asked to land, and kept level until its own mode shows; then no setpoints go out."""
    WATCH = "watch"
    """Somebody else flies; only the log goes on."""
    DONE = "done"
    """Disarmed."""
