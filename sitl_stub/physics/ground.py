"""The ground: a plane the vehicle neither sinks into nor bounces from, and on which it can be exactly at rest.

Contacts are rigid and inelastic. After each free step, every corner of the vehicle (four feet, four corners on top) that
would be below the plane is stopped by impulses (projected Gauss–Seidel over normal and Coulomb friction impulses, the
velocity-level time stepping of Moreau and of Stewart and Trinkle), and the vehicle is lifted by what is left of the
penetration. No spring is involved: nothing to tune to the mass, no depth at rest, no stored energy.

A vehicle that has come to rest on its feet is then not moved at all (`AT_REST`) for as long as gravity, thrust and
wind can be carried by forces the feet can give: pushing only, within friction, centre of pressure between the feet.
"""

from __future__ import annotations

import math

from sitl_stub.physics.compiled import compiled
from sitl_stub.physics.vehicle import (
    BODY_RATE,
    CONTACT_POINT,
    CONTACT_POINTS,
    FRICTION,
    GRAVITY,
    GROUND_DOWN,
    IMPACT_SPEED,
    INERTIA,
    MASS,
    POSITION,
    QUATERNION,
    ROTOR_COUNT,
    ROTOR_THRUST,
    TOUCHING,
    VELOCITY,
    FloatArray,
)

MOST_SWEEPS = 200  # of Gauss–Seidel over the contacts, which stops earlier once
SETTLED_SPEED = 1e-9  # m/s: no impulse of a sweep changes its contact's speed by more than this
SLOP = 1e-5  # m: a corner this close above the ground counts as touching; one step of fall at 1 kHz
REST_SPEED = 0.01  # m/s, and
REST_RATE = 0.05  # rad/s: slower than this on all four feet, the vehicle is taken to have come to rest
UPRIGHT = 0.95  # cosine of tilt above which it can only be standing on its feet
REST_GAP = 3e-4  # m: largest height of the highest foot of a vehicle at rest


@compiled
def touches(state: FloatArray, parameters: FloatArray, environment: FloatArray) -> bool:
    """Whether any corner of the vehicle is at or below the ground. Cheap when far from it."""
    below = environment[GROUND_DOWN] - state[POSITION + 2]
    p = parameters
    if below > abs(p[CONTACT_POINT]) + abs(p[CONTACT_POINT + 1]) + abs(p[CONTACT_POINT + 2]) + abs(
        p[CONTACT_POINT + 14]
    ):
        return False
    w, x, y, z = state[QUATERNION], state[QUATERNION + 1], state[QUATERNION + 2], state[QUATERNION + 3]
    nx, ny, nz = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    for c in range(CONTACT_POINTS):
        at = CONTACT_POINT + 3 * c
        if nx * p[at] + ny * p[at + 1] + nz * p[at + 2] > below - SLOP:
            return True
    return False


@compiled
def ground_holds(state: FloatArray, parameters: FloatArray, slope: int) -> bool:
    """Whether the ground can hold a motionless vehicle against `state[slope:]`, its accelerations if there were no ground.

    On its feet: the reaction must push, lie within the friction cone and act between the feet. Lying otherwise (turned
    over): held while the rotors give less than a fifth of the weight.
    """
    p = parameters
    w, x, y, z = state[QUATERNION], state[QUATERNION + 1], state[QUATERNION + 2], state[QUATERNION + 3]
    if 1.0 - 2.0 * (x * x + y * y) <= UPRIGHT:
        thrust = 0.0
        for i in range(int(p[ROTOR_COUNT])):
            thrust += state[ROTOR_THRUST + i]
        return bool(thrust < 0.2 * p[MASS] * p[GRAVITY])
    an, ae, ad = state[slope + VELOCITY], state[slope + VELOCITY + 1], state[slope + VELOCITY + 2]
    load = p[MASS] * ad
    if not load > 0.0:
        return False
    friction_n, friction_e = -p[MASS] * an, -p[MASS] * ae
    limit = p[FRICTION] * load
    if friction_n * friction_n + friction_e * friction_e > limit * limit:
        return False
    # the vehicle stands all but level: turn the friction by the heading only
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    c, s = math.cos(heading), math.sin(heading)
    friction_x, friction_y = c * friction_n + s * friction_e, -s * friction_n + c * friction_e
    half_length, half_width, height = abs(p[CONTACT_POINT]), abs(p[CONTACT_POINT + 1]), p[CONTACT_POINT + 2]
    roll_torque = p[INERTIA] * state[slope + BODY_RATE]
    pitch_torque = p[INERTIA + 1] * state[slope + BODY_RATE + 1]
    yaw_torque = p[INERTIA + 2] * state[slope + BODY_RATE + 2]
    # reaction (fx, fy, −load) at (x, y, height) must cancel the torque: roll −y load − h fy, pitch h fx + x load
    centre_y = (roll_torque - height * friction_y) / load
    centre_x = (-pitch_torque - height * friction_x) / load
    if abs(centre_x) > half_length or abs(centre_y) > half_width:
        return False
    return bool(abs(yaw_torque) <= limit * min(half_length, half_width))


