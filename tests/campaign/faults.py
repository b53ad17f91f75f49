"""Faults of the stub, as drawn, and the scenario file that tells the stub of them (`sitl-stub --scenario`)."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, replace

Value = float | str | bool | tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Fault:
    """One `[[fault]]` of a scenario. `parameters` are those of its kind, as pairs."""

    kind: str
    after: str
    at_s: float
    for_s: float | None
    parameters: tuple[tuple[str, Value], ...] = ()

    def value(self, name: str) -> Value | None:
        """A parameter; None when it was left at its default."""
        return dict(self.parameters).get(name)

    def to_toml(self) -> str:
        """The table."""
        lines = ["[[fault]]", f'kind = "{self.kind}"', f'after = "{self.after}"', f"at_s = {self.at_s}"]
        lines += [] if self.for_s is None else [f"for_s = {self.for_s}"]
        lines += [f"{key} = {_toml(value)}" for key, value in self.parameters]
        return "\n".join(lines) + "\n"


def _toml(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(f'"{item}"' for item in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def scenario(seed: int, faults: tuple[Fault, ...]) -> str:
    """The whole file."""
    return "\n".join([f"seed = {seed}\n", *(fault.to_toml() for fault in faults)])


Drawn = Callable[[random.Random, str], Fault]
IN_FLIGHT_S = (0.5, 9.0)
"""After lift-off; a flight tracks from about 6 s to 11 s after it."""


def _lasting(kind: str, for_s: tuple[float, float], **ranges: tuple[float, float]) -> Drawn:
    """A fault in flight that lasts, with evenly distributed parameters."""

    def drawn(draw: random.Random, firmware: str) -> Fault:
        values = tuple((name, round(draw.uniform(*limits), 3)) for name, limits in ranges.items())
        return Fault(kind, "airborne", _moment(draw), round(draw.uniform(*for_s), 2), values)

    return drawn


def _moment(draw: random.Random) -> float:
    return round(draw.uniform(*IN_FLIGHT_S), 2)


def _link(kind: str, for_s: tuple[float, float], **ranges: tuple[float, float]) -> Drawn:
    """A fault of the link: one way or both, from the start for a while, or in flight."""

    def drawn(draw: random.Random, firmware: str) -> Fault:
        values: list[tuple[str, Value]] = [("direction", draw.choice(("both", "to_client", "from_client")))]
        values += [(name, round(draw.uniform(*limits), 3)) for name, limits in ranges.items()]
        if draw.random() < 0.2:
            return Fault(kind, "start", round(draw.uniform(0.5, 3.0), 2), 40.0, tuple(values))
        return Fault(kind, "airborne", _moment(draw), round(draw.uniform(*for_s), 2), tuple(values))

    return drawn


def _answers(kind: str) -> Drawn:
    """Answers that are lost from the start on, for a while or for good."""

    def drawn(draw: random.Random, firmware: str) -> Fault:
        share = draw.choice((0.3, 0.6, 1.0))
        for_s = None if draw.random() < 0.3 else round(draw.uniform(0.5, 15.0), 2)
        return Fault(
            kind,
            draw.choice(("start", "armed")),
            round(draw.uniform(0.0, 8.0), 2),
            for_s,
            (("probability", share),),
        )

    return drawn


def _bits(draw: random.Random, firmware: str) -> Fault:
    fault = _link("link_corrupt", (1.0, 8.0), probability=(0.02, 0.5))(draw, firmware)
    return replace(fault, parameters=(*fault.parameters, ("bits", draw.choice((1, 2, 8, 40)))))


def _momentary(kind: str, **ranges: tuple[float, float]) -> Drawn:
    """A fault in flight that happens at once."""

    def drawn(draw: random.Random, firmware: str) -> Fault:
        return replace(_lasting(kind, (1.0, 1.0), **ranges)(draw, firmware), for_s=None)

    return drawn


def _streams(draw: random.Random, firmware: str) -> Fault:
    choices = (
        ("LOCAL_POSITION_NED",),
        ("ATTITUDE_QUATERNION",),
        ("HEARTBEAT",),
        STATES,
        (*STATES, "ATTITUDE"),
    )
    return Fault(
        "stream_stop",
        "airborne",
        _moment(draw),
        round(draw.uniform(0.1, 12.0), 2),
        (("messages", draw.choice(choices)),),
    )


def _jump(draw: random.Random, firmware: str) -> Fault:
    jump_s = draw.choice((-1.0, 1.0)) * round(10.0 ** draw.uniform(-2.0, 1.5), 3)
    for_s = round(draw.uniform(0.5, 5.0), 2) if draw.random() < 0.5 else None
    return Fault("clock_jump", "airborne", _moment(draw), for_s, (("jump_s", jump_s),))


def _sideways(kind: str, most: float, turn_deg: float, unit: str, momentary: bool) -> Drawn:
    """The estimate goes astray by a draw of `most` along each axis, and turns by `turn_deg` in a third of the cases."""

    def drawn(draw: random.Random, firmware: str) -> Fault:
        size = most * draw.random() ** 2
        names = (f"north_m{unit}", f"east_m{unit}", f"down_m{unit}")
        values: list[tuple[str, Value]] = [(name, round(size * draw.uniform(-1.0, 1.0), 3)) for name in names]
        if draw.random() < 0.33:
            values.append((f"yaw_deg{unit}", round(draw.uniform(-turn_deg, turn_deg), 1)))
        if momentary:
            return Fault(kind, "airborne", _moment(draw), None, tuple(values))
        values.append(("recovers", draw.random() < 0.7))
        return Fault(kind, "airborne", _moment(draw), round(draw.uniform(0.5, 8.0), 2), tuple(values))

    return drawn


def _pilot_mode(draw: random.Random, firmware: str) -> Fault:
    mode = draw.choice(("position", "altitude", "manual", "hold", "return", "land"))
    after = draw.choice(("armed", "airborne", "airborne"))
    for_s = round(draw.uniform(0.1, 3.0), 2) if draw.random() < 0.4 else None
    return Fault("pilot_mode", after, _moment(draw), for_s, (("mode", mode),))


def _pilot_sticks(draw: random.Random, firmware: str) -> Fault:
    values = [(name, round(draw.uniform(-0.9, 0.9), 2)) for name in ("roll", "pitch", "yaw")]
    return Fault(
        "pilot_sticks",
        "airborne",
        _moment(draw),
        round(draw.uniform(0.3, 3.0), 2),
        (*values, ("throttle", round(draw.uniform(0.3, 0.7), 2))),
    )


def _motor(draw: random.Random, firmware: str) -> Fault:
    share = 0.0 if draw.random() < 0.3 else round(draw.uniform(0.3, 0.95), 2)
    for_s = round(draw.uniform(0.1, 4.0), 2) if draw.random() < 0.5 else None
    return Fault(
        "motor_failure",
        "airborne",
        _moment(draw),
        for_s,
        (("rotor", draw.randrange(4)), ("thrust_share", share)),
    )


def _battery(draw: random.Random, firmware: str) -> Fault:
    for_s = round(draw.uniform(1.0, 8.0), 2) if draw.random() < 0.3 else None
    remaining = round(draw.uniform(0.01, 0.22), 3)
    values: tuple[tuple[str, Value], ...] = (("remaining", remaining), ("sag", draw.random() < 0.3))
    return Fault("battery_critical", "airborne", round(draw.uniform(0.0, 4.0), 2), for_s, values)


def _gust(draw: random.Random, firmware: str) -> Fault:
    strength = (
        draw.uniform(2.0, 12.0) if firmware == "ardupilot" else draw.uniform(4.0, 25.0)
    )  # by their drag
    values: list[tuple[str, Value]] = [
        (name, round(share * strength * draw.uniform(-1.0, 1.0), 2))
        for name, share in (("north_m_s", 1.0), ("east_m_s", 1.0), ("down_m_s", 0.4))
    ]
    return Fault(
        "gust",
        "airborne",
        _moment(draw),
        round(draw.uniform(1.0, 6.0), 2),
        (*values, ("rise_s", round(draw.uniform(0.1, 1.0), 2))),
    )


STATES = ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION")
"""What the companion asks for to know where it is."""

KINDS: dict[str, Drawn] = {
    "link_loss": _link("link_loss", (0.1, 8.0), probability=(0.05, 1.0)),
    "link_delay": _link("link_delay", (0.5, 8.0), delay_s=(0.01, 0.6)),
    "link_jitter": _link("link_jitter", (0.5, 8.0), jitter_s=(0.005, 0.3)),
    "link_duplicate": _link("link_duplicate", (1.0, 10.0), probability=(0.05, 1.0)),
    "link_reorder": _link("link_reorder", (1.0, 8.0), probability=(0.02, 0.6), delay_s=(0.01, 0.3)),
    "link_corrupt": _bits,
    "link_truncate": _link("link_truncate", (1.0, 8.0), probability=(0.02, 0.5)),
    "ack_loss": _answers("ack_loss"),
    "parameter_loss": _answers("parameter_loss"),
    "stream_stop": _streams,
    "reboot": _momentary("reboot", silent_s=(0.0, 5.0)),
    "clock_jump": _jump,
    "clock_drift": _lasting("clock_drift", (2.0, 15.0), drift_ppm=(-50000.0, 50000.0)),
    "estimator_reset": _sideways("estimator_reset", 6.0, 90.0, "", momentary=True),
    "estimator_divergence": _sideways("estimator_divergence", 2.0, 20.0, "_s", momentary=False),
    "estimator_invalid": _lasting("estimator_invalid", (0.1, 6.0)),
    "gps_loss": _lasting("gps_loss", (0.5, 10.0)),
    "pilot_mode": _pilot_mode,
    "pilot_sticks": _pilot_sticks,
    "pilot_disarm": lambda draw, firmware: Fault(
        "pilot_disarm",
        draw.choice(("armed", "airborne")),
        _moment(draw),
        None,
        (("forced", draw.random() < 0.7),),
    ),
    "pilot_kill": _lasting("pilot_kill", (0.1, 6.0)),
    "motor_failure": _motor,
    "battery_critical": _battery,
    "payload_drop": _momentary("payload_drop", mass_kg=(0.05, 0.35), inertia_share=(0.8, 1.0)),
    "gust": _gust,
}
"""How each kind is drawn; the firmware is given."""


SILENCED = (
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "AUTOPILOT_VERSION",
    "BATTERY_STATUS",
    "COMMAND_ACK",
    "CURRENT_MODE",
    "ESTIMATOR_STATUS",
    "EKF_STATUS_REPORT",
    "EXTENDED_SYS_STATE",
    "GPS_RAW_INT",
    "HEARTBEAT",
    "HIGHRES_IMU",
    "LOCAL_POSITION_NED",
    "ODOMETRY",
    "PARAM_VALUE",
    "RC_CHANNELS",
    "STATUSTEXT",
    "SYS_STATUS",
    "TIMESYNC",
)
"""What a router or a filter may keep back, one at a time, for good."""


def draw_traffic(draw: random.Random) -> Fault:
    """What other people's machines do on the same link, from the first frame on."""
    sort = draw.random()
    if sort < 0.6:
        others = ["companion", "ground_station", "gimbal", "camera"]
        some = draw.sample(others, draw.randrange(1, 5)) + ["autopilot"] * (draw.random() < 0.5)
        share = round(draw.uniform(0.1, 1.0), 2)
        return Fault("other_traffic", "start", 0.0, None, (("probability", share), ("senders", tuple(some))))
    if sort < 0.8:
        lost = round(draw.choice((0.0, 0.002, 0.02)), 3)
        return Fault(
            "link_pieces", "start", 0.0, None, (("size", draw.choice((32, 64, 256))), ("probability", lost))
        )
    moment = "start" if draw.random() < 0.5 else "airborne"
    return Fault("stream_stop", moment, 0.0, None, (("messages", (draw.choice(SILENCED),)),))


def draw_faults(draw: random.Random, firmware: str, count: int) -> tuple[Fault, ...]:
    """`count` faults of different kinds."""
    kinds = draw.sample(sorted(KINDS), min(count, len(KINDS)))
    return tuple(KINDS[kind](draw, firmware) for kind in kinds)
