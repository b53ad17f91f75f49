"""The packed records that cross into machine code, and the frozen values that wrap them.

A control step takes and gives five records of plain float64 and int64 fields. Being NumPy records, one
definition serves as the layout in machine code (`parameters.position.K_U[i]`), as the layout in Python,
and as the layout in the log: `dtype.names` says what is in it.

| record | holds | made |
|---|---|---|
| `parameters_dtype(L)` | gains, vehicle, bounds, both input matrices V | once, by `build_law` |
| `memory_dtype(L)` | integrals, output weights Ŵ, filters, hand-over | every step, a new one |
| `INPUT` | state, reference, time step, gate | every step |
| `TERMS` | every term of the law, the output among them | every step |

Units are SI, frames ENU/FLU, angles rad. The position loop and the attitude loop are the same
mathematics, so they share `LOOP_GAINS` and `LOOP_TERMS`: in m, m/s and N on one side, in rad, rad/s
and N·m on the other.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from companion.control.structs import Packed, Record, Vector

FEATURES = 10
"""Length of both networks' inputs γ: 1 + three 3-vectors. Eqs. (11), (26)."""

LOOP_GAINS = np.dtype(
    (
        np.record,
        [
            ("K_e", "f8", (3,)),  # outer gain K_p or K_η, 1/s. Eqs. (2), (21)
            ("K_U", "f8", (3,)),  # inner gain, N·s/m or N·m·s. Eqs. (13), (27)
            ("K_i", "f8", (3,)),  # integral gain, N/m or N·m. Eqs. (13), (27)
            ("alpha", "f8"),  # sign term, N or N·m. Eqs. (14), (28)
            ("boundary_width", "f8"),  # width of tanh(Ũ/width), m/s or rad/s; 0 is the exact sign
            ("N", "f8"),  # adaptation gain. Eqs. (15), (29)
            ("kappa", "f8"),  # leak. Eqs. (15), (29)
            ("weight_bound", "f8"),  # W_max: bound on the Frobenius norm of Ŵ, N or N·m
            ("integral_bound", "f8"),  # bound on ‖K_i ξ‖, N or N·m
        ],
    )
)

MAX_ROTORS = 8


@functools.cache
def parameters_dtype(hidden: int) -> np.dtype[np.void]:
    """Layout of what a law is built with, for networks with `hidden` neurons."""
    return np.dtype(
        (
            np.record,
            [
                ("position", LOOP_GAINS),
                ("attitude", LOOP_GAINS),
                ("position_V", "f8", (FEATURES, hidden)),  # input matrix of the position network
                ("attitude_V", "f8", (FEATURES, hidden)),  # input matrix of the attitude network
                ("level", "i8"),  # 0 attitude, 1 body rate, 2 actuator
                ("gravity", "f8"),  # m/s²
                ("mass_estimate", "f8"),  # m̂, kg
                ("inertia", "f8", (3,)),  # diagonal of I, kg·m²
                ("drag", "f8", (3,)),  # diagonal of D_p, kg/s
                ("rotational_drag", "f8", (3,)),  # diagonal of D_η, kg·m²/s
                ("rotor_count", "i8"),
                ("allocation", "f8", (4, MAX_ROTORS)),  # B: rotor thrusts to [F, τ]
                ("mixer", "f8", (MAX_ROTORS, 4)),  # its pseudo-inverse
                ("rotor_thrust_min", "f8"),  # N, each rotor
                ("rotor_thrust_max", "f8"),  # N, each rotor
                (
                    "thrust_min",
                    "f8",
                ),  # bounds on F by the profile, N; in flight those of `INPUT` are in force
                ("thrust_max", "f8"),
                ("force_z_min", "f8"),  # floor under f_z, N; keeps (17), (18) defined
                ("tilt_max", "f8"),  # bound on the desired tilt, rad
                ("tilt_abort", "f8"),  # a vehicle tilted further is refused, rad
                ("body_rate_max", "f8", (3,)),  # rad/s
                ("filter_frequency", "f8"),  # command filter on η_d, rad/s
                ("filter_damping", "f8"),
                ("attitude_lead", "f8", (3,)),  # s, on η̇ of the flat attitude, added to the attitude setpoint
                ("attitude_lead_2", "f8", (3,)),  # s², on its η̈
                ("feedback_lead", "f8"),  # s, on the derivative of the feedback force, attitude level
                ("feedback_lead_filter", "f8"),  # s, time constant of that derivative's low-pass
                ("rate_lead", "f8", (3,)),  # s, on the desired angular acceleration, body-rate level
                (
                    "rotor_lead",
                    "f8",
                ),  # s, on thrust and torque: the rotors' own lag, or the share of it made up for
                ("rotor_lead_filter", "f8"),  # s, low-pass of that lead
                ("model_in_feedback", "f8"),  # 1 where the model term holds U̇_p and with it K_p ė_p
                ("hand_over_time", "f8"),  # s, time constant with which a hand-over fades
                ("beta", "f8", (2,)),  # β_p, β_η of the Lyapunov functions (20), (32)
            ],
        )
    )


