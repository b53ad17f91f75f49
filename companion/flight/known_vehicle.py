"""The vehicle of a flight: what was written of it, and, once its parameters are read, what its autopilot tells."""

from __future__ import annotations

from companion.autopilot.vehicle_parameters import summary
from companion.config.profile import VehicleProfile
from companion.config.provenance import Known, is_given, provenance, tables_of
from companion.config.settings import Settings, resolved
from companion.flight.reporter import Reporter
from companion.flight.vehicle import Vehicle


class KnownVehicle:
    """See the module. `settings` are those of the flight as far as is known by now."""

    def __init__(self, settings: Settings, reporter: Reporter) -> None:
        self.settings = settings
        self._reporter = reporter
        self._told: list[Known] | None = None
        self._autopilot: str | None = None

    @property
    def profile(self) -> VehicleProfile:
        """The vehicle."""
        return self.settings.profile

    def learn(self, vehicle: Vehicle) -> None:
        """Put what the parameters tell where nobody has written anything, and say it once. Raises UserError."""
        given = self.settings.given
        if given is None:
            return
        self._autopilot = key = vehicle.adapter.profile_key
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

    def provenance(self) -> list[Known]:
        """Every number of the vehicle and the gains, with where it came from."""
        return provenance(self.settings, self._told or [], self._autopilot)
