"""The plant of Eq. (1) for tests of the laws, written apart from `companion.control`: rotation matrices, no Euler angles.

RK4 on position, velocity, rotation matrix and body rate. Optional lags stand in for an autopilot: a second-order
attitude response behind a dead time, and first-order rotors.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from companion.control.structs import Reference, VehicleState

GRAVITY = 9.81


def skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotation_zyx(roll, pitch, yaw):
    c, s = np.cos, np.sin
    Rz = np.array([[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]])
    Ry = np.array([[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]])
    Rx = np.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
    return Rz @ Ry @ Rx


def quaternion_of(R):
    """Shepperd's method, Hamilton, scalar first."""
    trace = np.trace(R)
    candidates = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    k = int(np.argmax(candidates))
    if k == 0:
        q = np.array([1 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    elif k == 1:
        q = np.array([R[2, 1] - R[1, 2], 1 + 2 * R[0, 0] - trace, R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]])
    elif k == 2:
        q = np.array([R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], 1 + 2 * R[1, 1] - trace, R[1, 2] + R[2, 1]])
    else:
        q = np.array([R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1 + 2 * R[2, 2] - trace])
    return q / np.linalg.norm(q)


def matrix_of(q):
    w, x, y, z = q
    v = np.array([x, y, z])
    return np.eye(3) + 2 * w * skew(v) + 2 * skew(v) @ skew(v)


def exp_so3(v):
    angle = np.linalg.norm(v)
    if angle < 1e-12:
        return np.eye(3) + skew(v)
    K = skew(v / angle)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@dataclass
