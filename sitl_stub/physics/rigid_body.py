"""The vehicle's motion, `advance`: six degrees of freedom, rotors with lag, drag, ground effect, battery.

Rigid body (NED/FRD, q from body to world, T_i rotor thrusts along −z body):

    ṗ = v,  m v̇ = m g e₃ + R(q) (−Σ T_i e₃ − D (Rᵀ v_air) − rotor drag) + f_external
    q̇ = ½ q ⊗ [0, ω],  I ω̇ = Σ r_i × f_i + Σ s_i kτ T_i e₃ − D_ω ω − ω × I ω + τ_external

integrated with the classical fourth-order Runge–Kutta rule. The rotor signals obey ṡ = λ (command − s) and are not
integrated but evaluated exactly at the three instants a step needs, so the whole stays fourth order while the
command is constant over the step. The quaternion is brought back to unit length after each step. What the ground adds is in
`ground.py`. Not modelled: gyroscopic torque of the propellers, inflow, blade flapping.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from sitl_stub.physics.compiled import compiled, compiled_for_threads
from sitl_stub.physics.ground import ground_holds, lay_to_rest, solve_contacts, touches
from sitl_stub.physics.vehicle import (
    ANGULAR_DRAG,
    AT_REST,
    BATTERY_CAPACITY,
    BATTERY_CELLS,
    BATTERY_CURRENT,
    BATTERY_RESISTANCE,
    BATTERY_SAG,
    BATTERY_VOLTAGE,
    BODY_RATE,
    CHARGE_USED,
    EXTERNAL_FORCE,
    EXTERNAL_TORQUE,
    GRAVITY,
    GROUND_DOWN,
    GROUND_EFFECT,
    IDLE_CURRENT,
    INERTIA,
    LINEAR_DRAG,
    MASS,
    MAX_ROTORS,
    MAX_THRUST,
    QUATERNION,
    RIGID_SIZE,
    ROTOR_COUNT,
    ROTOR_DRAG,
    ROTOR_EFFECTIVENESS,
    ROTOR_LAG,
    ROTOR_POSITION,
    ROTOR_POWER,
    ROTOR_RADIUS,
    ROTOR_SIGNAL,
    ROTOR_SPIN,
    ROTOR_THRUST,
    SPECIFIC_FORCE,
    STATE_SIZE,
    THRUST_CURVE,
    TORQUE_PER_THRUST,
    TOUCHING,
    VELOCITY,
    WIND,
    WORKSPACE,
    FloatArray,
)

# Layout of the scratch part of the state array.
STAGE = WORKSPACE  # (13,) state at which the slope is wanted
SLOPE = STAGE + RIGID_SIZE
TOTAL = SLOPE + RIGID_SIZE
THRUST_START = TOTAL + RIGID_SIZE  # (MAX_ROTORS,) N at the start of the step
THRUST_MIDDLE = THRUST_START + MAX_ROTORS
THRUST_END = THRUST_MIDDLE + MAX_ROTORS
BEFORE = THRUST_END + MAX_ROTORS  # (3,) velocity before the step
CONTACT_SCRATCH = BEFORE + 3
assert CONTACT_SCRATCH + 32 <= STATE_SIZE

FULL_CELL_VOLTAGE = 4.2


@compiled
def cell_voltage(charge_left: float) -> float:
    """Open-circuit voltage of a lithium-polymer cell, V, at `charge_left` 1..0: straight lines through typical points."""
    if charge_left > 0.8:
        return 4.02 + (charge_left - 0.8) * 0.9
    if charge_left > 0.5:
        return 3.84 + (charge_left - 0.5) * 0.6
    if charge_left > 0.2:
        return 3.72 + (charge_left - 0.2) * 0.4
    if charge_left > 0.1:
        return 3.65 + (charge_left - 0.1) * 0.7
    return 3.30 + max(charge_left, 0.0) * 3.5


@compiled
def rigid_slope(
    state: FloatArray, parameters: FloatArray, environment: FloatArray, at: int, thrust: int
) -> None:
    """Slope of the 13 rigid-body numbers at `state[at:]` under rotor thrusts `state[thrust:]`, into `state[SLOPE:]`."""
    p = parameters
    w, x, y, z = (
        state[at + QUATERNION],
        state[at + QUATERNION + 1],
        state[at + QUATERNION + 2],
        state[at + QUATERNION + 3],
    )
    p_rate, q_rate, r_rate = state[at + BODY_RATE], state[at + BODY_RATE + 1], state[at + BODY_RATE + 2]
    # R(q) for a quaternion that may be a little off unit length inside a step: divide by its square
    s = 2.0 / (w * w + x * x + y * y + z * z)
    r00, r01, r02 = 1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)
    r10, r11, r12 = s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)
    r20, r21, r22 = s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)
    vn, ve, vd = state[at + VELOCITY], state[at + VELOCITY + 1], state[at + VELOCITY + 2]
    an, ae, ad = vn - environment[WIND], ve - environment[WIND + 1], vd - environment[WIND + 2]
    air_x, air_y, air_z = (
        r00 * an + r10 * ae + r20 * ad,
        r01 * an + r11 * ae + r21 * ad,
        r02 * an + r12 * ae + r22 * ad,
    )

    force_x, force_y, force_z = (
        -p[LINEAR_DRAG] * air_x,
        -p[LINEAR_DRAG + 1] * air_y,
        -p[LINEAR_DRAG + 2] * air_z,
    )
    torque_x = environment[EXTERNAL_TORQUE] - p[ANGULAR_DRAG] * p_rate
    torque_y = environment[EXTERNAL_TORQUE + 1] - p[ANGULAR_DRAG + 1] * q_rate
    torque_z = environment[EXTERNAL_TORQUE + 2] - p[ANGULAR_DRAG + 2] * r_rate
    height = environment[GROUND_DOWN] - state[at + 2]
    quarter_radius = 0.25 * p[ROTOR_RADIUS]
    for i in range(int(p[ROTOR_COUNT])):
        lift = state[thrust + i]
        if lift == 0.0:
            continue
        arm_x, arm_y, arm_z = (
            p[ROTOR_POSITION + 3 * i],
            p[ROTOR_POSITION + 3 * i + 1],
            p[ROTOR_POSITION + 3 * i + 2],
        )
        spin_torque = p[ROTOR_SPIN + i] * p[TORQUE_PER_THRUST] * lift
        if p[GROUND_EFFECT] > 0.0:
            # Cheeseman and Bennett 1955: T/T∞ = 1 / (1 − (R/4h)²); held where it would leave its range, at h = R/2
            rotor_height = height - (r20 * arm_x + r21 * arm_y + r22 * arm_z)
            ratio = quarter_radius / max(rotor_height, 2.0 * quarter_radius)
            lift *= 1.0 + p[GROUND_EFFECT] * (1.0 / (1.0 - ratio * ratio) - 1.0)
        side_x, side_y = 0.0, 0.0
        if p[ROTOR_DRAG] > 0.0:
            # in-plane force against the air at the hub, proportional to rotor speed (∝ √T)
            strength = p[ROTOR_DRAG] * math.sqrt(state[thrust + i] / p[MAX_THRUST + i])
            side_x = -strength * (air_x + q_rate * arm_z - r_rate * arm_y)
            side_y = -strength * (air_y + r_rate * arm_x - p_rate * arm_z)
        force_x += side_x
        force_y += side_y
        force_z -= lift
        torque_x += -arm_y * lift - arm_z * side_y
        torque_y += arm_z * side_x + arm_x * lift
        torque_z += arm_x * side_y - arm_y * side_x + spin_torque

    per_mass = 1.0 / p[MASS]
    ix, iy, iz = p[INERTIA], p[INERTIA + 1], p[INERTIA + 2]
    state[SLOPE] = vn
    state[SLOPE + 1] = ve
    state[SLOPE + 2] = vd
    state[SLOPE + VELOCITY] = (
        r00 * force_x + r01 * force_y + r02 * force_z + environment[EXTERNAL_FORCE]
    ) * per_mass
    state[SLOPE + VELOCITY + 1] = (
        r10 * force_x + r11 * force_y + r12 * force_z + environment[EXTERNAL_FORCE + 1]
    ) * per_mass
    state[SLOPE + VELOCITY + 2] = (
        r20 * force_x + r21 * force_y + r22 * force_z + environment[EXTERNAL_FORCE + 2]
    ) * per_mass + p[GRAVITY]
    state[SLOPE + QUATERNION] = -0.5 * (x * p_rate + y * q_rate + z * r_rate)
    state[SLOPE + QUATERNION + 1] = 0.5 * (w * p_rate + y * r_rate - z * q_rate)
    state[SLOPE + QUATERNION + 2] = 0.5 * (w * q_rate + z * p_rate - x * r_rate)
    state[SLOPE + QUATERNION + 3] = 0.5 * (w * r_rate + x * q_rate - y * p_rate)
    state[SLOPE + BODY_RATE] = (torque_x - (iz - iy) * q_rate * r_rate) / ix
    state[SLOPE + BODY_RATE + 1] = (torque_y - (ix - iz) * r_rate * p_rate) / iy
    state[SLOPE + BODY_RATE + 2] = (torque_z - (iy - ix) * p_rate * q_rate) / iz


@compiled
def turn_rotors(
    state: FloatArray,
    motor_commands: FloatArray,
    parameters: FloatArray,
    decay_half: float,
    decay_full: float,
) -> None:
    """Carry the lagged rotor signals over one step and leave the thrusts (N) at its start, middle and end in the scratch.

    A command outside 0..1 saturates; one that is not a number stops the rotor.
    """
    k = parameters[THRUST_CURVE]
    supply = 1.0
    if parameters[BATTERY_SAG] > 0.0:
        # rotor speed follows the voltage, thrust its square; at rest on a full battery the thrust is the nominal one
        ratio = state[BATTERY_VOLTAGE] / (FULL_CELL_VOLTAGE * parameters[BATTERY_CELLS])
        supply = ratio * ratio
    for i in range(int(parameters[ROTOR_COUNT])):
        command = motor_commands[i]
        command = min(command, 1.0) if command > 0.0 else 0.0
        start = state[ROTOR_SIGNAL + i]
        middle = command + (start - command) * decay_half
        end = command + (start - command) * decay_full
        scale = parameters[MAX_THRUST + i] * parameters[ROTOR_EFFECTIVENESS + i] * supply
        state[THRUST_START + i] = scale * start * (1.0 - k + k * start)
        state[THRUST_MIDDLE + i] = scale * middle * (1.0 - k + k * middle)
        state[THRUST_END + i] = scale * end * (1.0 - k + k * end)
        state[ROTOR_SIGNAL + i] = end
        state[ROTOR_THRUST + i] = state[THRUST_END + i]


@compiled
def drain_battery(state: FloatArray, parameters: FloatArray, dt_s: float) -> None:
    """Current from the rotors' power at the voltage of the step before, charge taken, voltage under load."""
    power = 0.0
    for i in range(int(parameters[ROTOR_COUNT])):
        thrust = state[ROTOR_THRUST + i]
        power += thrust * math.sqrt(thrust)
    voltage = max(state[BATTERY_VOLTAGE], 1.0)
    current = parameters[IDLE_CURRENT] + parameters[ROTOR_POWER] * power / voltage
    state[BATTERY_CURRENT] = current
    state[CHARGE_USED] += current * dt_s
    left = 1.0 - state[CHARGE_USED] / parameters[BATTERY_CAPACITY]
    state[BATTERY_VOLTAGE] = (
        parameters[BATTERY_CELLS] * cell_voltage(left) - parameters[BATTERY_RESISTANCE] * current
    )


