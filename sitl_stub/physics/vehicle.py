"""What a vehicle is made of (`VehicleParameters`, read from TOML) and how parameters, state and surroundings are packed.

Compiled code takes three flat float64 arrays: `parameters` (from `VehicleParameters.packed()`), `state` (from
`initial_state`) and `environment` (from `calm_environment`). The constants below are the offsets into them, so that
`state[VELOCITY_NED]` (slices, for Python) and `state[VELOCITY + i]` (integers, for compiled code) say the same.
All three may be changed between steps: that is how a payload drops, a motor fails or the wind turns.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

MAX_ROTORS = 8
CONTACT_POINTS = 8

# --- parameters -------------------------------------------------------------------------------------------------
MASS = 0
INERTIA = 1  # (3,) principal moments, kg·m²
GRAVITY = 4
TORQUE_PER_THRUST = 5
ROTOR_LAG = 6
THRUST_CURVE = 7
LINEAR_DRAG = 8  # (3,) body frame, kg/s
ANGULAR_DRAG = 11  # (3,) kg·m²/s
ROTOR_DRAG = 14
ROTOR_RADIUS = 15
GROUND_EFFECT = 16
FRICTION = 17
ROTOR_COUNT = 18
BATTERY_CELLS = 19
BATTERY_CAPACITY = 20  # A·s
BATTERY_RESISTANCE = 21
BATTERY_SAG = 22
ROTOR_POWER = 23
IDLE_CURRENT = 24
ROTOR_POSITION = 32  # (MAX_ROTORS, 3)
ROTOR_SPIN = ROTOR_POSITION + 3 * MAX_ROTORS
MAX_THRUST = ROTOR_SPIN + MAX_ROTORS
ROTOR_EFFECTIVENESS = MAX_THRUST + MAX_ROTORS
CONTACT_POINT = ROTOR_EFFECTIVENESS + MAX_ROTORS  # (CONTACT_POINTS, 3): four feet, then four corners on top
PARAMETERS_SIZE = CONTACT_POINT + 3 * CONTACT_POINTS

# --- state ------------------------------------------------------------------------------------------------------
POSITION = 0  # NED, m, of the centre of mass
VELOCITY = 3  # NED, m/s
QUATERNION = 6  # w x y z, body FRD to NED
BODY_RATE = 10  # FRD, rad/s
RIGID_SIZE = 13
ROTOR_SIGNAL = 13  # (MAX_ROTORS,) lagged motor command, 0..1
ROTOR_THRUST = (
    ROTOR_SIGNAL + MAX_ROTORS
)  # (MAX_ROTORS,) N, at the end of the last step, without ground effect
SPECIFIC_FORCE = (
    ROTOR_THRUST + MAX_ROTORS
)  # (3,) FRD, m/s²: mean over the last step, what an ideal accelerometer shows
CHARGE_USED = SPECIFIC_FORCE + 3  # A·s
BATTERY_VOLTAGE = CHARGE_USED + 1  # V, under load
BATTERY_CURRENT = BATTERY_VOLTAGE + 1  # A
AT_REST = BATTERY_CURRENT + 1  # 1.0 while the ground holds the vehicle motionless
TOUCHING = AT_REST + 1  # number of contact points on the ground
IMPACT_SPEED = (
    TOUCHING + 1
)  # m/s, greatest closing speed with the ground since the start or since it was set to 0
WORKSPACE = (
    IMPACT_SPEED + 1
)  # scratch of the integrator, so that a step allocates nothing; carries no information
WORKSPACE_SIZE = 3 * RIGID_SIZE + 3 * MAX_ROTORS + 4 * CONTACT_POINTS + 32
STATE_SIZE = WORKSPACE + WORKSPACE_SIZE

POSITION_NED = slice(POSITION, POSITION + 3)
VELOCITY_NED = slice(VELOCITY, VELOCITY + 3)
QUATERNION_WXYZ = slice(QUATERNION, QUATERNION + 4)
BODY_RATE_FRD = slice(BODY_RATE, BODY_RATE + 3)
RIGID = slice(0, RIGID_SIZE)
ROTOR_SIGNALS = slice(ROTOR_SIGNAL, ROTOR_SIGNAL + MAX_ROTORS)
ROTOR_THRUSTS = slice(ROTOR_THRUST, ROTOR_THRUST + MAX_ROTORS)
SPECIFIC_FORCE_FRD = slice(SPECIFIC_FORCE, SPECIFIC_FORCE + 3)
INFORMATION = slice(0, WORKSPACE)  # everything that is state; the rest is scratch

# --- environment ------------------------------------------------------------------------------------------------
WIND = 0  # (3,) NED, m/s, velocity of the air
EXTERNAL_FORCE = 3  # (3,) NED, N: a tether, a push
EXTERNAL_TORQUE = 6  # (3,) FRD, N·m
GROUND_DOWN = 9  # NED z of the ground, m
ENVIRONMENT_SIZE = 10

WIND_NED = slice(WIND, WIND + 3)
EXTERNAL_FORCE_NED = slice(EXTERNAL_FORCE, EXTERNAL_FORCE + 3)
EXTERNAL_TORQUE_FRD = slice(EXTERNAL_TORQUE, EXTERNAL_TORQUE + 3)


class VehicleError(ValueError):
    """A vehicle that cannot be flown: unknown name, unreadable file, or numbers that make no vehicle."""


@dataclass(frozen=True)
class Owner:
    """What its owner told the autopilot, where that is not the truth or not the capture's vehicle scaled."""

    rate_crossover_rad_s: float | None = None
    """Crossover of the roll and pitch rate loops as tuned; None: that of the capture's vehicle."""
    hover_told: float = 1.0
    """Hover thrust in the parameters, over the true one."""
    thrust_curve_told: float | None = None
    """THR_MDL_FAC, MOT_THST_EXPO; None: the true curve."""