LOOP_TERMS = np.dtype(
    (
        np.record,
        [
            ("error", "f8", (3,)),  # e_p (m) or e_η (rad, yaw wrapped). Eqs. (2), (21)
            ("error_rate", "f8", (3,)),  # ė, m/s or rad/s
            ("U", "f8", (3,)),  # virtual control U, m/s or rad/s
            ("U_error", "f8", (3,)),  # Ũ, m/s or rad/s
            ("U_rate", "f8", (3,)),  # U̇, m/s² or rad/s²
            ("integral", "f8", (3,)),  # ξ before this step's integration, m or rad
            ("proportional_term", "f8", (3,)),  # K_U Ũ, N or N·m (all terms below too)
            ("integral_term", "f8", (3,)),  # K_i ξ
            ("model_term", "f8", (3,)),  # what the law knows of the plant: m̂(p̈_d + g e₃) and the like
            ("network_term", "f8", (3,)),  # Ŵᵀσ
            ("sign_term", "f8", (3,)),  # α sign(Ũ), smoothed
            ("total", "f8", (3,)),  # f (N), or the bracket of Eq. (27) before Φᵀ (N·m)
            ("weight_norm", "f8"),  # ‖Ŵ‖_F before this step's adaptation
            ("lyapunov", "f8"),  # V of (20) or (32) without its unknown part; see `lyapunov.py`
        ],
    )
)

TERMS = np.dtype(
    (
        np.record,
        [
            ("position", LOOP_TERMS),
            ("attitude", LOOP_TERMS),
            ("hand_over_force", "f8", (3,)),  # what is left of the bumpless hand-over, N
            ("force", "f8", (3,)),  # f as used for thrust, after bounds, N
            ("euler", "f8", (3,)),  # η, rad
            ("euler_rate", "f8", (3,)),  # η̇ = Φ ω, rad/s
            ("euler_desired", "f8", (3,)),  # η_d = [φ_d, θ_d, ψ_d] of Eqs. (17), (18), rad
            ("euler_rate_desired", "f8", (3,)),  # η̇_d: flatness + command filter, rad/s
            ("euler_acceleration_desired", "f8", (3,)),  # η̈_d, rad/s²
            ("flat_euler", "f8", (3,)),  # the reference's own attitude (differential flatness), rad
            ("flat_euler_rate", "f8", (3,)),  # and its rate, rad/s
            ("flat_euler_acceleration", "f8", (3,)),  # and its acceleration, rad/s²
            (
                "feedback_lead_force",
                "f8",
                (3,),
            ),  # lead on the feedback, added to f for the attitude setpoint, N
            ("euler_setpoint", "f8", (3,)),  # η_d with lead: what is sent at the attitude level, rad
            ("thrust_wanted", "f8"),  # F of Eq. (16), N
            ("thrust", "f8"),  # F with rotor lead, after bounds, N
            ("quaternion", "f8", (4,)),  # `euler_setpoint` as a quaternion, body to world
            ("body_rate", "f8", (3,)),  # desired body rate with lead, FLU, rad/s
            ("torque_wanted", "f8", (3,)),  # τ of Eq. (27), N·m
            ("torque", "f8", (3,)),  # τ with rotor lead, as the rotors can give it with this thrust, N·m
            ("rotor_thrust", "f8", (MAX_ROTORS,)),  # allocation, N; unused entries are 0
            ("bounds", "i8"),  # bits of `Bound`: which bounds are active. Last, the only integer
        ],
    )
)

