"""What a flight of the campaign is made of, drawn from its firmware and its seed and nothing else."""

from __future__ import annotations

import random
import tomllib
from dataclasses import asdict, dataclass
from importlib import resources
from typing import Any

from campaign.faults import Fault, draw_faults, draw_traffic

FIRMWARES = ("px4", "ardupilot")

FENCE_HOLD_M = 0.02
"""`fence_margin_m.hold` with a tight fence, so that a plan may come near it; it ships as 0.25 m."""
EXTENT_M = {
    "lemniscate": 1.0,
    "lemniscate,scale=0.5": 0.5,
    "circle,radius_m=0.6,speed_m_s=0.6": 0.6,
    "step": 0.5,
    "hover": 0.0,
}
"""Trajectories that are flown, and how far from the place of take-off they go, m."""
WIDE_M = 30.0

_QUICK = (
    "flight.procedure.prove_s=1",
    "flight.procedure.hold_s=1.0",
    "flight.procedure.transit_speed_m_s=1.0",
    "flight.procedure.transit_acceleration_m_s2=1.2",
    "flight.procedure.transit_jerk_m_s3=4",
    "flight.procedure.connect_timeout_s=120",  # two programs on a machine with other work
    "flight.takeoff_height_m=0.8",
)


@dataclass(frozen=True, slots=True)
class Variation:
    """Factors on the vehicle that is flown; the profile, which the companion believes, stays as it ships."""

    mass: float = 1.0
    inertia: float = 1.0
    thrust: float = 1.0
    rotor_lag: float = 1.0
    drag_kg_s: float = 0.0
    """Added along each axis: the report's vehicle has next to none, and no wind would move it."""


