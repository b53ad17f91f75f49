"""Faults of the vehicle and the air: a rotor, the battery, the payload, a gust."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sitl_stub.faults.fault import Effect, Fault, Site, hold, number, switch, whole
from sitl_stub.physics import vehicle as body

if TYPE_CHECKING:
    from sitl_stub.physics.vehicle import VehicleParameters

LIGHTEST = 0.2
"""Share of mass and inertia that is left whatever is dropped."""


@dataclass(frozen=True)
class MotorFailure(Fault):
    """A rotor gives only a share of its thrust."""

    kind = "motor_failure"
    rotor: int = whole(0, "which one, counted from 0 as in the vehicle's file", 0, body.MAX_ROTORS - 1)
    thrust_share: float = number(0.0, "", "what is left of its thrust", 0.0, 1.0)

    def refusal(self, firmware: str, vehicle: VehicleParameters) -> str | None:
        """A rotor the vehicle has not got."""
        if self.rotor < vehicle.rotor_count:
            return None
        return (
            f"rotor {self.rotor} is not on vehicle {vehicle.name}: count from 0 to {vehicle.rotor_count - 1}"
        )

    def act(self, site: Site) -> Effect:
        """Weaken it."""

        def use(share: float) -> None:
            body.set_rotor_effectiveness(site.autopilot.core.parameters_packed, self.rotor, share)

        with site.setting(f"rotor {self.rotor}", self.thrust_share, use, otherwise=1.0):
            yield from hold()


@dataclass(frozen=True)
class BatteryCritical(Fault):
    """The battery is suddenly nearly empty, and as before at the end where there is one."""

    kind = "battery_critical"
    remaining: float = number(0.06, "", "share of the charge that is left", 0.0, 1.0)
    sag: bool = switch(False, "the rotors' thrust falls with the voltage")

    def act(self, site: Site) -> Effect:
        """Take the charge away."""
        core = site.autopilot.core
        left = self.remaining * core.parameters_packed[body.BATTERY_CAPACITY]
        taken = core.parameters_packed[body.BATTERY_CAPACITY] - left - core.state[body.CHARGE_USED]
        core.state[body.CHARGE_USED] += taken
        normally = float(core.vehicle.battery_sag)

        def use(steady: float) -> None:
            core.parameters_packed[body.BATTERY_SAG] = max(normally, 1.0 - steady)

        try:
            with site.setting("battery sag", 1.0 - float(self.sag), use, otherwise=1.0):
                yield from hold()
        finally:
            core.state[body.CHARGE_USED] = max(core.state[body.CHARGE_USED] - taken, 0.0)


@dataclass(frozen=True)
class PayloadDrop(Fault):
    """Part of the mass falls off at the centre of mass."""

    kind = "payload_drop"
    momentary = True
    mass_kg: float = number(0.2, "kg", "what falls off", 0.0, 100.0)
    inertia_share: float = number(1.0, "", "what is left of the moments of inertia", LIGHTEST, 1.0)

    def refusal(self, firmware: str, vehicle: VehicleParameters) -> str | None:
        """More than the vehicle can lose."""
        most = (1.0 - LIGHTEST) * vehicle.mass_kg
        if self.mass_kg <= most:
            return None
        return (
            f"mass_kg {self.mass_kg:g} is too much for vehicle {vehicle.name} of {vehicle.mass_kg:g} kg: "
            f"give at the most {most:.3g}"
        )

    def act(self, site: Site) -> Effect:
        """Drop it."""
        core = site.autopilot.core
        packed = core.parameters_packed
        mass = max(float(packed[body.MASS]) - self.mass_kg, LIGHTEST * core.vehicle.mass_kg)
        inertia = packed[body.INERTIA : body.INERTIA + 3] * self.inertia_share
        body.set_mass(packed, mass, np.maximum(inertia, LIGHTEST * core.vehicle.inertia_kg_m2))
        yield from ()


@dataclass(frozen=True)
class Gust(Fault):
    """A gust on top of the wind: rises and, where it ends, falls as half a cosine (MIL-F-8785C's discrete gust)."""

    kind = "gust"
    north_m_s: float = number(5.0, "m/s", "velocity of the air, north", -40.0, 40.0)
    east_m_s: float = number(0.0, "m/s", "east", -40.0, 40.0)
    down_m_s: float = number(0.0, "m/s", "down", -40.0, 40.0)
    rise_s: float = number(0.5, "s", "how long it rises and falls; 0: at once", 0.0, 60.0)

    def act(self, site: Site) -> Effect:
        """Blow."""
        from sitl_stub.physics.wind import (
            STEADY,  # here, for it loads numba: the ready line does not wait for that
        )

        wind = site.autopilot.core.wind.wind[STEADY : STEADY + 3]
        full = np.array([self.north_m_s, self.east_m_s, self.down_m_s])
        given = np.zeros(3)
        try:
            while True:
                wanted = full * self._share(site)
                wind += wanted - given
                given = wanted
                yield
        finally:
            wind -= given

    def _share(self, site: Site) -> float:
        if self.rise_s <= 0.0:
            return 1.0
        progress = min(site.elapsed_s, site.left_s, self.rise_s) / self.rise_s
        return 0.5 - 0.5 * math.cos(math.pi * max(progress, 0.0))