@compiled
def runge_kutta_step(state: FloatArray, parameters: FloatArray, environment: FloatArray, dt_s: float) -> None:
    """One classical Runge–Kutta step of the free rigid body; thrusts are taken from the scratch (`turn_rotors`)."""
    half = 0.5 * dt_s
    rigid_slope(state, parameters, environment, 0, THRUST_START)
    for j in range(RIGID_SIZE):
        state[TOTAL + j] = state[SLOPE + j]
        state[STAGE + j] = state[j] + half * state[SLOPE + j]
    rigid_slope(state, parameters, environment, STAGE, THRUST_MIDDLE)
    for j in range(RIGID_SIZE):
        state[TOTAL + j] += 2.0 * state[SLOPE + j]
        state[STAGE + j] = state[j] + half * state[SLOPE + j]
    rigid_slope(state, parameters, environment, STAGE, THRUST_MIDDLE)
    for j in range(RIGID_SIZE):
        state[TOTAL + j] += 2.0 * state[SLOPE + j]
        state[STAGE + j] = state[j] + dt_s * state[SLOPE + j]
    rigid_slope(state, parameters, environment, STAGE, THRUST_END)
    for j in range(RIGID_SIZE):
        state[j] += dt_s / 6.0 * (state[TOTAL + j] + state[SLOPE + j])
    length = 0.0
    for j in range(4):
        length += state[QUATERNION + j] * state[QUATERNION + j]
    length = 1.0 / math.sqrt(length)
    for j in range(4):
        state[QUATERNION + j] *= length


