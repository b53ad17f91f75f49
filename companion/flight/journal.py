"""What is told and written down on the way: the autopilot's words, its modes, and every second how things stand."""

from __future__ import annotations

import math

import numpy as np

from companion.config.safety import SafetyLimits
from companion.flight.sources import Blind, blind
from companion.flight.stage import Stage
from companion.flight.supervisor import Supervisor
from companion.mavlink.link import Message, mav

PROGRESS_S = 1.0
_STATUSTEXT: int = mav.MAVLINK_MSG_ID_STATUSTEXT
_COMMAND_ACK: int = mav.MAVLINK_MSG_ID_COMMAND_ACK


class Journal:
    """Takes every message of the autopilot; log and reporter are the stage's."""

    def __init__(self, stage: Stage, connect_timeout_s: float, limits: SafetyLimits) -> None:
        self._stage = stage
        self._limits = limits
        self._blind: list[Blind] = []
        self._connect_timeout_s = connect_timeout_s
        self._mode = -1  # announced last
        self._armed = False
        self._next_progress_s = -math.inf
        self._next_waiting_s = PROGRESS_S
        self.supervisor: Supervisor | None = None
        """Is shown how the log does; none before lift-off."""

    def take(self, message: Message) -> None:
        """Write down what one message says, and once a second how things stand."""
        stage, vehicle = self._stage, self._stage.vehicle
        log, status, now_s = stage.recorder.log, vehicle.status, vehicle.link.autopilot_time_s
        kind = message.get_msgId()
        if kind == vehicle.adapter.truth_message_id:
            stage.recorder.truth(message, status, now_s)
        elif kind == _STATUSTEXT:
            log.event("status_text", now_s, severity=message.severity, text=str(message.text))
            if message.severity <= mav.MAV_SEVERITY_WARNING:
                stage.reporter.say(f"autopilot: {message.text}")
        elif kind == _COMMAND_ACK:
            log.event("ack", now_s, command=message.command, result=message.result)
        if status.custom_mode != self._mode:
            self._mode = status.custom_mode
            log.event("mode", now_s, mode=vehicle.adapter.mode_name(status.custom_mode))
        if status.armed != self._armed:
            self._armed = status.armed
            log.event("armed", now_s, armed=status.armed)
        if now_s >= self._next_progress_s:
            self._next_progress_s = now_s + PROGRESS_S
            self._tell_progress()

    def waiting(self, waited_s: float) -> None:
        """Nobody has been heard for `waited_s` of our time."""
        if waited_s >= self._next_waiting_s:
            self._next_waiting_s = waited_s + PROGRESS_S
            self._stage.reporter.progress(
                self._stage.phase, waited_s, self._connect_timeout_s, "waiting for an autopilot's HEARTBEAT"
            )

    def _tell_progress(self) -> None:
        stage, link = self._stage, self._stage.vehicle.link
        loop, plan = stage.loop, stage.plan
        if stage.airborne and plan is not None and loop is not None and stage.engaged:
            error_m = float(np.linalg.norm(loop.position_error_enu))
            text = f"error {error_m * 100:.1f} cm"
            stage.reporter.progress(stage.phase, loop.plan_time_s, plan.duration_s, text)
        if self.supervisor is not None:
            self.supervisor.log_health = log_health = stage.recorder.log.health
            assert log_health is not None
        if self.supervisor is not None:
            self._tell_what_is_not_known()
        streams = link.streams.figures()
        stage.recorder.streams(link.autopilot_time_s, streams)
        if loop is not None:
            loop.note_link(streams, link.timesync)
            stage.recorder.estimates(
                link.autopilot_time_s,
                loop.hover_thrust,
                link.timesync.offset_s,
                link.timesync.round_trip_s,
                loop.state_delay_s,
                stage.vehicle.status,
            )

    def _tell_what_is_not_known(self) -> None:
        """From lift-off on: what is blind now, and what is heard again, once each."""
        stage, before = self._stage, self._blind
        vehicle, link = stage.vehicle, stage.vehicle.link
        now = blind(vehicle.adapter, vehicle.status, link.timesync, self._limits, link.autopilot_time_s)
        self._blind = now
        for item in now:
            if item not in before:
                stage.reporter.say(f"blind: {item}")
                stage.recorder.log.event("blind", link.autopilot_time_s, active=True, text=str(item))
        for item in before:
            if item.source not in [other.source for other in now]:
                stage.reporter.say(f"{item.source.message} tells again")
                stage.recorder.log.event("blind", link.autopilot_time_s, active=False, text=str(item))
