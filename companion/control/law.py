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

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.control.packing import Memory
from companion.control.structs import (
    AdaptationGate,
    ControlLevel,
    Reference,
    StepResult,
    Vector,
    VehicleState,
)

StepKernel = Callable[[np.void, np.void, np.void, np.void, np.void], None]
"""`step(parameters, memory, inputs, memory_out, terms_out)`, compiled; see `packing.py` for the records."""


@dataclass(frozen=True, slots=True)
class ControlLaw:
    """One law with its parameters bound. Made by `build_law`."""

    name: str  # as in the registry
    level: ControlLevel
    seed: int  # draws both input matrices V
    hidden: int  # L, neurons per network
    parameters: np.void  # of parameters_dtype(L), read-only
    kernel: StepKernel
    warnings: tuple[str, ...]  # broken conditions of Propositions 1 and 2, both sides in numbers

    def initial_memory(self) -> Memory:
        """Zero integrals and weights; filters start at the first step's values."""
        raise NotImplementedError

    def warm_up(self) -> None:
        """Compile (or load from the cache) everything a step needs. Seconds the first time; call before arming."""
        raise NotImplementedError

    def step(
        self, memory: Memory, state: VehicleState, reference: Reference, dt_s: float, gate: AdaptationGate
    ) -> StepResult:
        """One control step over `dt_s` seconds since the last. Pure; does not change `memory`.

        Raises FloatingPointError when state, reference or dt_s are not finite or the state is too near the
        Euler singularity: no law may answer that with a setpoint.
        """
        raise NotImplementedError

    def take_over(
        self,
        memory: Memory,
        state: VehicleState,
        reference: Reference,
        thrust_newton: float,
        quaternion: Vector,
    ) -> Memory:
        """Memory from which the next step continues the command (thrust_newton, quaternion (4,) wxyz)."""
        raise NotImplementedError
