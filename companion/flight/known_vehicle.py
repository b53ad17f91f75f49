"""The vehicle of a flight: what was written of it, and, once its parameters are read, what its autopilot tells."""

from __future__ import annotations

from companion.autopilot.adapter import Finding, Verdict
from companion.autopilot.attitude_response import MeasuredResponse
from companion.autopilot.vehicle_parameters import summary
from companion.config.profile import VehicleProfile
from companion.config.provenance import Known, is_given, provenance, tables_of
from companion.config.settings import Settings, resolved
from companion.flight.reporter import Reporter
from companion.flight.vehicle import Vehicle

UNLIKELY = 1.5
"""A mass or lag that is written so many times as large or small as the vehicle's is another vehicle's."""
MEASURED = "measured in flight"
MEASURED_LAG_MARGIN = 1.1
"""What is left unknown: the fit is to calm motion, and large turns may take longer."""


class KnownVehicle:
    """See the module. `settings` are those of the flight as far as is known by now."""

    def __init__(self, settings: Settings, reporter: Reporter) -> None:
        self.settings = settings
        self._reporter = reporter
        self._told: list[Known] | None = None
        self.autopilot: str | None = None

    @property
    def profile(self) -> VehicleProfile:
        """The vehicle."""
        return self.settings.profile

    def learn(self, vehicle: Vehicle) -> None:
        """Put what the parameters tell where nobody has written anything, and say it once. Raises UserError."""
        given = self.settings.given
        if given is None:
            return
        self.autopilot = key = vehicle.adapter.profile_key
        heartbeat = vehicle.link.heartbeat
        told = vehicle.adapter.tells(
            vehicle.parameters.values, heartbeat.type if heartbeat is not None else 0
        )
        used = [item for item in told if not is_given(given, item.key)]
        if is_given(given, f"responses.{key}"):  # its author has looked: no margin for that
            used = [item for item in used if item.key != "lag_margin"]
        first, self._told = self._told is None, used
        self.settings = resolved(
            self.settings.flight, given, self.settings.overrides, tables_of(used), autopilot=key
        )
        if first and (text := summary(used)):
            self._reporter.say(f"from the autopilot: {text}")

    def doubts(self, vehicle: Vehicle) -> list[Finding]:
        """Where what somebody wrote of the vehicle cannot be this one's, by its parameters or its simulator's."""
        given, key = self.settings.given, self.autopilot
        if given is None or key is None:
            return []
        found = []
        if vehicle.adapter.mass_parameter and is_given(given, "mass_kg") and vehicle.simulated:
            vehicle.read_parameters((vehicle.adapter.mass_parameter,))
            mass_kg = vehicle.parameters.values.get(vehicle.adapter.mass_parameter)
            if mass_kg and not 1.0 / UNLIKELY < self.profile.mass_kg / mass_kg < UNLIKELY:
                found.append(
                    self._doubt(
                        "mass", f"{mass_kg:.3g} kg in the simulator", f"{self.profile.mass_kg:.3g} kg"
                    )
                )
        response = self.profile.response(key)
        total_s = response.dead_time_s + response.tilt.lag_s
        told_s = self._told_lag_s(vehicle, key)
        if is_given(given, f"responses.{key}") and not 1.0 / UNLIKELY < total_s / told_s < UNLIKELY:
            found.append(self._doubt("attitude lag", f"{told_s:.2f} s by its parameters", f"{total_s:.2f} s"))
        return found

    def _doubt(self, subject: str, found: str, written: str) -> Finding:
        return Finding(
            Verdict.WARNING,
            subject,
            f"{found}, profile {self.profile.name!r} says {written}",
            "is this the profile of this vehicle?",
            "choose another --profile, or none: what the autopilot tells is then flown and measured",
        )

    def _told_lag_s(self, vehicle: Vehicle, key: str) -> float:
        told = {item.key: item.value for item in vehicle.adapter.tells(vehicle.parameters.values, 0)}
        head = f"responses.{key}."
        tilt = 2.0 * told[head + "tilt.damping"] / told[head + "tilt.natural_frequency_rad_s"]
        return float(told[head + "dead_time_s"] + tilt)

    def measured(self, response: MeasuredResponse) -> bool:
        """Put what was measured in flight in place of what the parameters told; False where somebody wrote it.

        Raises UserError as `learn`.
        """
        given, key = self.settings.given, self.autopilot
        head = f"responses.{key}."
        if given is None or key is None or self._told is None or is_given(given, f"responses.{key}"):
            return False
        sure = f"within {max(1.0, 100.0 * response.deviation):.0f} %"
        found = [
            Known(head + "dead_time_s", response.dead_time_s, MEASURED, sure),
            Known(
                head + "tilt.natural_frequency_rad_s", response.tilt.natural_frequency_rad_s, MEASURED, sure
            ),
            Known(head + "tilt.damping", response.tilt.damping, MEASURED, sure),
            Known("lag_margin", MEASURED_LAG_MARGIN, "default", "of a response measured in flight"),
        ]
        keys = {item.key for item in found}
        self._told = [
            *(item for item in self._told if item.key not in keys),
            *(item for item in found if not is_given(given, item.key)),
        ]
        self.settings = resolved(
            self.settings.flight, given, self.settings.overrides, tables_of(self._told), autopilot=key
        )
        return True

    def provenance(self) -> list[Known]:
        """Every number of the vehicle and the gains, with where it came from."""
        return provenance(self.settings, self._told or [], self.autopilot)
