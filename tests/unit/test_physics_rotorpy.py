"""The stub's flight against rotorpy 3's, an independent simulator, on a trajectory stored with how it was made.

rotorpy is ENU/FLU, quaternions x y z w; turned into NED/FRD here, by hand, once. Same vehicle, same rotor speeds commanded,
held a quarter of a second each, one rotor stopped on the way; rotors above the centre of mass, rotor drag, wind.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from sitl_stub.physics.rigid_body import advance
from sitl_stub.physics.vehicle import (
    BODY_RATE_FRD,
    POSITION_NED,
    QUATERNION_WXYZ,
    ROTOR_SIGNALS,
    VELOCITY_NED,
    WIND_NED,
    VehicleParameters,
    calm_environment,
    initial_state,
)

STORED = json.loads((Path(__file__).parent / "fixtures" / "rotorpy_trajectory.json").read_text())
TO_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
TO_FRD = np.diag([1.0, -1.0, -1.0])


def rotation(w, x, y, z):
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def same_vehicle():
    p = STORED["parameters"]
    greatest = p["rotor_speed_max"]
    return VehicleParameters(
        name="rotorpy",
        mass_kg=p["mass"],
        inertia_kg_m2=np.array([p["Ixx"], p["Iyy"], p["Izz"]]),
        rotor_position_frd=np.array([TO_FRD @ p["rotor_pos"][f"r{i}"] for i in (1, 2, 3, 4)]),
        rotor_spin=-np.array(p["rotor_directions"], dtype=float),
        max_thrust_newton=np.full(4, p["k_eta"] * greatest**2),
        torque_per_thrust_m=p["k_m"] / p["k_eta"],
        rotor_lag_rad_s=1.0 / p["tau_m"],
        thrust_curve=1.0,
        rotor_drag_kg_s=p["k_d"] * greatest,
    )


@pytest.mark.parametrize("dt_s", [1e-3, 2.5e-4])
def test_the_trajectory_is_rotorpys(dt_s):
    vehicle, first, greatest = same_vehicle(), STORED["initial"], STORED["parameters"]["rotor_speed_max"]
    state, environment = initial_state(vehicle), calm_environment(vehicle)
    state[POSITION_NED], state[VELOCITY_NED] = TO_NED @ first["x"], TO_NED @ first["v"]
    # rotated about up only by ψ from east: heading from north is π/2 − ψ
    yaw_enu = 2 * math.atan2(first["q"][2], first["q"][3])
    heading = math.pi / 2 - yaw_enu
    state[QUATERNION_WXYZ] = math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)
    state[BODY_RATE_FRD] = TO_FRD @ first["w"]
    state[ROTOR_SIGNALS][:4] = np.array(first["rotor_speeds"]) / greatest
    environment[WIND_NED] = TO_NED @ first["wind"]
    environment[9] = 1e6
    p = vehicle.packed()
    for commands, expected in zip(STORED["commands_of_greatest_speed"], STORED["states"], strict=True):
        advance(state, np.array(commands), p, environment, dt_s, round(STORED["hold_s"] / dt_s))
        np.testing.assert_allclose(TO_NED @ state[POSITION_NED], expected["x"], atol=1e-7)
        np.testing.assert_allclose(TO_NED @ state[VELOCITY_NED], expected["v"], atol=1e-7)
        np.testing.assert_allclose(TO_FRD @ state[BODY_RATE_FRD], expected["w"], atol=1e-6)
        x, y, z, w = expected["q"]
        attitude = TO_NED @ rotation(w, x, y, z) @ TO_FRD
        np.testing.assert_allclose(rotation(*state[QUATERNION_WXYZ]), attitude, atol=1e-7)
        np.testing.assert_allclose(
            state[ROTOR_SIGNALS][:4] * greatest, expected["rotor_speeds"], rtol=1e-8, atol=1e-4
        )
    # it was no hover: the stopped rotor has turned it over
    assert np.abs(STORED["states"][-1]["w"]).max() > 2.0
