"""A control law, ready to fly: built once, warmed up before arming, then one pure `step` per state.

    law = build_law("dtlannc", gains, profile, ControlLevel.ATTITUDE, seed=1)    # registry.py
    law.warm_up()
    memory = law.initial_memory()
    memory = law.take_over(memory, state, reference, thrust_newton, quaternion_wxyz)   # bumpless
    while flying:
        result = law.step(memory, state, reference, dt_s, AdaptationGate.RUN)
        memory = result.memory

`step` neither reads a clock nor keeps anything: the same arguments give the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.control.bounds import NOT_FINITE, TOO_TILTED
from companion.control.cascade import position_network
from companion.control.flatness import force_from_euler
from companion.control.packing import INPUT, TERMS, Memory, Terms, memory_dtype
from companion.control.rotation import euler_from_quaternion, wrap_angle
from companion.control.structs import (
    AdaptationGate,
    ControlLevel,
    Packed,
    Record,
    Reference,
    Setpoint,
    Vector,
    VehicleState,
)

StepKernel = Callable[[Packed, Packed, Packed, Packed, Packed], None]
"""`step(parameters, memory, inputs, memory_out, terms_out)`, compiled; see `packing.py` for the records."""

_TERMS_SIZE = TERMS.itemsize // 8


def _place_in_terms(name: str, width: int) -> slice:
    """Where a field lies among the float64 numbers of `TERMS`."""
    first = TERMS.fields[name][1] // 8  # type: ignore[index]
    return slice(first, first + width)


_THRUST, _FLAGS = _place_in_terms("thrust", 1).start, _place_in_terms("bounds", 1).start
_QUATERNION = _place_in_terms("quaternion", 4)
_BODY_RATE, _TORQUE = _place_in_terms("body_rate", 3), _place_in_terms("torque", 3)


@dataclass(frozen=True, slots=True)
class StepResult:
    """What one step of a law gives back."""

    memory: Memory  # for the next step
    setpoint: Setpoint  # for the autopilot
    terms: Terms  # for the log


class StepRefused(ArithmeticError):
    """No law may answer this state with a setpoint; the message says why. Hand the vehicle back."""


def pack_input(
    state: VehicleState,
    reference: Reference,
    dt_s: float,
    gate: AdaptationGate,
    thrust_bounds_newton: tuple[float, float],
) -> Vector:
    """All that a step depends on beside the memory, as float64 (n,) in the layout `packing.INPUT`.

    `thrust_bounds_newton` are the least and the greatest F that can be sent: `ThrustScale.bounds_newton`, or
    `ControlLaw.thrust_bounds_newton`.
    """
    return np.concatenate(
        (
            state.position_enu,
            state.velocity_enu,
            state.quaternion_wxyz,
            state.body_rate_flu,
            reference.position_enu,
            reference.velocity_enu,
            reference.acceleration_enu,
            reference.jerk_enu,
            reference.snap_enu,
            (
                reference.yaw_rad,
                reference.yaw_rate_rad_s,
                reference.yaw_acceleration_rad_s2,
                dt_s,
                float(gate),
                *thrust_bounds_newton,
                state.time_s,
            ),
        ),
        dtype=np.float64,
    )


@dataclass(frozen=True, slots=True)
class ControlLaw:
    """One law with its parameters bound. Made by `build_law`."""

    name: str  # as in the registry
    level: ControlLevel
    seed: int  # draws both input matrices V
    hidden: int  # L, neurons per network
    packed_parameters: Packed  # (1,) of parameters_dtype(L)
    kernel: StepKernel
    warnings: tuple[str, ...]  # broken conditions of Propositions 1 and 2, both sides in numbers

    @property
    def parameters(self) -> Record:
        """The fields of `parameters_dtype` by name."""
        return self.packed_parameters[0]

    @property
    def thrust_bounds_newton(self) -> tuple[float, float]:
        """Bounds on F by the profile, N: in force where rotor thrusts are sent, or no thrust scale is known."""
        return float(self.parameters.thrust_min), float(self.parameters.thrust_max)

    def initial_memory(self) -> Memory:
        """Zero integrals and weights; filters start at the first step's values."""
        return Memory(np.zeros(1, memory_dtype(self.hidden)))

    def warm_up(self) -> None:
        """Compile (or load from the cache) all that a step needs: seconds the first time. Call before arming."""
        still = np.zeros(3)
        level = np.array([1.0, 0.0, 0.0, 0.0])
        state = VehicleState(0.0, still, still, level, still)
        reference = Reference(still, still, still, still, still, 0.0, 0.0, 0.0)
        memory = self.take_over(self.initial_memory(), state, reference, 1.0, level)
        self.step(memory, state, reference, 0.01, AdaptationGate.RUN)

    def step(
        self, memory: Memory, state: VehicleState, reference: Reference, dt_s: float, gate: AdaptationGate
    ) -> StepResult:
        """One control step over the `dt_s` seconds since the last, within the profile's thrust. Pure; keeps `memory`.

        Raises StepRefused when state, reference or dt_s are not finite, dt_s is negative, the quaternion is not of
        unit length, or the vehicle is tilted beyond `limits.tilt_abort_deg`.
        """
        return self.step_packed(memory, pack_input(state, reference, dt_s, gate, self.thrust_bounds_newton))

    def step_packed(self, memory: Memory, inputs: Vector) -> StepResult:
        """`step` on inputs as `pack_input` made them and the log holds them: replay gives the same bits."""
        # Records over plain numbers: to make one, to fill it field by field or to view it takes longer than the step.
        before, numbers = memory.packed, np.zeros(_TERMS_SIZE)
        following = np.ndarray((1,), before.dtype, np.empty(before.nbytes // 8))
        terms = np.ndarray((1,), TERMS, numbers)
        self.kernel(self.packed_parameters, before, np.ndarray((1,), INPUT, inputs), following, terms)
        flags = int(numbers.view(np.int64)[_FLAGS])
        if flags & (NOT_FINITE | TOO_TILTED):
            raise StepRefused(self._refusal(flags, terms[0]))
        setpoint = Setpoint(
            self.level, float(numbers[_THRUST]), numbers[_QUATERNION], numbers[_BODY_RATE], numbers[_TORQUE]
        )
        return StepResult(Memory(following), setpoint, Terms(terms))

    def take_over(
        self,
        memory: Memory,
        state: VehicleState,
        reference: Reference,
        thrust_newton: float,
        quaternion: Vector,
    ) -> Memory:
        """Memory from which the next step continues the command (thrust_newton, attitude (4,) wxyz body to world).

        What the law would do otherwise is made up by an added force and yaw, which fade. The vertical part is weight
        that m̂ does not know of, and stays: it goes into the integral, or into the network where the law has no
        integral. Raises StepRefused as `step` does.
        """
        packed = memory.packed.copy()
        fresh = packed[0]
        for name in ("hand_over_force", "filter_angle", "filter_rate", "feedback_rate", "wrench"):
            fresh[name] = 0.0
        fresh["hand_over_yaw"] = fresh["started"] = 0.0
        terms = self.step(Memory(packed), state, reference, 0.0, AdaptationGate.FREEZE).terms.values
        given = euler_from_quaternion(np.asarray(quaternion, dtype=np.float64))
        p = self.parameters
        led = np.zeros(3)
        if self.level is ControlLevel.ATTITUDE:
            led = p.attitude_lead * terms.flat_euler_rate + p.attitude_lead_2 * terms.flat_euler_acceleration
        fresh["hand_over_yaw"] = wrap_angle(given[2] - led[2] - reference.yaw_rad)
        # once more: the network sees the yaw against the one that is now desired
        terms = self.step(Memory(packed), state, reference, 0.0, AdaptationGate.FREEZE).terms.values
        feedback_lead = terms.feedback_lead_force if self.level is ControlLevel.ATTITUDE else np.zeros(3)
        force_z = thrust_newton * math.cos(terms.euler[0]) * math.cos(terms.euler[1])
        wanted = force_from_euler(given - led, max(force_z, float(p.force_z_min)))
        missing = wanted - feedback_lead - terms.position.total
        inputs = pack_input(state, reference, 0.0, AdaptationGate.FREEZE, self.thrust_bounds_newton)
        missing[2] -= self._keep_vertical(fresh, missing[2], inputs.view(INPUT)[0], terms)
        fresh["hand_over_force"] = missing
        return Memory(packed)

    def _keep_vertical(self, fresh: Record, newton: float, inputs: Record, terms: Record) -> float:
        """Put a vertical force into what `fresh` remembers; how much of it found room within the bounds, N."""
        g = self.parameters.position
        xi, W = fresh["position_integral"], fresh["position_weights"]
        if g.K_i[2] > 0.0:
            room = math.sqrt(
                max(0.0, float(g.integral_bound) ** 2 - float(np.sum((g.K_i[:2] * xi[:2]) ** 2)))
            )
            held = float(g.K_i[2] * xi[2])
            kept = min(room, max(-room, held + newton)) - held
            xi[2] += kept / float(g.K_i[2])
            return kept
        if g.N > 0.0:
            sigma = position_network(self.parameters, fresh, inputs, terms)
            change = (
                sigma * newton / float(sigma @ sigma)
            )  # the smallest change of Ŵ that gives this force now
            if (
                float(np.sum(W**2) - np.sum(W[:, 2] ** 2) + np.sum((W[:, 2] + change) ** 2))
                < g.weight_bound**2
            ):
                W[:, 2] += change
                return newton
        return 0.0

    def _refusal(self, flags: int, terms: Record) -> str:
        if flags & NOT_FINITE:
            return "the state, the reference or the time step is not a finite, sensible number"
        roll, pitch = math.degrees(terms.euler[0]), math.degrees(terms.euler[1])
        limit = math.degrees(self.parameters.tilt_abort)
        return f"the vehicle is tilted beyond limits.tilt_abort_deg = {limit:.0f}: roll {roll:.0f}°, pitch {pitch:.0f}°"
