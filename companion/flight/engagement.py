"""Engaging a vehicle that hovers under its pilot or its autopilot, without a bump; and a flight that begins so.

PX4 enters OFFBOARD only where setpoints come in, and flies the newest of them from that moment on. So what we send
before is what the vehicle does by itself: its attitude, its heading, and the thrust the autopilot has in use
(ATTITUDE_TARGET). ArduPilot gets nothing before GUIDED shows. The law engages at the state that comes after: it goes on
from that attitude and thrust, along a plan that begins where the vehicle is and as it moves.
"""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np

from companion.autopilot.adapter import Intent
from companion.config.procedure import Procedure
from companion.control.rotation import quaternion_product
from companion.control.structs import Reference, Vector, VehicleState
from companion.flight.control_loop import Activity, ControlLoop, Watching, at_rest, level_with_heading, yaw_of
from companion.flight.fence import require_inside
from companion.flight.flight import Flight, lowest_m
from companion.flight.outcome import HandedBack, Refused, WaitedTooLong
from companion.flight.phases import Phase
from companion.flight.plan import FlightPlan, lay_out_in_air
from companion.flight.supervisor import tilt_of
from companion.flight.vehicle import HANDLED, Vehicle
from companion.mavlink.frames import enu_from_global
from companion.mavlink.link import Message, mav
from companion.mavlink.protocol import request_message
from companion.reference.mission import Mission
from companion.reference.trajectory import Frame, place
from companion.reference.transit import run_out

_ATTITUDE_TARGET: int = mav.MAVLINK_MSG_ID_ATTITUDE_TARGET
_HOME_POSITION: int = mav.MAVLINK_MSG_ID_HOME_POSITION
_RC_CHANNELS: int = mav.MAVLINK_MSG_ID_RC_CHANNELS
ATTITUDE_MEAN_S = 0.04
THRUST_MEAN_S = 1.0
HOME_WAIT_S = 1.5
DESCENT_M_S = 0.3
OLD_S = 0.5  # a position or a thrust that is older says nothing of now
LEAST_ABOVE_GROUND_M = 0.25


