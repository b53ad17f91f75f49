"""A flight whose trajectory is told while it is flown: waiting for it, following it, and leaving it."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from companion.config.settings import FlightSettings
from companion.control.structs import Reference, Vector
from companion.flight.control_loop import ControlLoop, yaw_of
from companion.flight.live_bounds import bounds_of
from companion.flight.outcome import Aborted, HandedBack
from companion.flight.phases import Phase
from companion.flight.plan import FlightPlan, Leg, way_back
from companion.flight.stage import Stage
from companion.flightlog.channels import LIVE_SAMPLED
from companion.live.follower import LOOK_AHEAD_S, stop_limits
from companion.live.heard import Heard
from companion.live.mavlink_points import Surroundings
from companion.live.trajectory import Beginning, LiveTrajectory
from companion.reference.trajectory import Frame, resting
from companion.reference.transit import TransitLimits

BEYOND_END_S = 0.5
"""How much longer than asked the tracking is laid out: the law looks ahead, and the way back is planned at its end."""


class LiveReferences:
    """What a flight does with references from another program."""

    def __init__(self, stage: Stage, settings: FlightSettings, live: LiveTrajectory, frame: Frame) -> None:
        """Nothing is listened to before `hear`. `frame`: where the trajectory's own axes lie."""
        self._stage = stage
        self._settings = settings
        self._live = live
        self._frame = frame
        self._tracking = False
        self._left = False
        self._sampled = stage.recorder.log.define(LIVE_SAMPLED)
        live.on_heard = self._log_heard
        live.on_sampled = self._log_sampled

    def wait_at(self, rest: Reference, home_m: float) -> None:
        """Where to wait for the first point, local ENU; heights of own axes count from `home_m`, that of the take-off."""
        if self._frame is Frame.TAKEOFF:
            self._live.stand_at(np.array([0.0, 0.0, float(rest.position_enu[2]) - home_m]), 0.0)
        else:
            self._live.stand_at(rest.position_enu, rest.yaw_rad)

    def begin(self, leg: Leg, loop: ControlLoop, ground: Reference, limits: TransitLimits) -> None:
        """Tracking begins: follow what comes."""
        vehicle, live = self._stage.vehicle, self._live
        assert vehicle.state is not None
        accuracy_m = vehicle.status.height_accuracy_m or 0.0
        bounds = bounds_of(self._settings.safety, loop.law, leg.trajectory, ground.position_enu, accuracy_m)
        beginning = Beginning(
            vehicle.state.time_s - (loop.plan_time_s - leg.start_s),
            vehicle.state.time_s + LOOK_AHEAD_S,
            limits,
            self._settings.live.silence_s,
            bounds,
        )
        self._stage.recorder.log.event(
            "live",
            vehicle.link.autopilot_time_s,
            text="tracking begins",
            started_s=beginning.started_s,
            now_s=beginning.now_s,
            limits=asdict(limits),
            silence_s=beginning.silence_s,
            bounds=bounds.as_fields(),
            start=[*live.start.position_enu.tolist(), live.start.yaw_rad],
            mavlink=live.is_mavlink,
        )
        self._tracking = True
        live.begin(beginning)

    def hear(self) -> None:
        """Take in what has arrived; called again and again.

        Raises:
            Aborted, HandedBack: the client has been silent for too long (`flight.live.lost`).
        """
        if self._left or self._stage.loop is None:  # not before it is known what is flown
            return
        live, now_s = self._live, self._stage.vehicle.link.autopilot_time_s
        live.hear(now_s, self._surroundings)
        while live.notices:
            text = live.notices.popleft()
            self._stage.reporter.say(text)
            self._stage.recorder.log.event("live", now_s, text=text)
        silent_s = live.silent_s(now_s)
        if self._tracking and not live.ended and silent_s > self._settings.live.lost_s:
            ends = HandedBack if self._settings.live.lost == "hand_back" else Aborted
            raise ends(f"references: none for {silent_s:.1f} s (flight.live.lost_s)")

    def is_over(self, leg: Leg, loop: ControlLoop, duration_s: float) -> bool:
        """Whether the client has ended it, or the time to track is over."""
        now_s = self._stage.vehicle.link.autopilot_time_s
        return self._live.is_over(now_s) or loop.plan_time_s >= leg.start_s + duration_s

    def leave(self, plan: FlightPlan, leg: Leg, limits: TransitLimits) -> None:
        """Plan the way back from where the vehicle is, from the first moment that the law has not looked at."""
        self._left = True
        cut_s = self._live.latest_s
        now = leg.trajectory.sample(cut_s)
        plan.change_from(
            leg.start_s + cut_s, way_back(now, self._above_home(plan), limits, stop_limits(limits))
        )

    def tell(self) -> None:
        """The counters, at the end."""
        counters = self._live.counters
        counts = ", ".join(f"{count} {what}" for what, count in sorted(counters.items()) if count)
        self._stage.reporter.say(f"references: {counts or 'none came'}")
        self._stage.recorder.log.metadata("wall references", dict(counters))

    def _above_home(self, plan: FlightPlan) -> Reference:
        back = plan.leg(Phase.RETURN)
        end = back.trajectory.sample(back.duration_s)
        return resting(end.position_enu, end.yaw_rad)

    def _surroundings(self) -> tuple[Surroundings, Vector, float]:
        vehicle, loop = self._stage.vehicle, self._stage.loop
        assert loop is not None
        state = vehicle.state
        around = Surroundings(
            state.position_enu if state is not None else None,
            yaw_of(state.quaternion_wxyz) if state is not None else 0.0,
            vehicle.status.global_origin,
            self._stage.ground_m,
            vehicle.link.target_system,
            vehicle.adapter.profile_key == "px4",
        )
        if self._frame is Frame.TAKEOFF:
            return around, np.zeros(3), 0.0
        return around, *loop.moved

    def _log_heard(self, heard: Heard) -> None:
        self._stage.recorder.log.live_reference(heard.time_s, heard.numbers(), heard.data)

    def _log_sampled(self, time_s: float, checksum: int) -> None:
        now_s = self._stage.vehicle.link.autopilot_time_s
        self._stage.recorder.log.record(self._sampled, now_s, time_s, float(checksum))
