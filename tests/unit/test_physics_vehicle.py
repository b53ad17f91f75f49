"""Vehicles: the shipped ones load, bad ones are refused with one error that names the place."""

from __future__ import annotations

import numpy as np
import pytest

from sitl_stub.physics.vehicle import (
    CONTACT_POINT,
    INERTIA,
    MASS,
    PARAMETERS_SIZE,
    ROTOR_POSITION,
    STATE_SIZE,
    VehicleError,
    calm_environment,
    initial_state,
    load_vehicle,
    set_mass,
    set_rotor_effectiveness,
    vehicle_names,
)

GOOD = """
mass_kg = 1.0
inertia_kg_m2 = [0.01, 0.01, 0.018]
rotor_position_frd = [[0.1, 0.1, 0], [-0.1, -0.1, 0], [0.1, -0.1, 0], [-0.1, 0.1, 0]]
rotor_spin = [1, 1, -1, -1]
max_thrust_newton = [5, 5, 5, 5]
torque_per_thrust_m = 0.02
rotor_lag_rad_s = 20
"""


def test_the_shipped_vehicles_are_there_and_pack_their_numbers():
    assert vehicle_names() == ["arducopter", "px4_sih", "qball2"]
    for name in vehicle_names():
        vehicle = load_vehicle(name)
        packed = vehicle.packed()
        assert packed.shape == (PARAMETERS_SIZE,)
        assert packed[MASS] == vehicle.mass_kg
        np.testing.assert_array_equal(packed[INERTIA : INERTIA + 3], vehicle.inertia_kg_m2)
        positions = packed[ROTOR_POSITION : ROTOR_POSITION + 12].reshape(4, 3)
        np.testing.assert_array_equal(positions, vehicle.rotor_position_frd)
        assert (packed[CONTACT_POINT:].reshape(8, 3)[:4, 2] == vehicle.foot_height_m).all()
        assert initial_state(vehicle).shape == (STATE_SIZE,)


def test_qball2_is_the_allocation_of_the_control_laws_turned_over():
    """B is FLU (control_laws.md, section 2); FRD keeps the first two rows and turns the sign of pitch and yaw."""
    arm, ratio = 0.2, 1.0 / 30.0
    flu = np.array([[1, 1, 1, 1], [0, -arm, 0, arm], [-arm, 0, arm, 0], [-ratio, ratio, -ratio, ratio]])
    np.testing.assert_allclose(load_vehicle("qball2").allocation_frd(), flu * [[1], [1], [-1], [-1]])


def test_px4_sih_is_the_capture():
    vehicle = load_vehicle("px4_sih")
    np.testing.assert_allclose(np.linalg.norm(vehicle.rotor_position_frd, axis=1), 0.2, atol=1e-4)
    assert vehicle.max_thrust_newton[0] * vehicle.torque_per_thrust_m == pytest.approx(0.3)  # SIH_Q_MAX
    assert 1.0 / vehicle.rotor_lag_rad_s == pytest.approx(0.0667)  # SIH_T_TAU


def test_a_file_of_ones_own_loads_and_changes_apply(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(GOOD)
    vehicle = load_vehicle(path, thrust_curve=0.5)
    assert (vehicle.name, vehicle.mass_kg, vehicle.thrust_curve) == ("mine", 1.0, 0.5)
    # (1 − ½) s + ½ s² = 9.81 / 20
    s = vehicle.hover_command
    assert 0.5 * s + 0.5 * s * s == pytest.approx(9.81 / 20)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("mass_kg = 0", "mass_kg is 0, must be above 0"),
        ("mass_kg = 3.0", "do not lift the mass"),
        ("mass_kg = 'heavy'", "mass_kg = 'heavy' is of the wrong type"),
        ("inertia_kg_m2 = [0.01, 0.01, 0.05]", "of no solid body"),
        ("inertia_kg_m2 = [0.01, 0.01]", "inertia_kg_m2 has shape (2,), must be (3,)"),
        ("rotor_spin = [1, 1, -1, 2]", "rotor_spin must be +1 or −1"),
        ("rotor_position_frd = [[0.1, 0.1]]", "1 rotors, must be 3 to 8"),
        ("max_thrust_newton = ['a', 5, 5, 5]", "max_thrust_newton must be 1-dimensional"),
        ("wings = 2", "unknown: wings"),
        ("mass_kg = [", "is not TOML"),
    ],
)
def test_a_bad_file_is_one_error_that_names_it(tmp_path, change, says):
    path = tmp_path / "mine.toml"
    key = change.split(" ")[0]
    path.write_text(
        "\n".join(line for line in GOOD.splitlines() if not line.startswith(key)) + "\n" + change + "\n"
    )
    with pytest.raises(VehicleError) as caught:
        load_vehicle(path)
    assert says in str(caught.value)
    assert "mine.toml" in str(caught.value)


def test_faults_are_listed_all_at_once_and_missing_fields_named(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(GOOD.replace("= 20", "= -1").replace("= 0.02", "= -0.1"))
    with pytest.raises(VehicleError, match=r"torque_per_thrust_m.*rotor_lag_rad_s"):
        load_vehicle(path)
    path.write_text("mass_kg = 1.0")
    with pytest.raises(VehicleError, match="missing: inertia_kg_m2, max_thrust_newton"):
        load_vehicle(path)


def test_an_unknown_name_lists_the_names_and_a_missing_file_is_named(tmp_path):
    with pytest.raises(VehicleError, match="choose from arducopter, px4_sih, qball2"):
        load_vehicle("qball3")
    with pytest.raises(VehicleError, match=r"cannot read .*gone\.toml"):
        load_vehicle(tmp_path / "gone.toml")


def test_run_time_changes_are_checked():
    vehicle = load_vehicle("qball2")
    packed = vehicle.packed()
    with pytest.raises(VehicleError, match="above 0"):
        set_mass(packed, 0.0)
    with pytest.raises(VehicleError, match="no rotor 4: count from 0 to 3"):
        set_rotor_effectiveness(packed, 4, 0.5)
    assert calm_environment(vehicle)[9] == vehicle.foot_height_m
