"""The thrust setpoint that carries the weight, estimated while flying.

Along world z, a vehicle whose setpoint u has come through the rotors moves with

    a_z + g = c · u · cos(tilt) ,   c = g / hover thrust

A scalar Kalman filter follows c. The acceleration is taken from differences of the estimated vertical velocity over
`SPAN_S`, the setpoint through the same dead time, rotor lag and span, so that the two belong together. Users
have lost vehicles to such estimators running away on the ground or in saturation: there this one stands still, it
never leaves `TRUST` times what it was told and what the lift-off showed, and it moves slowly.
"""

from __future__ import annotations

import math
from collections import deque

GRAVITY = 9.81
SPAN_S = 0.2
PROCESS_NOISE = 0.02
"""Of c, relative, per √s: a battery's sag and more."""
ACCELERATION_NOISE_M_S2 = 0.6
"""Of the differences, with gusts and the estimator's noise."""
FIRST_UNCERTAINTY = 0.25
"""Of the first value, relative: parameters are wrong by this much now and then."""
TRUST = 1.6
"""Bounds: first value, and that of the lift-off or of hovering, divided by and multiplied by this."""
FURTHEST = 2.5
"""A lift-off that tells a value farther than this from the first, as a factor, is not believed that far."""
CONTRADICTED = 1.35
"""Where a lift-off tells a value this far from the first, as a factor, the first was a guess: a stock parameter …"""
GUESS_UNCERTAINTY = 0.6
"""… and weighs as one, relative."""
LIFT_OFF_UNCERTAINTY = 0.1
"""Of the value read off a lift-off, relative: ground effect, the estimator's delay."""
HOVERING_UNCERTAINTY = 0.03
"""Of the value read off the autopilot's own hovering, relative: what a second of it leaves of gusts."""
GATE = 4.0
"""Innovations beyond this many standard deviations are not believed."""
PERSISTS_S = 1.0
"""For as long as they all lie on one side, it is the estimate that is not believed: it was read off something that was
no lift-off, say a deck that rose."""
RETURN_RATE = 0.1
"""Relative change per second with which such an estimate goes back: thrust follows at once, the law's integral, which
had made up for the error, in a second or two."""
MOST_PENDING = 256
"""Setpoints on their way to the rotors: 0.5 s of them at 500 Hz."""