@dataclass(frozen=True)
class VehicleParameters:
    """One multirotor. Shapes and units beside the fields; N rotors, 3 ≤ N ≤ 8.

    Raises `VehicleError` with every fault listed at once.
    """

    name: str
    mass_kg: float
    inertia_kg_m2: FloatArray  # (3,) principal moments about FRD axes
    rotor_position_frd: FloatArray  # (N, 3) m, from the centre of mass
    rotor_spin: (
        FloatArray  # (N,) sign of the reaction torque about z (down): +1 propeller anticlockwise from above
    )
    max_thrust_newton: FloatArray  # (N,) static thrust at command 1, full battery
    torque_per_thrust_m: float  # reaction torque per thrust
    rotor_lag_rad_s: float  # first-order lag of the motor signal; 0: none
    thrust_curve: float = 0.0  # k in T/T_max = (1 − k) s + k s² (THR_MDL_FAC, MOT_THST_EXPO)
    linear_drag_kg_s: FloatArray = None  # type: ignore[assignment]  # (3,) body frame, force −D v_air
    angular_drag_kg_m2_s: FloatArray = None  # type: ignore[assignment]  # (3,) torque −D ω
    rotor_drag_kg_s: float = 0.0  # in-plane force per rotor at full thrust and 1 m/s, scales with √(T/T_max)
    rotor_radius_m: float = 0.12  # for ground effect
    ground_effect: float = 0.0  # 1: Cheeseman–Bennett, 0: none
    gravity_m_s2: float = 9.81
    foot_half_length_m: float = 0.15  # the feet stand at (±length, ±width, height) from the centre of mass
    foot_half_width_m: float = 0.15
    foot_height_m: float = 0.1
    top_height_m: float = 0.08  # highest point above the centre of mass: what it lies on after turning over
    ground_friction: float = 0.7  # Coulomb coefficient
    battery_cells: int = 3
    battery_capacity_mah: float = 5000.0
    battery_resistance_ohm: float = 0.02
    battery_sag: bool = False  # whether the falling voltage takes thrust with it
    power_per_thrust: float = 20.0  # W/N^1.5 a rotor: electrical power = this · T^1.5
    idle_current_a: float = 0.5  # avionics
    owner: Owner = Owner()

    def __post_init__(self) -> None:
        """Turn sequences into float64 arrays and check them."""
        for field in ("linear_drag_kg_s", "angular_drag_kg_m2_s"):
            if getattr(self, field) is None:
                object.__setattr__(self, field, np.zeros(3))
        faults: list[str] = []
        for field, dimensions in _ARRAYS.items():
            try:
                array = np.array(getattr(self, field), dtype=np.float64)
            except (TypeError, ValueError):
                array = np.empty(0)
            if array.ndim != dimensions or not np.isfinite(array).all() or array.size == 0:
                faults.append(f"{field} must be {dimensions}-dimensional and all finite numbers")
            object.__setattr__(self, field, array)
        if not faults:
            faults = self._faults()
        if faults:
            raise VehicleError(f"vehicle {self.name!r}: " + "; ".join(faults))

    def _faults(self) -> list[str]:
        count = self.rotor_count
        faults = []
        if not 3 <= count <= MAX_ROTORS:
            faults.append(f"{count} rotors, must be 3 to {MAX_ROTORS}")
        shapes = {
            "inertia_kg_m2": (3,),
            "rotor_position_frd": (count, 3),
            "rotor_spin": (count,),
            "max_thrust_newton": (count,),
            "linear_drag_kg_s": (3,),
            "angular_drag_kg_m2_s": (3,),
        }
        faults += [
            f"{field} has shape {getattr(self, field).shape}, must be {shape}"
            for field, shape in shapes.items()
            if getattr(self, field).shape != shape
        ]
        if faults:
            return faults
        positive: tuple[str, ...] = (
            "mass_kg",
            "gravity_m_s2",
            "rotor_radius_m",
            "foot_half_length_m",
            "foot_half_width_m",
        )
        positive += ("foot_height_m", "top_height_m", "battery_capacity_mah", "battery_cells")
        faults += [
            f"{field} is {getattr(self, field)}, must be above 0"
            for field in positive
            if not getattr(self, field) > 0
        ]
        not_negative: tuple[str, ...] = (
            "torque_per_thrust_m",
            "rotor_lag_rad_s",
            "rotor_drag_kg_s",
            "ground_effect",
            "ground_friction",
        )
        not_negative += ("battery_resistance_ohm", "power_per_thrust", "idle_current_a")
        faults += [
            f"{field} is {getattr(self, field)}, must not be negative"
            for field in not_negative
            if not getattr(self, field) >= 0
        ]
        if not 0.0 <= self.thrust_curve <= 1.0:
            faults.append(f"thrust_curve is {self.thrust_curve}, must be 0 to 1")
        if not (np.abs(self.rotor_spin) == 1.0).all():
            faults.append("rotor_spin must be +1 or −1 for each rotor")
        if not (self.max_thrust_newton > 0).all():
            faults.append("max_thrust_newton must be above 0 for each rotor")
        if (self.linear_drag_kg_s < 0).any() or (self.angular_drag_kg_m2_s < 0).any():
            faults.append("drag must not be negative")
        a, b, c = sorted(self.inertia_kg_m2)
        if a <= 0 or a + b < c:
            faults.append(
                f"inertia {self.inertia_kg_m2.tolist()} is of no solid body (each below the sum of the other two)"
            )
        if not faults and self.max_thrust_newton.sum() <= self.mass_kg * self.gravity_m_s2:
            faults.append("all rotors together do not lift the mass")
        return faults

    @property
    def rotor_count(self) -> int:
        """Number of rotors."""
        return int(np.atleast_2d(self.rotor_position_frd).shape[0])

    @property
    def hover_command(self) -> float:
        """Motor command (0..1), the same for all rotors, whose static thrust equals the weight far from the ground."""
        ratio = self.mass_kg * self.gravity_m_s2 / float(self.max_thrust_newton.sum())
        k = self.thrust_curve
        return ratio if k == 0.0 else float((k - 1.0 + np.sqrt((1.0 - k) ** 2 + 4.0 * k * ratio)) / (2.0 * k))

    def allocation_frd(self) -> FloatArray:
        """Matrix (4, N) from rotor thrusts in N to [thrust upward N, torque about FRD x, y, z N·m]."""
        x, y = self.rotor_position_frd[:, 0], self.rotor_position_frd[:, 1]
        return np.array([np.ones_like(x), -y, x, self.torque_per_thrust_m * self.rotor_spin])

    def packed(self) -> FloatArray:
        """A fresh float64 array (PARAMETERS_SIZE,), laid out as the constants of this module say."""
        n = self.rotor_count
        packed = np.zeros(PARAMETERS_SIZE)
        packed[MASS] = self.mass_kg
        packed[INERTIA : INERTIA + 3] = self.inertia_kg_m2
        packed[GRAVITY] = self.gravity_m_s2
        packed[TORQUE_PER_THRUST] = self.torque_per_thrust_m
        packed[ROTOR_LAG] = self.rotor_lag_rad_s if self.rotor_lag_rad_s > 0 else np.inf
        packed[THRUST_CURVE] = self.thrust_curve
        packed[LINEAR_DRAG : LINEAR_DRAG + 3] = self.linear_drag_kg_s
        packed[ANGULAR_DRAG : ANGULAR_DRAG + 3] = self.angular_drag_kg_m2_s
        packed[ROTOR_DRAG] = self.rotor_drag_kg_s
        packed[ROTOR_RADIUS] = self.rotor_radius_m
        packed[GROUND_EFFECT] = self.ground_effect
        packed[FRICTION] = self.ground_friction
        packed[ROTOR_COUNT] = n
        packed[BATTERY_CELLS] = self.battery_cells
        packed[BATTERY_CAPACITY] = self.battery_capacity_mah * 3.6
        packed[BATTERY_RESISTANCE] = self.battery_resistance_ohm
        packed[BATTERY_SAG] = float(self.battery_sag)
        packed[ROTOR_POWER] = self.power_per_thrust
        packed[IDLE_CURRENT] = self.idle_current_a
        packed[ROTOR_POSITION : ROTOR_POSITION + 3 * n] = self.rotor_position_frd.ravel()
        packed[ROTOR_SPIN : ROTOR_SPIN + n] = self.rotor_spin
        packed[MAX_THRUST : MAX_THRUST + n] = self.max_thrust_newton
        packed[ROTOR_EFFECTIVENESS : ROTOR_EFFECTIVENESS + n] = 1.0
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [
            self.foot_half_length_m,
            self.foot_half_width_m,
        ]
        feet = np.column_stack([corners, np.full(4, self.foot_height_m)])
        top = np.column_stack([corners, np.full(4, -self.top_height_m)])
        packed[CONTACT_POINT:] = np.concatenate([feet, top]).ravel()
        return packed