@compiled
def lay_to_rest(state: FloatArray, parameters: FloatArray, environment: FloatArray) -> None:
    """Stop the vehicle; if upright, stand it exactly level with its feet exactly on the ground, keeping heading.

    What this moves it by is below `REST_GAP`; without it, rest would keep the last digits of how the landing ended.
    """
    for j in range(3):
        state[VELOCITY + j] = 0.0
        state[BODY_RATE + j] = 0.0
    w, x, y, z = state[QUATERNION], state[QUATERNION + 1], state[QUATERNION + 2], state[QUATERNION + 3]
    if 1.0 - 2.0 * (x * x + y * y) > UPRIGHT:
        length = math.sqrt(w * w + z * z)
        state[QUATERNION], state[QUATERNION + 3] = w / length, z / length
        state[QUATERNION + 1], state[QUATERNION + 2] = 0.0, 0.0
        state[POSITION + 2] = environment[GROUND_DOWN] - parameters[CONTACT_POINT + 2]


@compiled
def solve_contacts(
    state: FloatArray, parameters: FloatArray, environment: FloatArray, dt_s: float, scratch: int
) -> bool:
    """Stop what would go into the ground, in place; True when the vehicle has come to rest.

    Works in the body frame, where the inertia is diagonal. `state[scratch:]` (4 · CONTACT_POINTS) holds gaps and impulses.
    """
    p = parameters
    w, x, y, z = state[QUATERNION], state[QUATERNION + 1], state[QUATERNION + 2], state[QUATERNION + 3]
    # rows of R: north, east and down seen from the body
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    r10, r11, r12 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    r20, r21, r22 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    vn, ve, vd = state[VELOCITY], state[VELOCITY + 1], state[VELOCITY + 2]
    vx, vy, vz = (
        r00 * vn + r10 * ve + r20 * vd,
        r01 * vn + r11 * ve + r21 * vd,
        r02 * vn + r12 * ve + r22 * vd,
    )
    ox, oy, oz = state[BODY_RATE], state[BODY_RATE + 1], state[BODY_RATE + 2]
    per_mass, jx, jy, jz = 1.0 / p[MASS], 1.0 / p[INERTIA], 1.0 / p[INERTIA + 1], 1.0 / p[INERTIA + 2]
    below = environment[GROUND_DOWN] - state[POSITION + 2]

    deepest, highest_foot, touching = 0.0, 0.0, 0
    for c in range(CONTACT_POINTS):
        at = CONTACT_POINT + 3 * c
        gap = below - (r20 * p[at] + r21 * p[at + 1] + r22 * p[at + 2])
        state[scratch + 4 * c] = gap
        for k in range(1, 4):
            state[scratch + 4 * c + k] = 0.0
        deepest = min(deepest, gap)
        if c < 4:
            highest_foot = max(highest_foot, gap)
        if gap < SLOP:
            touching += 1
            closing = vd + (
                r20 * (oy * p[at + 2] - oz * p[at + 1])
                + r21 * (oz * p[at] - ox * p[at + 2])
                + r22 * (ox * p[at + 1] - oy * p[at])
            )
            state[IMPACT_SPEED] = max(state[IMPACT_SPEED], closing)

    for _ in range(MOST_SWEEPS):
        largest = 0.0
        for c in range(CONTACT_POINTS):
            gap = state[scratch + 4 * c]
            if gap >= SLOP:
                continue
            at = CONTACT_POINT + 3 * c
            ax, ay, az = p[at], p[at + 1], p[at + 2]
            for k in range(3):  # 0: down, 1: north, 2: east
                dx, dy, dz = (r20, r21, r22) if k == 0 else (r00, r01, r02) if k == 1 else (r10, r11, r12)
                lx, ly, lz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
                speed = dx * vx + dy * vy + dz * vz + lx * ox + ly * oy + lz * oz
                mass = 1.0 / (per_mass + lx * lx * jx + ly * ly * jy + lz * lz * jz)
                old = state[scratch + 4 * c + 1 + k]
                if k == 0:
                    allowed = max(gap, 0.0) / dt_s
                    new = min(old - mass * (speed - allowed), 0.0)  # the ground only pushes up
                else:
                    limit = -p[FRICTION] * state[scratch + 4 * c + 1]
                    other = state[scratch + 4 * c + 1 + (3 - k)]
                    room = math.sqrt(max(limit * limit - other * other, 0.0))
                    new = min(max(old - mass * speed, -room), room)
                state[scratch + 4 * c + 1 + k] = new
                push = new - old
                largest = max(largest, abs(push) / mass)
                vx, vy, vz = vx + push * per_mass * dx, vy + push * per_mass * dy, vz + push * per_mass * dz
                ox, oy, oz = ox + push * jx * lx, oy + push * jy * ly, oz + push * jz * lz
        if largest < SETTLED_SPEED:
            break

    state[VELOCITY] = r00 * vx + r01 * vy + r02 * vz
    state[VELOCITY + 1] = r10 * vx + r11 * vy + r12 * vz
    state[VELOCITY + 2] = r20 * vx + r21 * vy + r22 * vz
    state[BODY_RATE], state[BODY_RATE + 1], state[BODY_RATE + 2] = ox, oy, oz
    state[POSITION + 2] += deepest
    state[TOUCHING] = touching
    upright = r22 > UPRIGHT
    still = (
        vx * vx + vy * vy + vz * vz < REST_SPEED * REST_SPEED
        and ox * ox + oy * oy + oz * oz < REST_RATE * REST_RATE
    )
    return still and (highest_foot - deepest < REST_GAP if upright else touching >= 3)