@compiled
def feel_acceleration(state: FloatArray, parameters: FloatArray, dt_s: float) -> None:
    """Specific force, FRD m/s²: mean change of velocity over the step less gravity, seen from the body at its end."""
    w, x, y, z = state[QUATERNION], state[QUATERNION + 1], state[QUATERNION + 2], state[QUATERNION + 3]
    fn = (state[VELOCITY] - state[BEFORE]) / dt_s
    fe = (state[VELOCITY + 1] - state[BEFORE + 1]) / dt_s
    fd = (state[VELOCITY + 2] - state[BEFORE + 2]) / dt_s - parameters[GRAVITY]
    state[SPECIFIC_FORCE] = (
        (1 - 2 * (y * y + z * z)) * fn + 2 * (x * y + w * z) * fe + 2 * (x * z - w * y) * fd
    )
    state[SPECIFIC_FORCE + 1] = (
        2 * (x * y - w * z) * fn + (1 - 2 * (x * x + z * z)) * fe + 2 * (y * z + w * x) * fd
    )
    state[SPECIFIC_FORCE + 2] = (
        2 * (x * z + w * y) * fn + 2 * (y * z - w * x) * fe + (1 - 2 * (x * x + y * y)) * fd
    )


@compiled
def advance(
    state: FloatArray,
    motor_commands: FloatArray,
    parameters: FloatArray,
    environment: FloatArray,
    dt_s: float,
    steps: int,
) -> None:
    """Move `state` forward by `steps` steps of `dt_s` seconds, in place, with commands and surroundings held constant.

    state (STATE_SIZE,), motor_commands (≥ N,) 0..1, parameters (PARAMETERS_SIZE,), environment (ENVIRONMENT_SIZE,): the
    arrays of `vehicle.py`. Meant for `dt_s` of 1 ms or less. Allocates nothing; callable from compiled code. n calls of one
    step and one call of n steps give the same bits.
    """
    decay_half = math.exp(-0.5 * dt_s * parameters[ROTOR_LAG])
    decay_full = math.exp(-dt_s * parameters[ROTOR_LAG])
    for _ in range(steps):
        turn_rotors(state, motor_commands, parameters, decay_half, decay_full)
        for j in range(3):
            state[BEFORE + j] = state[VELOCITY + j]
        if state[AT_REST] > 0.0:
            # the ground holds it as long as it could with the forces at the end of this step
            rigid_slope(state, parameters, environment, 0, THRUST_END)
            if not (touches(state, parameters, environment) and ground_holds(state, parameters, SLOPE)):
                state[AT_REST] = 0.0
        if state[AT_REST] == 0.0:
            runge_kutta_step(state, parameters, environment, dt_s)
            state[TOUCHING] = 0.0
            if touches(state, parameters, environment):
                settled = solve_contacts(state, parameters, environment, dt_s, CONTACT_SCRATCH)
                if settled:
                    rigid_slope(state, parameters, environment, 0, THRUST_END)
                    if ground_holds(state, parameters, SLOPE):
                        state[AT_REST] = 1.0
                        lay_to_rest(state, parameters, environment)
        feel_acceleration(state, parameters, dt_s)
        drain_battery(state, parameters, dt_s)


@compiled_for_threads
def advance_batch(
    states: FloatArray,
    motor_commands: FloatArray,
    parameters: FloatArray,
    environments: FloatArray,
    dt_s: float,
    steps: int,
) -> None:
    """`advance` for many vehicles at once, in place: one row of each array per vehicle, shared out over numba's threads.

    states (V, STATE_SIZE), motor_commands (V, N), parameters (V, PARAMETERS_SIZE), environments (V, ENVIRONMENT_SIZE).
    Each row ends with the same bits as if it had been advanced alone, whatever the number of threads.
    """
    for v in numba.prange(states.shape[0]):
        advance(states[v], motor_commands[v], parameters[v], environments[v], dt_s, steps)


def warm_up() -> None:
    """Compile (or load from the cache) everything `advance` needs: the first step of a flight must not be the slow one."""
    from sitl_stub.physics.vehicle import calm_environment, initial_state, load_vehicle

    vehicle = load_vehicle("qball2")
    advance(initial_state(vehicle), np.zeros(4), vehicle.packed(), calm_environment(vehicle), 1e-3, 1)