_ARRAYS = {
    "inertia_kg_m2": 1,
    "rotor_position_frd": 2,
    "rotor_spin": 1,
    "max_thrust_newton": 1,
    "linear_drag_kg_s": 1,
    "angular_drag_kg_m2_s": 1,
}


def set_mass(parameters: FloatArray, mass_kg: float, inertia_kg_m2: FloatArray | None = None) -> None:
    """Change mass (and inertia (3,) kg·m²) of packed `parameters` in place: payload dropped at the centre of mass.

    Raises `VehicleError` for anything not above zero.
    """
    if not mass_kg > 0 or (inertia_kg_m2 is not None and not (np.asarray(inertia_kg_m2) > 0).all()):
        raise VehicleError(f"mass {mass_kg} kg and inertia {inertia_kg_m2} kg·m² must be above 0")
    parameters[MASS] = mass_kg
    if inertia_kg_m2 is not None:
        parameters[INERTIA : INERTIA + 3] = inertia_kg_m2


def set_rotor_effectiveness(parameters: FloatArray, rotor: int, effectiveness: float) -> None:
    """Let `rotor` (counted from 0) give `effectiveness` (0 dead .. 1 whole) of its thrust, in place.

    Raises `VehicleError` when there is no such rotor.
    """
    if not 0 <= rotor < int(parameters[ROTOR_COUNT]):
        raise VehicleError(f"there is no rotor {rotor}: count from 0 to {int(parameters[ROTOR_COUNT]) - 1}")
    parameters[ROTOR_EFFECTIVENESS + rotor] = effectiveness