class Engagement:
    """How one vehicle hovers by itself, whether it may be engaged now, and the engagement.

    Feed it every message (`take`) and, until it has engaged, every state (`on_state`, which feeds the loop, too).
    """

    def __init__(
        self, vehicle: Vehicle, loop: ControlLoop, procedure: Procedure, home_enu: Vector | None = None
    ) -> None:
        self._vehicle = vehicle
        self._loop = loop
        self._procedure = procedure
        self._axis: Vector | None = None  # mean thrust axis, (3,) world ENU
        self._yaw_rad = 0.0
        self._state_s = self._thrust_s = -math.inf
        self.thrust = math.nan
        """Mean of the thrust that the autopilot has in use, normalised; nan: not told."""
        self.home_enu = home_enu
        """(3,) m, the place of take-off in the local frame; None: not told."""

    def take(self, message: Message) -> None:
        """Take a message: ATTITUDE_TARGET tells the thrust in use, HOME_POSITION the place of take-off."""
        kind = message.get_msgId()
        if kind == _ATTITUDE_TARGET and 0.0 < message.thrust <= 1.0:
            now_s = self._vehicle.link.autopilot_time_s
            share = _share(now_s - self._thrust_s, THRUST_MEAN_S)
            self._thrust_s = now_s
            before = float(message.thrust) if math.isnan(self.thrust) else self.thrust
            self.thrust = before + share * (float(message.thrust) - before)
        elif kind == _HOME_POSITION:
            self.home_enu = self._home_of(message)

    def _home_of(self, message: Message) -> Vector | None:
        """By latitude, longitude and altitude, for ArduPilot leaves x, y and z at 0; by those where there is no origin."""
        origin = self._vehicle.status.global_origin
        if origin is not None and (message.latitude or message.longitude):
            where = message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3
            return enu_from_global(*where, origin)
        local = np.array([message.y, message.x, -message.z], dtype=np.float64)
        return local if np.isfinite(local).all() else self.home_enu

    def on_state(self, state: VehicleState) -> None:
        """Take a state; setpoints that prove us go along with how the vehicle hovers."""
        w, x, y, z = state.quaternion_wxyz.tolist()
        axis = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
        share = _share(state.time_s - self._state_s, ATTITUDE_MEAN_S)
        self._state_s, self._yaw_rad = state.time_s, yaw_of(state.quaternion_wxyz)
        self._axis = axis if self._axis is None else self._axis + share * (axis - self._axis)
        if self._loop.activity is not Activity.NOTHING:
            self.prove()
        self._loop.on_state(state)

    @property
    def quaternion(self) -> Vector:
        """(4,) the mean thrust axis at the newest heading, body FLU to world ENU."""
        if self._axis is None:
            return level_with_heading(self._yaw_rad)
        x, y, z = (self._axis / np.linalg.norm(self._axis)).tolist()
        lean = np.array([1.0 + z, -y, x, 0.0])  # turns world z the short way onto the axis
        return quaternion_product(lean / np.linalg.norm(lean), level_with_heading(self._yaw_rad))

    @property
    def start(self) -> Reference:
        """Where the vehicle is and how it moves by the newest state: where its plan begins."""
        state, zero = self._vehicle.state, np.zeros(3)
        assert state is not None
        yaw_rad = yaw_of(state.quaternion_wxyz)
        return Reference(state.position_enu, state.velocity_enu, zero, zero, zero, yaw_rad, 0.0, 0.0)

    def prove(self) -> None:
        """From here on send setpoints that keep the vehicle as it is: harmless whenever our mode may begin."""
        self._loop.hover(self.quaternion, self.thrust)

    def begin(self, plan: FlightPlan, watching: Watching) -> None:
        """Our mode shows, and `why_not` says nothing: the law takes over at the newest state."""
        state = self._vehicle.state
        assert state is not None
        self.prove()
        self._loop.take_on(plan, state, watching)
        self._vehicle.on_state = self._loop.on_state

    def why_not(self) -> list[str]:
        """What stands against engaging now, in words; empty when nothing does."""
        vehicle, procedure = self._vehicle, self._procedure
        state, status, now_s = vehicle.state, vehicle.status, vehicle.link.autopilot_time_s
        if not status.armed:
            return ["the vehicle is disarmed"]
        if vehicle.on_ground is None:
            return ["the autopilot does not say whether the vehicle flies (EXTENDED_SYS_STATE)"]
        if vehicle.on_ground:
            return ["the vehicle stands on the ground with its motors running"]
        reasons = vehicle.adapter.not_ready(status)
        landing = status.landed_state == mav.MAV_LANDED_STATE_LANDING
        if landing or vehicle.adapter.is_mode(status.custom_mode, Intent.LAND):
            reasons.append("the vehicle is landing")
        elif status.landed_state == mav.MAV_LANDED_STATE_TAKEOFF:
            reasons.append("the vehicle is taking off")
        if not now_s - self._thrust_s <= OLD_S:
            reasons.append("the autopilot does not tell the thrust it hovers with (ATTITUDE_TARGET)")
        if state is None:
            return [*reasons, "no estimate of the position"]
        age_s = now_s - vehicle.assembler.position_time_s
        if not age_s <= OLD_S:
            reasons.append(f"the position is {age_s:.1f} s old")
        speed_m_s = float(np.linalg.norm(state.velocity_enu))
        tilt_deg = math.degrees(tilt_of(state.quaternion_wxyz))
        if not speed_m_s <= procedure.engage_speed_m_s:
            reasons.append(f"speed {speed_m_s:.1f} m/s, limit {procedure.engage_speed_m_s:g} m/s")
        elif state.velocity_enu[2] < -DESCENT_M_S:
            reasons.append(f"it descends at {-state.velocity_enu[2]:.1f} m/s, limit {DESCENT_M_S:g} m/s")
        if not tilt_deg <= procedure.engage_tilt_deg:
            reasons.append(f"tilt {tilt_deg:.0f}°, limit {procedure.engage_tilt_deg:g}°")
        return reasons


def _share(elapsed_s: float, mean_s: float) -> float:
    return -math.expm1(-max(elapsed_s, 0.0) / mean_s)


