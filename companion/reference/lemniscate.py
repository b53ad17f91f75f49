"""The report's lemniscate (control_laws.md section 7), with every number a parameter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Reference
from companion.reference.trajectory import held_outside

_GONE = 100.0  # exp(-100) times any rise in metres is below the spacing of doubles near 1 m


@dataclass(frozen=True, slots=True)
class Lemniscate:
    """x = A sin(2πs/P), y = B cos(2πs/Q), z = h − r exp(−c s³), with s = speed · t; yaw constant.

    The defaults are the report's experiment. The report cuts the exponential at t = 5 s and continues
    with z = 1, which is a jump of 2.6 µm; here the exponential runs on (the difference from the report is
    at most those 2.6 µm and dies out within a second), so that every derivative is continuous.

    `scale` multiplies both horizontal amplitudes. `speed` runs the whole of it faster: velocities grow
    with speed, accelerations with its square. At t = 0 it is already moving, at speed · (A 2π/P) along x.
    """

    x_amplitude_m: float = 0.5
    y_amplitude_m: float = 1.0
    x_period_s: float = 4.0
    y_period_s: float = 8.0
    height_m: float = 1.0  # z in the end
    rise_m: float = 0.7  # how far below that it starts
    rise_rate: float = 0.1  # c, in 1/s³
    yaw_rad: float = 0.0
    scale: float = 1.0
    speed: float = 1.0
    duration_s: float = math.inf

    def __post_init__(self) -> None:
        """Refuse periods, speeds and durations that make no motion."""
        for name in ("x_period_s", "y_period_s", "speed", "duration_s"):
            if not getattr(self, name) > 0.0:
                raise UserError(f"lemniscate: {name} is {getattr(self, name):g}; it has to be above 0")
        if not self.rise_rate >= 0.0:
            raise UserError(f"lemniscate: rise_rate is {self.rise_rate:g}; it must not be below 0")

    def sample(self, time_s: float) -> Reference:
        """Return the reference at `time_s`; outside `[0, duration_s]` it stands still at that end."""
        if not 0.0 <= time_s <= self.duration_s:
            return held_outside(self, time_s)
        speed = self.speed
        s = speed * time_s

        wx = math.tau / self.x_period_s
        sin_x = self.scale * self.x_amplitude_m * math.sin(wx * s)
        cos_x = self.scale * self.x_amplitude_m * math.cos(wx * s)
        wy = math.tau / self.y_period_s
        sin_y = self.scale * self.y_amplitude_m * math.sin(wy * s)
        cos_y = self.scale * self.y_amplitude_m * math.cos(wy * s)
        wx *= speed
        wy *= speed

        c = self.rise_rate
        u = c * s * s * s
        z0, z1, z2, z3, z4 = self.height_m, 0.0, 0.0, 0.0, 0.0
        if u < _GONE:
            # Derivatives of exp(-c s³), each the exponential times a polynomial in s.
            decay = -self.rise_m * math.exp(-u)
            z0 += decay
            z1 = -3.0 * c * s * s * decay * speed
            z2 = c * s * (9.0 * u - 6.0) * decay * speed**2
            z3 = c * (54.0 * u - 27.0 * u * u - 6.0) * decay * speed**3
            z4 = c * c * s * s * (180.0 - 324.0 * u + 81.0 * u * u) * decay * speed**4

        x, y = sin_x, cos_y
        ax, ay = -wx * wx, -wy * wy  # each second derivative of a sine is the sine times this
        vx, vy = wx * cos_x, -wy * sin_y
        # One array and its parts: making five takes longer than all of the above.
        out = np.array(
            (x, y, z0, vx, vy, z1, ax * x, ay * y, z2, ax * vx, ay * vy, z3, ax * ax * x, ay * ay * y, z4)
        )
        return Reference(out[0:3], out[3:6], out[6:9], out[9:12], out[12:15], self.yaw_rad, 0.0, 0.0)