INPUT = np.dtype(
    (
        np.record,
        [
            ("position", "f8", (3,)),
            ("velocity", "f8", (3,)),
            ("quaternion", "f8", (4,)),
            ("body_rate", "f8", (3,)),
            ("reference_position", "f8", (3,)),
            ("reference_velocity", "f8", (3,)),
            ("reference_acceleration", "f8", (3,)),
            ("reference_jerk", "f8", (3,)),
            ("reference_snap", "f8", (3,)),
            ("reference_yaw", "f8"),
            ("reference_yaw_rate", "f8"),
            ("reference_yaw_acceleration", "f8"),
            ("dt", "f8"),
            ("gate", "f8"),  # an `AdaptationGate`, as a number
            ("thrust_min", "f8"),  # bounds on F by the thrust scale in force, N
            ("thrust_max", "f8"),
            (
                "time",
                "f8",
            ),  # autopilot's clock: when state and reference hold, and η_d is wanted; for the log, s
        ],
    )
)


@functools.cache
def memory_dtype(hidden: int) -> np.dtype[np.void]:
    """Layout of a law's memory for networks with `hidden` neurons."""
    return np.dtype(
        (
            np.record,
            [
                ("position_integral", "f8", (3,)),  # ξ_p, m
                ("position_weights", "f8", (hidden, 3)),  # Ŵ_p, N
                ("attitude_integral", "f8", (3,)),  # ξ_η, rad
                ("attitude_weights", "f8", (hidden, 3)),  # Ŵ_η, N·m
                ("filter_angle", "f8", (3,)),  # command filter on η_d less its flat part, rad
                ("filter_rate", "f8", (3,)),  # and its rate, rad/s
                ("feedback_rate", "f8", (3,)),  # filtered derivative of the feedback force, N/s
                ("wrench", "f8", (4,)),  # low-passed [F, τ] behind the rotor lead, N and N·m
                ("hand_over_force", "f8", (3,)),  # fading remainder of a hand-over, N
                ("hand_over_yaw", "f8"),  # fading remainder of a hand-over, rad
                ("started", "f8"),  # 0 until the first step has set the filters
            ],
        )
    )


@dataclass(frozen=True, slots=True)
class Memory:
    """All that a law remembers between steps. A step reads one and returns a new one; nobody writes in it."""

    packed: Packed  # (1,) of memory_dtype(L)

    @property
    def values(self) -> Record:
        """The fields of `memory_dtype` by name."""
        return self.packed[0]

    @property
    def position_integral(self) -> Vector:
        """ξ_p, (3,), m."""
        return self.packed["position_integral"][0]  # type: ignore[no-any-return]

    @property
    def attitude_integral(self) -> Vector:
        """ξ_η, (3,), rad."""
        return self.packed["attitude_integral"][0]  # type: ignore[no-any-return]

    @property
    def position_weights(self) -> Vector:
        """Ŵ_p, (L, 3), N."""
        return self.packed["position_weights"][0]  # type: ignore[no-any-return]

    @property
    def attitude_weights(self) -> Vector:
        """Ŵ_η, (L, 3), N·m."""
        return self.packed["attitude_weights"][0]  # type: ignore[no-any-return]

    def to_array(self) -> Vector:
        """Everything as one float64 vector, for the log."""
        return np.frombuffer(self.packed.tobytes(), dtype=np.float64)

    @classmethod
    def from_array(cls, array: Vector, hidden: int) -> Memory:
        """The inverse of `to_array`, bit by bit. Raises ValueError where the length does not fit `hidden`."""
        return cls(np.array(array, dtype=np.float64).view(memory_dtype(hidden)))


@dataclass(frozen=True, slots=True)
class Terms:
    """Every term of the law in one step. Fields by name as in `TERMS`, e.g. `terms.values.position.error`."""

    packed: Packed  # (1,) of TERMS

    @property
    def values(self) -> Record:
        """The fields of `TERMS` by name."""
        return self.packed[0]

    @property
    def flags(self) -> int:
        """Active bounds, bits of `companion.control.bounds.Bound`."""
        return int(self.packed["bounds"][0])

    def flat(self) -> dict[str, Vector | float]:
        """All fields by dotted name (`position.error`, `thrust`), for the log."""
        out: dict[str, Vector | float] = {}
        for name in TERMS.names or ():
            value = self.packed[name][0]
            if isinstance(value, np.void):
                for inner in LOOP_TERMS.names or ():
                    out[f"{name}.{inner}"] = value[inner]
            else:
                out[name] = value
        return out
