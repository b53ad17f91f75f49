"""Faults of the autopilot's clock: what it writes into time stamps and TIMESYNC. What it does stays on time."""

from __future__ import annotations

from dataclasses import dataclass

from sitl_stub.faults.fault import Effect, Fault, Site, hold, number


@dataclass(frozen=True)
class ClockJump(Fault):
    """The autopilot's clock jumps, and back at the end where there is one; it never shows less than 0."""

    kind = "clock_jump"
    jump_s: float = number(1.0, "s", "how far; forward positive", -3600.0, 3600.0)

    def act(self, site: Site) -> Effect:
        """Put the clock wrong."""
        site.autopilot.clock.put_wrong(site.name, round(self.jump_s * 1e6))
        try:
            yield from hold()
        finally:
            site.autopilot.clock.put_wrong(site.name, 0)


@dataclass(frozen=True)
class ClockDrift(Fault):
    """The autopilot's clock runs fast or slow; what it has gained by the end stays."""

    kind = "clock_drift"
    drift_ppm: float = number(200.0, "ppm", "how fast; µs gained a second", -100000.0, 100000.0)

    def act(self, site: Site) -> Effect:
        """Put the clock wrong by a little more at every instant."""
        try:
            while True:
                self._gain(site)
                yield
        finally:
            self._gain(site)

    def _gain(self, site: Site) -> None:
        running_s = min(site.elapsed_s, max(site.autopilot.clock.uptime_us, 0) * 1e-6)
        site.autopilot.clock.put_wrong(site.name, round(self.drift_ppm * running_s))
