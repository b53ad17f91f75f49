"""Every kind of fault by its name in scenario files: one line each."""

from __future__ import annotations

from sitl_stub.faults import (
    clock_faults,
    estimator_faults,
    firmware_faults,
    link_faults,
    pilot_faults,
    traffic_faults,
    vehicle_faults,
)
from sitl_stub.faults.fault import Fault, Parameter

KINDS: dict[str, type[Fault]] = {
    kind.kind: kind
    for kind in (
        link_faults.LinkLoss,
        link_faults.LinkDelay,
        link_faults.LinkJitter,
        link_faults.LinkDuplicate,
        link_faults.LinkReorder,
        link_faults.LinkCorrupt,
        link_faults.LinkTruncate,
        link_faults.AckLoss,
        link_faults.ParameterLoss,
        traffic_faults.LinkPieces,
        traffic_faults.OtherTraffic,
        firmware_faults.StreamStop,
        firmware_faults.Reboot,
        clock_faults.ClockJump,
        clock_faults.ClockDrift,
        estimator_faults.EstimatorReset,
        estimator_faults.EstimatorDivergence,
        estimator_faults.EstimatorInvalid,
        estimator_faults.GpsLoss,
        pilot_faults.PilotMode,
        pilot_faults.PilotSticks,
        pilot_faults.PilotDisarm,
        pilot_faults.PilotKill,
        pilot_faults.TransmitterLost,
        vehicle_faults.MotorFailure,
        vehicle_faults.BatteryCritical,
        vehicle_faults.PayloadDrop,
        vehicle_faults.Gust,
    )
}


def described() -> str:
    """Every kind with its parameters, units, bounds and defaults: what `sitl-stub --list-faults` prints."""
    lines = []
    for name, kind in KINDS.items():
        lines.append(f"{name}: {kind.summary()}")
        if kind.momentary:
            lines[-1] += " Momentary: takes no for_s."
        for parameter, facts in kind.parameters().items():
            default = kind.defaults()[parameter]
            lines.append(f"    {parameter} = {toml_value(default)}{_range(facts)}  {facts.meaning}")
    return "\n".join(lines)


def markdown_table() -> str:
    """The same as the table of docs/faults.md."""
    lines = ["| kind | what happens | parameters (default; range) |", "|---|---|---|"]
    for name, kind in KINDS.items():
        parameters = []
        for parameter, facts in kind.parameters().items():
            default = toml_value(kind.defaults()[parameter])
            unit = f" {facts.unit}" if facts.unit else ""
            bounds = f"; {facts.least:g} to {facts.most:g}" if facts.kind in (int, float) else ""
            parameters.append(f"`{parameter}` ({default}{unit}{bounds}) {facts.meaning}")
        timing = "; momentary" if kind.momentary else ""
        told = "<br>".join(parameters) or "none"
        lines.append(f"| `{name}` | {kind.summary().rstrip('.')}{timing} | {told} |")
    return "\n".join(lines)


def _range(facts: Parameter) -> str:
    if facts.kind in (int, float):
        return f" {facts.unit}".rstrip() + f" ({facts.least:g} to {facts.most:g})"
    return f" ({' | '.join(facts.options)})" if facts.kind is str and facts.options else ""


def toml_value(value: object) -> str:
    """A parameter as it is written in a scenario file."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(f'"{name}"' for name in value) + "]"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"