class HoverThrustEstimator:
    """See the module. Values of `hover_thrust` are normalised setpoints, 0..1."""

    def __init__(self, first: float, dead_time_s: float, rotor_lag_rad_s: float) -> None:
        """Start at `first`; the setpoint acts after `dead_time_s` and a first-order lag of `rotor_lag_rad_s`."""
        self._first = first
        self._least, self._most = first / TRUST, first * TRUST
        self._slope = GRAVITY / first
        self._variance = (FIRST_UNCERTAINTY * self._slope) ** 2
        self._dead_time_s = dead_time_s
        self._lag_rad_s = rotor_lag_rad_s
        # (when it acts, setpoint); while nobody updates, as when idling on the ground, the oldest are forgotten
        self._pending: deque[tuple[float, float]] = deque(maxlen=MOST_PENDING)
        self._acting = first
        self._lagged = first
        self._effort = 0.0  # ∫ lagged setpoint · cos(tilt) dt
        self._past: deque[tuple[float, float, float]] = deque()  # time, vertical velocity, effort
        self._last_s = math.nan
        self._beyond_s = 0.0  # for how long every innovation was beyond the gate; its sign says on which side

    @property
    def hover_thrust(self) -> float:
        """The estimate."""
        return GRAVITY / self._slope

    @property
    def deviation(self) -> float:
        """Its standard deviation."""
        return self.hover_thrust * math.sqrt(self._variance) / self._slope

    def sent(self, time_s: float, thrust: float) -> None:
        """Note a setpoint sent at `time_s` (autopilot's clock)."""
        self._pending.append((time_s + self._dead_time_s, thrust))

    def lifted_off(self, thrust: float, slope_1_s: float, velocity_up_m_s: float) -> None:
        """Take what a lift-off tells: setpoint `thrust`, raised by `slope_1_s` a second, has led to this upward speed.

        The thrust u acts late by dead time and rotor lag, and beyond the balance h it grows linearly: v = g/h · slope τ²/2
        with τ since the balance, so thrust − slope · (lag + τ) = h, a quadratic equation for √h.
        """
        lag_s = self._dead_time_s + 1.0 / self._lag_rad_s
        b = math.sqrt(2.0 * max(velocity_up_m_s, 0.0) * slope_1_s / GRAVITY)
        root = 0.5 * (math.sqrt(b * b + 4.0 * max(thrust - slope_1_s * lag_s, 0.0)) - b)
        if root > 0.0:
            self._take(root * root, LIFT_OFF_UNCERTAINTY)

    def hovered(self, thrust: float) -> None:
        """Take the thrust at which the autopilot itself keeps the vehicle at its height (ATTITUDE_TARGET)."""
        self._take(thrust, HOVERING_UNCERTAINTY)

    def _take(self, told: float, uncertainty: float) -> None:
        """Hover thrust that the vehicle itself has shown, with its relative standard deviation."""
        hover = min(self._first * FURTHEST, max(self._first / FURTHEST, told))
        self._least, self._most = min(self._least, hover / TRUST), max(self._most, hover * TRUST)
        if not 1.0 / CONTRADICTED < hover / self._first < CONTRADICTED:
            self._variance = (GUESS_UNCERTAINTY * self._slope) ** 2
        self._weigh(GRAVITY, hover, uncertainty * GRAVITY)

    def update(self, time_s: float, velocity_up_m_s: float, cos_tilt: float, trusted: bool) -> None:
        """Take a state.

        Args:
            time_s: the autopilot's clock; states in order.
            velocity_up_m_s: world z.
            cos_tilt: between body z and world z.
            trusted: False on the ground, in saturation, with stale data or after a jump: the estimate then stands.
        """
        elapsed_s = time_s - self._last_s
        self._last_s = time_s
        if not 0.0 < elapsed_s < SPAN_S:  # the first state, or a gap
            self._past.clear()
            return
        while self._pending and self._pending[0][0] <= time_s:
            self._acting = self._pending.popleft()[1]
        self._lagged += -math.expm1(-self._lag_rad_s * elapsed_s) * (self._acting - self._lagged)
        self._effort += self._lagged * cos_tilt * elapsed_s
        if not trusted:
            self._past.clear()
            return
        self._past.append((time_s, velocity_up_m_s, self._effort))
        first_s, first_velocity, first_effort = self._past[0]
        span_s = time_s - first_s
        if span_s < SPAN_S:
            return
        self._past.clear()  # spans do not overlap: their noise is independent
        self._past.append((time_s, velocity_up_m_s, self._effort))
        self._correct(
            (velocity_up_m_s - first_velocity) / span_s + GRAVITY,
            (self._effort - first_effort) / span_s,
            span_s,
        )

    def _correct(self, force_per_mass: float, effort: float, span_s: float) -> None:
        self._variance += (PROCESS_NOISE * self._slope) ** 2 * span_s
        if self._weigh(force_per_mass, effort, ACCELERATION_NOISE_M_S2):
            self._beyond_s = 0.0
            return
        gap = force_per_mass - self._slope * effort
        side_s = math.copysign(span_s, gap)
        self._beyond_s = side_s + (self._beyond_s if self._beyond_s * side_s > 0.0 else 0.0)
        if abs(self._beyond_s) >= PERSISTS_S:
            self._set_slope(self._slope * (1.0 + RETURN_RATE * side_s))

    def _weigh(self, force_per_mass: float, effort: float, noise_m_s2: float) -> bool:
        """One measurement force/m = c · effort, in m/s² with its standard deviation; False if it is not believed."""
        innovation = force_per_mass - self._slope * effort
        spread = effort * effort * self._variance + noise_m_s2**2
        if innovation * innovation > GATE * GATE * spread:
            return False
        gain = self._variance * effort / spread
        self._set_slope(self._slope + gain * innovation)
        self._variance *= 1.0 - gain * effort
        return True

    def _set_slope(self, slope: float) -> None:
        self._slope = min(GRAVITY / self._least, max(GRAVITY / self._most, slope))