@dataclass(frozen=True, slots=True)
class PlannedFlight:
    """One flight, as drawn. Times of kill and interrupts are simulated seconds after arming."""

    firmware: str  # px4 or ardupilot
    seed: int
    stub_firmware: str  # what sitl-stub calls it
    profile: str
    vehicle: str
    variation: Variation
    wind_m_s: float
    gust_m_s: float
    estimator: str
    level: str
    controller: str
    trajectory: str
    duration_s: float
    fence_radius_m: float
    faults: tuple[Fault, ...] = ()
    kill_at_s: float | None = None
    interrupts_at_s: tuple[float, ...] = ()
    gone_at_s: float | None = None
    """The autopilot itself is gone from then on: nothing is heard any more."""
    as_command: bool = False
    """Started as a process of its own, as a user does, without instruments inside."""

    @property
    def name(self) -> str:
        """`px4 123`."""
        return f"{self.firmware} {self.seed}"

    @property
    def quiet(self) -> bool:
        """Whether nothing is to go wrong: within what the profiles claim to bear, it has to be flown as planned."""
        return set(self.kinds) <= {"none", "other_traffic"}

    @property
    def kinds(self) -> tuple[str, ...]:
        """Everything that is done to it, in words; `none` when nothing is."""
        words = [fault.kind for fault in self.faults]
        words += ["companion_killed"] if self.kill_at_s is not None else []
        words += ["autopilot_gone"] if self.gone_at_s is not None else []
        words += ["ctrl_c" if len(self.interrupts_at_s) == 1 else "ctrl_c_twice"] * bool(self.interrupts_at_s)
        return tuple(sorted(words)) or ("none",)

    def has(self, *kinds: str) -> bool:
        """Whether one of these is done to it."""
        return any(kind in kinds for kind in self.kinds)

    def overrides(self) -> list[str]:
        """`--set` values."""
        tight = (
            [f"flight.safety.fence_margin_m.hold=[{FENCE_HOLD_M}, 0]"] if self.fence_radius_m < WIDE_M else []
        )
        silence = f"flight.safety.silence_s={3 if self.gone_at_s is not None else 30}"  # our clock, on a busy machine
        return [*_QUICK, silence, f"flight.safety.fence.radius_m={self.fence_radius_m:g}", *tight]

    def vehicle_file(self) -> str:
        """The varied vehicle, as the stub's TOML."""
        shipped = resources.files("sitl_stub") / "physics" / "vehicles" / f"{self.vehicle}.toml"
        table: dict[str, Any] = tomllib.loads(shipped.read_text(encoding="utf-8"))
        by = self.variation
        table["mass_kg"] *= by.mass
        table["rotor_lag_rad_s"] *= by.rotor_lag
        table["linear_drag_kg_s"] = [value + by.drag_kg_s for value in table["linear_drag_kg_s"]]
        table["inertia_kg_m2"] = [value * by.inertia for value in table["inertia_kg_m2"]]
        table["max_thrust_newton"] = [value * by.thrust for value in table["max_thrust_newton"]]
        return "".join(f"{key} = {_toml(value)}\n" for key, value in table.items())

    def to_json(self) -> dict[str, Any]:
        """For reports."""
        return asdict(self)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def planned(firmware: str, seed: int) -> PlannedFlight:
    """The flight that `firmware` and `seed` stand for; the same on every machine."""
    draw = random.Random(f"{firmware} {seed}")
    stub_firmware, profile, vehicle = firmware, "arducopter_sitl", "arducopter"
    level = draw.choices(("attitude", "body_rate"), (0.88, 0.12))[0]
    if firmware == "px4":
        profile = vehicle = draw.choices(("qball2", "px4_sih"), (0.7, 0.3))[0]
        if draw.random() < 0.08:
            stub_firmware, level, profile, vehicle = "px4-1.13", "actuator", "qball2", "qball2"
    elif draw.random() < 0.25:
        profile = vehicle = "qball2"
    trajectory = draw.choice(list(EXTENT_M))
    tight = draw.random() < 0.35
    slack_m = draw.uniform(0.03, 0.2)
    sort = draw.random()
    kill: float | None = None
    gone: float | None = None
    interrupts: tuple[float, ...] = ()
    faults: tuple[Fault, ...] = ()
    if sort < 0.08:
        pass
    elif sort < 0.15:
        kill = draw.uniform(1.0, 12.0)
    elif sort < 0.19:
        first = draw.uniform(0.5, 12.0)
        interrupts = (first,) if draw.random() < 0.6 else (first, first + draw.uniform(0.8, 3.0))
    elif sort < 0.21:
        gone = draw.uniform(0.0, 12.0)
    else:
        count = 1 if draw.random() < 0.5 else 2
        faults = draw_faults(draw, firmware, count)
    if draw.random() < 0.2:
        traffic = draw_traffic(draw)
        faults = (*(fault for fault in faults if fault.kind != traffic.kind), traffic)
    pushed = any(fault.kind in ("gust", "link_delay", "link_jitter") for fault in faults)
    tight = tight or (pushed and draw.random() < 0.6)
    wild = bool(faults)
    return PlannedFlight(
        firmware=firmware,
        seed=seed,
        stub_firmware=stub_firmware,
        profile=profile,
        vehicle=vehicle,
        variation=Variation(
            mass=round(draw.uniform(0.85, 1.1), 3),
            inertia=round(draw.uniform(0.85, 1.2), 3),
            thrust=round(draw.uniform(0.85, 1.15), 3),
            rotor_lag=round(draw.uniform(0.8, 1.25), 3),
            drag_kg_s=round(draw.uniform(0.02, 0.12), 3) if vehicle == "qball2" else 0.0,
        ),
        wind_m_s=round(draw.uniform(0.0, 4.0), 2) if draw.random() < 0.6 else 0.0,
        gust_m_s=round(draw.uniform(0.0, 2.0), 2) if draw.random() < 0.5 else 0.0,
        estimator=draw.choices(("mocap", "gps", "perfect"), (0.65, 0.25, 0.1))[0],
        level=level,
        controller=draw.choices(("dtlannc", "tlmbc", "nnsmc"), (0.6, 0.2, 0.2))[0],
        trajectory=trajectory,
        duration_s=round(draw.uniform(3.0, 6.0), 1),
        fence_radius_m=round(EXTENT_M[trajectory] + FENCE_HOLD_M + slack_m, 3) if tight and wild else WIDE_M,
        faults=faults,
        kill_at_s=kill,
        interrupts_at_s=interrupts,
        gone_at_s=gone,
        as_command=kill is None and gone is None and not interrupts and draw.random() < 0.02,
    )