def calm_environment(vehicle: VehicleParameters) -> FloatArray:
    """A fresh environment (ENVIRONMENT_SIZE,): no wind, no pushes; standing on the ground its centre is at z = 0."""
    environment = np.zeros(ENVIRONMENT_SIZE)
    environment[GROUND_DOWN] = vehicle.foot_height_m
    return environment


def initial_state(
    vehicle: VehicleParameters,
    position_ned: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw_rad: float = 0.0,
) -> FloatArray:
    """A fresh state (STATE_SIZE,): level, motionless, rotors stopped, battery full, heading `yaw_rad` (NED, clockwise)."""
    state = np.zeros(STATE_SIZE)
    state[POSITION_NED] = position_ned
    state[QUATERNION_WXYZ] = [np.cos(yaw_rad / 2.0), 0.0, 0.0, np.sin(yaw_rad / 2.0)]
    state[SPECIFIC_FORCE + 2] = -vehicle.gravity_m_s2
    state[BATTERY_VOLTAGE] = 4.2 * vehicle.battery_cells
    return state


def _shipped() -> Path:
    return Path(__file__).parent / "vehicles"


def vehicle_names() -> list[str]:
    """Names of the vehicles that come with the stub, sorted."""
    return sorted(
        entry.name.removesuffix(".toml") for entry in _shipped().iterdir() if entry.name.endswith(".toml")
    )