class FlightFromAir(Flight):
    """A flight of a vehicle that hovers already. Everything after the engagement is as in `Flight`."""

    _engagement: Engagement | None = None
    begins_in_air = True

    def _take_off(self) -> None:
        """In place of a take-off: see that it hovers, prove setpoints where they are wanted, change the mode, engage."""
        vehicle, stage, procedure = self._vehicle, self._stage, self._settings.procedure
        then = self._request.then
        if not vehicle.adapter.has_mode(then):
            raise Refused(f"--then {then.value}: this vehicle has no mode for it; use hold or land")
        engagement = self._meet()
        with suppress(WaitedTooLong):
            vehicle.until(lambda: not engagement.why_not(), OLD_S)
        self._standing_counts = stage.airborne = True
        self._judge_standing()
        plan = self._plan_from_here()
        self._check_plan(plan, stage.ground_m)
        stage.enter(Phase.PROVE)
        if vehicle.adapter.wants_setpoints_first:
            engagement.prove()
        started_s, proven_s = vehicle.link.autopilot_time_s, procedure.prove_s
        vehicle.until(lambda: vehicle.link.autopilot_time_s - started_s >= proven_s)
        stage.enter(Phase.ENGAGE)
        self._engage()
        self._judge_standing()
        self._begin()

    def _meet(self) -> Engagement:
        """Watch how the vehicle hovers, and learn where it took off."""
        vehicle = self._vehicle
        engagement = self._watch_hover()
        vehicle.commands.send(request_message(_HOME_POSITION))
        with suppress(WaitedTooLong):
            vehicle.until(lambda: engagement.home_enu is not None, HOME_WAIT_S)
        if engagement.home_enu is None:
            assert vehicle.state is not None
            x, y, _ = vehicle.state.position_enu.tolist()
            engagement.home_enu = np.array([x, y, 0.0])
            text = (
                "the autopilot tells no HOME_POSITION: the fence lies about where the vehicle is now, and heights are "
                "counted from 0 of the local frame"
            )
            self._reporter.say(text)
            self._recorder.log.event("warning", vehicle.link.autopilot_time_s, text=text)
        self._stage.ground_m = float(engagement.home_enu[2])
        return engagement

    def _watch_hover(self, home_enu: Vector | None = None) -> Engagement:
        vehicle = self._vehicle
        vehicle.link.wanted = HANDLED | {_RC_CHANNELS, _ATTITUDE_TARGET, _HOME_POSITION}
        engagement = Engagement(vehicle, self._loop, self._settings.procedure, home_enu)
        self._engagement, vehicle.on_state = engagement, engagement.on_state
        return engagement

    def _begin(self) -> None:
        """The law takes over at the newest state."""
        vehicle, stage, engagement = self._vehicle, self._stage, self._engagement
        assert engagement is not None and engagement.home_enu is not None
        self._armed_by_now = vehicle.taken_off = True
        vehicle.link.look_out(False)
        plan = stage.plan = self._plan_from_here()
        watching = self._watch_over(at_rest(engagement.home_enu, engagement.start.yaw_rad))
        engagement.begin(plan, watching)
        vehicle.link.wanted = HANDLED | {_RC_CHANNELS}
        text = f"engaged at thrust {self._loop.hover_thrust:.2f}; flying {plan.duration_s:.0f} s"
        self._recorder.log.event("engaged", vehicle.link.autopilot_time_s, text=text)
        self._reporter.say(text)
        self._announce(plan)

    def _on_message(self, message: Message) -> None:
        if self._engagement is not None:
            self._engagement.take(message)
        super()._on_message(message)

    def _plan_from_here(self) -> FlightPlan:
        """The plan from the newest state, as it moves; a placed trajectory begins at the height where it comes to rest.

        Raises:
            Refused: it leaves the fence, or comes too low.
        """
        request, engagement, ground_m = self._request, self._engagement, self._stage.ground_m
        assert engagement is not None and engagement.home_enu is not None
        limits = self._transit_limits(ground_m)
        stop = run_out(engagement.start, limits)
        rest = stop.sample(stop.duration_s)
        home = self._home = at_rest(engagement.home_enu, rest.yaw_rad)
        if self._live is not None:
            self._live.wait_at(rest, ground_m)
        if isinstance(request.trajectory, Mission):
            trajectory = self._located(request.trajectory, home)
        else:
            origin = rest.position_enu.copy()
            if request.frame is not Frame.LOCAL:
                origin[2] -= float(request.trajectory.sample(0.0).position_enu[2])
            trajectory = place(request.trajectory, request.frame, origin, rest.yaw_rad)
        plan = lay_out_in_air(stop, trajectory, self._tracked_s, self._settings.procedure.hold_s, limits)
        least_m = max(LEAST_ABOVE_GROUND_M, self._vehicle.status.height_accuracy_m or 0.0)
        height_m = lowest_m(trajectory, request.duration_s) - ground_m
        if height_m < least_m:
            raise Refused(
                f"the trajectory comes down to {height_m:.2f} m, least {least_m:.2f} m: begin higher"
            )
        require_inside(self._settings.safety, plan, engagement.home_enu)
        return plan

    def _judge_standing(self) -> None:
        """Until we engage: only a vehicle that hovers is taken over.

        Raises:
            HandedBack: it is in our mode, because we asked for it or flies on our setpoints.
            Refused: it is not.
        """
        engagement, vehicle = self._engagement, self._vehicle
        assert engagement is not None
        if not (reasons := engagement.why_not()):
            return
        text = f"not engaged: {', '.join(reasons)}"
        ours = self._stage.phase is Phase.ENGAGE or self._loop.activity is not Activity.NOTHING
        if ours and vehicle.is_ours and vehicle.status.armed and vehicle.on_ground is not True:
            self._stage.engaged = True
            raise HandedBack(text)
        raise Refused(text)
