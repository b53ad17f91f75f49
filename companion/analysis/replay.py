"""Repeat a flight's control steps from its log and compare the bits.

A step is a pure function of its inputs, its memory and the parameters. The log holds the first two for
every step and the settings the third is made of, so the same code gives the same terms and the same next
memory, bit for bit. Where it does not, the code, numba or the processor's arithmetic has changed since.
"""

from __future__ import annotations

import json
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.config.errors import UserError
from companion.config.settings import Settings, settings_from_tables
from companion.control.law import ControlLaw, StepRefused
from companion.control.laws import LAWS, load_law_file
from companion.control.packing import INPUT, TERMS, Memory, memory_dtype
from companion.control.registry import build_law
from companion.flightlog.channels import packed_channel
from companion.flightlog.law_channels import INPUT_TOPIC, LATER_SETTINGS, LAW_TEXT, MEMORY_TOPIC, TERMS_TOPIC
from companion.flightlog.reader import FlightRecord, NumericChannel

AUTOPILOTS = {"px4": "px4", "ardu": "ardupilot"}
"""How the firmware's name begins → the profile's key of its response."""


@dataclass(frozen=True, slots=True)
class Mismatch:
    """A step that came out otherwise."""

    step: int
    time_s: float
    fields: tuple[str, ...]  # of the terms, `memory.…` of the memory after the step
    largest: float  # greatest difference among them


@dataclass(frozen=True, slots=True)
class Replay:
    """What repeating a flight's steps gave."""

    steps: int
    identical: int
    mismatches: tuple[Mismatch, ...]  # the first of them
    hand_overs: (
        int  # steps whose memory is not what the step before left: the law was handed the vehicle anew
    )

    @property
    def exact(self) -> bool:
        """Whether every step gave the logged bits."""
        return self.steps > 0 and self.identical == self.steps


LawFrom = tuple[float, ControlLaw]
"""From when on (s, autopilot's clock; steps later than that) and which law."""


def laws_of(
    record: FlightRecord, law_file: Path | None = None, run_law_in_log: bool = False
) -> list[LawFrom]:
    """Build the control law a flight was flown with, and with the gains that it went on with, in the order of time.

    A law of somebody's own is a program: it is taken from `law_file`, and from the log only where `run_law_in_log` says so.
    Raises UserError where the log does not hold its settings, or such a law is not given.
    """
    text = record.attachments.get("settings.json")
    if text is None:
        raise UserError(f"{record.path}: no settings.json in this log, so its steps cannot be repeated")
    laws = [(-math.inf, _law_of(record, text, law_file, run_law_in_log))]
    for name, later in record.attachments.items():
        if name.startswith(LATER_SETTINGS):
            from_s = float(name.removeprefix(LATER_SETTINGS).removesuffix(".json"))
            laws.append((from_s, _law_of(record, later, law_file, run_law_in_log)))
    return sorted(laws, key=lambda item: item[0])


def _law_of(record: FlightRecord, text: bytes, law_file: Path | None, run_law_in_log: bool) -> ControlLaw:
    try:
        settings: Settings = settings_from_tables(json.loads(text))
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{record.path}: the settings in this log cannot be read: {error}") from error
    _know_law(record, settings.flight.controller, law_file, run_law_in_log)
    firmware = record.flight.get("firmware", "").lower()
    autopilot = next((key for start, key in AUTOPILOTS.items() if firmware.startswith(start)), None)
    flight = settings.flight
    return build_law(
        flight.controller, settings.gains, settings.profile, settings.level, flight.seed, autopilot=autopilot
    )


def _know_law(record: FlightRecord, name: str, law_file: Path | None, run_law_in_log: bool) -> None:
    """Make the law known that a flight was flown with, where it is none of ours."""
    text = record.attachments.get(LAW_TEXT)
    if name in LAWS or (text is None and law_file is None):
        return
    if law_file is not None:
        load_law_file(law_file)
        return
    if not run_law_in_log:
        raise UserError(
            f"{record.path}: flown with {name}, a law of somebody's own. Its text is in this log; give its file with "
            "--law, or let that text run with --run-law-in-log if you trust where the log comes from"
        )
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / f"{name}.py"
        kept.write_bytes(text or b"")
        load_law_file(kept)


def replay(
    record: FlightRecord, law: ControlLaw | list[LawFrom] | None = None, most_mismatches: int = 10
) -> Replay:
    """Repeat every logged step with `law` (default: those the flight was flown with).

    Raises UserError where the log holds no steps or was written with another layout of the law's records.
    """
    if law is None:
        law = laws_of(record)
    laws = law if isinstance(law, list) else [(-math.inf, law)]
    memory_type = memory_dtype(laws[0][1].hidden)
    inputs = _table(record, INPUT_TOPIC, INPUT)
    memories = _table(record, MEMORY_TOPIC, memory_type)
    terms = _table(record, TERMS_TOPIC, TERMS)
    count = min(len(inputs), len(memories), len(terms))  # a cut can fall between the three
    if not (
        np.array_equal(inputs.time_s[:count], memories.time_s[:count])
        and np.array_equal(inputs.time_s[:count], terms.time_s[:count])
    ):
        raise UserError(f"{record.path}: records of the law are missing, so its steps cannot be repeated")
    identical = hand_overs = 0
    mismatches: list[Mismatch] = []
    expected: bytes | None = None
    for step in range(count):
        before = memories.values[step]
        if expected is not None and before.tobytes() != expected:
            hand_overs += 1
        memory = Memory(before.copy().view(memory_type))
        now_s = inputs.time_s[step]
        flown = next(each for from_s, each in reversed(laws) if now_s > from_s)
        try:
            result = flown.step_packed(memory, inputs.values[step].copy())
        except StepRefused:
            expected = None
            mismatches.append(Mismatch(step, float(inputs.time_s[step]), ("refused",), float("nan")))
            continue
        expected = result.memory.values.tobytes()
        if result.terms.values.tobytes() == terms.values[step].tobytes():
            identical += 1
        else:
            mismatches.append(
                _mismatch(step, float(terms.time_s[step]), result.terms.values, terms.values[step])
            )
    return Replay(count, identical, tuple(mismatches[:most_mismatches]), hand_overs)


def _table(record: FlightRecord, topic: str, dtype: np.dtype[np.void]) -> NumericChannel:
    channel = record.channel(topic)
    if channel is None:
        raise UserError(f"{record.path}: no {topic} in this log, so its steps cannot be repeated")
    wanted = [(item.name, item.width, item.kind) for item in packed_channel(topic, dtype).fields]
    if wanted != [(item.name, item.width, item.kind) for item in channel.fields]:
        raise UserError(
            f"{record.path}: {topic} has another layout than this version's; use the version that flew"
        )
    return channel


def _mismatch(step: int, time_s: float, found: np.void, logged: np.ndarray) -> Mismatch:
    spec = packed_channel(TERMS_TOPIC, TERMS)
    now = np.frombuffer(found.tobytes())
    names, largest = [], 0.0
    for item in spec.fields:
        part = spec.slice_of(item.name)
        if now[part].tobytes() != logged[part].tobytes():
            names.append(item.name)
            if item.kind == "float64":
                largest = max(largest, float(np.nanmax(np.abs(now[part] - logged[part]), initial=0.0)))
    return Mismatch(step, time_s, tuple(names), largest)