def load_vehicle(name_or_path: str | Path, **changes: Any) -> VehicleParameters:
    """The shipped vehicle of that name, `random:SEED`, or one from a TOML file; `changes` replace single fields.

    Raises `VehicleError` naming the file, every fault in it and, for an unknown name, the names there are.
    """
    if str(name_or_path).startswith("random:"):
        return replace(_random(str(name_or_path)), **changes)
    text, where = _read(name_or_path)
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise VehicleError(f"{where} is not TOML: {error}") from error
    known = {field.name for field in fields(VehicleParameters)} - {"owner"}
    required = {"mass_kg", "inertia_kg_m2", "rotor_position_frd", "rotor_spin", "max_thrust_newton"}
    required |= {"torque_per_thrust_m", "rotor_lag_rad_s"}
    unknown, missing = sorted(set(table) - known), sorted(required - set(table))
    if unknown or missing:
        parts = [f"unknown: {', '.join(unknown)}"] if unknown else []
        parts += [f"missing: {', '.join(missing)}"] if missing else []
        raise VehicleError(f"{where}: {'; '.join(parts)} (fields are those of VehicleParameters)")
    table.setdefault("name", Path(where).stem)
    _check_types(table, where)
    try:
        vehicle = VehicleParameters(**table)
        return replace(vehicle, **changes) if changes else vehicle
    except VehicleError as error:
        raise VehicleError(f"{where}: {error}") from error


def _random(name: str) -> VehicleParameters:
    from sitl_stub.physics.random_vehicle import random_vehicle  # which is made of what stands here

    seed = name.removeprefix("random:")
    if not seed.isdecimal():
        raise VehicleError(f"vehicle {name!r}: give random:SEED with a whole number, for example random:7")
    return random_vehicle(int(seed))


def _read(name_or_path: str | Path) -> tuple[str, str]:
    """Text of the vehicle's file and how to call that file in an error."""
    name = str(name_or_path)
    if name in vehicle_names():
        return (_shipped() / f"{name}.toml").read_text(encoding="utf-8"), f"{name}.toml"
    path = Path(name)
    if path.suffix != ".toml":
        raise VehicleError(
            f"unknown vehicle {name!r}: choose from {', '.join(vehicle_names())}, random:SEED, or name a .toml file"
        )
    try:
        return path.read_text(encoding="utf-8"), name
    except (OSError, UnicodeDecodeError) as error:
        raise VehicleError(f"cannot read the vehicle file {name}: {error}") from error


def _check_types(table: Mapping[str, object], where: str) -> None:
    """Refuse text or tables where numbers belong."""
    wrong = []
    for key, value in table.items():
        if key in _ARRAYS:
            continue
        expected = str if key == "name" else bool if key == "battery_sag" else (int, float)
        if not isinstance(value, expected) or (isinstance(value, bool) and key != "battery_sag"):
            wrong.append(f"{key} = {value!r} is of the wrong type")
    if wrong:
        raise VehicleError(f"{where}: {'; '.join(wrong)}")