class Plant:
    """QBall2 by default. `level` is what it is commanded with: 'actuator', 'body_rate' or 'attitude'."""

    level: str = "actuator"
    mass: float = 1.79
    inertia: np.ndarray = field(default_factory=lambda: np.array([0.03, 0.03, 0.04]))
    drag: np.ndarray = field(default_factory=lambda: np.array([0.002, 0.002, 0.004]))
    rotational_drag: np.ndarray = field(default_factory=lambda: np.array([0.002, 0.002, 0.004]))
    rotor_lag_rad_s: float = 0.0  # 0: none
    frequency_rad_s: float = 8.4  # attitude response
    damping: float = 0.62
    yaw_frequency_rad_s: float = 4.6
    rate_lag_s: tuple = (0.1, 0.1, 0.25)
    dead_time_s: float = 0.0
    force: np.ndarray = field(default_factory=lambda: np.zeros(3))  # δ_p, N
    p: np.ndarray = field(default_factory=lambda: np.zeros(3))
    v: np.ndarray = field(default_factory=lambda: np.zeros(3))
    R: np.ndarray = field(default_factory=lambda: np.eye(3))
    w: np.ndarray = field(default_factory=lambda: np.zeros(3))
    thrust: float = 1.79 * GRAVITY
    torque: np.ndarray = field(default_factory=lambda: np.zeros(3))
    time: float = 0.0
    queue: deque = field(default_factory=deque)

    def start_on(self, reference, step=1e-4):
        """Put the vehicle on a path `reference(t)` at t = 0: thrust along p̈ + g, yaw 0, body rate by differences."""

        def attitude(t):
            a = reference(t).acceleration_enu + np.array([0, 0, GRAVITY])
            z = a / np.linalg.norm(a)
            y = np.cross(z, [1.0, 0, 0])
            y /= np.linalg.norm(y)
            return np.column_stack([np.cross(y, z), y, z])

        now = reference(0.0)
        self.p, self.v, self.R = now.position_enu.copy(), now.velocity_enu.copy(), attitude(0.0)
        turn = self.R.T @ (attitude(step) - attitude(-step)) / (2 * step)
        self.w = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
        self.thrust = self.mass * np.linalg.norm(now.acceleration_enu + np.array([0, 0, GRAVITY]))

    def state(self, noise=None):
        q = quaternion_of(self.R)
        p, v, w = self.p.copy(), self.v.copy(), self.w.copy()
        if noise is not None:
            p += noise.normal(0, 0.002, 3)
            v += noise.normal(0, 0.02, 3)
            w += noise.normal(0, 0.005, 3)
            q = quaternion_of(self.R @ exp_so3(noise.normal(0, 0.0035, 3)))
        return VehicleState(self.time, p, v, q, w)

    def command(self, setpoint):
        self.queue.append((self.time + self.dead_time_s, setpoint))

    def _angular(self, R, w, torque, setpoint):
        if self.level == "actuator":
            drag = self.rotational_drag * w
            return (torque - np.cross(w, self.inertia * w) - drag) / self.inertia
        if self.level == "body_rate":
            return (setpoint.body_rate_flu - w) / np.array(self.rate_lag_s)
        E = R.T @ matrix_of(setpoint.quaternion_wxyz)
        angle = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
        f = np.array([self.frequency_rad_s, self.frequency_rad_s, self.yaw_frequency_rad_s])
        return f**2 * angle - 2 * self.damping * f * w

    def advance(self, duration, step=0.002):
        count = max(1, round(duration / step))
        h = duration / count
        for _ in range(count):
            while len(self.queue) > 1 and self.queue[1][0] <= self.time + 1e-9:
                self.queue.popleft()
            setpoint = self.queue[0][1] if self.queue and self.queue[0][0] <= self.time + 1e-9 else None
            if setpoint is not None:
                settle = 1.0 if self.rotor_lag_rad_s == 0 else 1 - np.exp(-self.rotor_lag_rad_s * h)
                self.thrust += settle * (setpoint.thrust_newton - self.thrust)
                self.torque = self.torque + settle * (setpoint.torque_flu - self.torque)
            else:
                setpoint = _Hold(quaternion_of(self.R))

            def slope(v, R, w, setpoint=setpoint):
                a = (R[:, 2] * self.thrust - self.drag * v + self.force) / self.mass - [0, 0, GRAVITY]
                return v, a, self._angular(R, w, self.torque, setpoint)

            k1 = slope(self.v, self.R, self.w)
            R2 = self.R @ exp_so3(self.w * h / 2)
            k2 = slope(self.v + h / 2 * k1[1], R2, self.w + h / 2 * k1[2])
            k3 = slope(
                self.v + h / 2 * k2[1],
                self.R @ exp_so3((self.w + h / 4 * k1[2]) * h / 2),
                self.w + h / 2 * k2[2],
            )
            mean = self.w + h / 2 * k2[2]
            k4 = slope(self.v + h * k3[1], self.R @ exp_so3(mean * h), self.w + h * k3[2])
            self.p = self.p + h / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
            self.v = self.v + h / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
            self.R = self.R @ exp_so3(mean * h)
            self.w = self.w + h / 6 * (k1[2] + 2 * k2[2] + 2 * k3[2] + k4[2])
            self.time += h


@dataclass
class _Hold:
    quaternion_wxyz: np.ndarray
    thrust_newton: float = 1.79 * GRAVITY
    body_rate_flu: np.ndarray = field(default_factory=lambda: np.zeros(3))
    torque_flu: np.ndarray = field(default_factory=lambda: np.zeros(3))


def at_rest(position=(0.0, 0.0, 0.0), yaw=0.0):
    z = np.zeros(3)
    return Reference(np.array(position, dtype=float), z, z, z, z, float(yaw), 0.0, 0.0)


def sinusoid(t, amplitude, period, phase=0.0):
    """Position and four derivatives of A sin(2πt/T + φ)."""
    w = 2 * np.pi / period
    return [amplitude * w**n * np.sin(w * t + phase + n * np.pi / 2) for n in range(5)]


def lemniscate(t):
    """The report's x_d, y_d at constant height, ψ_d = 0 (control_laws.md, section 7)."""
    x, y = sinusoid(t, 0.5, 4.0), sinusoid(t, 1.0, 8.0, np.pi / 2)
    rows = [np.array([x[n], y[n], 1.0 if n == 0 else 0.0]) for n in range(5)]
    return Reference(*rows, 0.0, 0.0, 0.0)
