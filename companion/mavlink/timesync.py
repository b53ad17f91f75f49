"""What time it is on the autopilot, and how long messages take (TIMESYNC, message 111).

We send ts1 = our clock; the autopilot answers at once with tc1 = its clock and our ts1. The half-way point of the
round trip is the moment of tc1, off by at most half the round trip. PX4 answers late and with jitter (its
parser sleeps 1 to 2.5 ms), always in the same direction; so of the last samples only the quickest is believed.

Of how fast the autopilot's clock runs, each answer knows a little: its offset lies within half a round trip of the
sample's. Where no one offset fits all of the window, the clocks drift apart, and the drift is fitted over all samples,
the quick ones counting most. One late answer proves nothing.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

WINDOW = 32  # samples; at 10 Hz a little over 3 s
RECENT = 4  # samples; at 10 Hz less than half a second
LEAST_SAMPLES = 8  # before anything is said of how fast the clock runs
COARSENESS_S = 1e-3  # of a round trip's weight: on a quick link all count the same
ROUNDING_S = 1e-6
SIGNIFICANT = 3.0  # standard errors: a clock that is read in steps of 4 ms does not drift
UNEVEN_S = 0.01
"""Answers that contradict each other by more, beyond what drift explains: a simulation that runs in fits and starts."""
RATE_TOLERANCE = 0.02  # a clock that runs this much off ours is a simulation's, not a crystal's


@dataclass(frozen=True, slots=True)
class _Sample:
    wall_s: float
    offset_s: float
    round_trip_s: float
    autopilot_trip_s: float  # the same on the autopilot's clock, as coarse as its time stamps; nan: unknown


class TimeSync:
    """Offset and drift between the autopilot's clock and ours, filtered by round trip."""

    def __init__(self) -> None:
        self.answered_s = -math.inf  # the autopilot's clock in its newest answer
        self._samples: deque[_Sample] = deque(maxlen=WINDOW)
        self._drift = self._disagreement_s = 0.0

    def add(
        self, sent_ns: int, autopilot_ns: int, received_ns: int, autopilot_trip_s: float = math.nan
    ) -> None:
        """Take one answer: our clock at sending and at receiving, the autopilot's clock between (all ns).

        `autopilot_trip_s` is by how much the autopilot's time stamps have gone on between sending and receiving.
        """
        round_trip_ns = received_ns - sent_ns
        if round_trip_ns < 0 or round_trip_ns > 1_000_000_000 or autopilot_ns <= 0:
            return
        self.answered_s = autopilot_ns * 1e-9
        middle_ns = sent_ns + round_trip_ns // 2
        self._samples.append(
            _Sample(
                middle_ns * 1e-9, (autopilot_ns - middle_ns) * 1e-9, round_trip_ns * 1e-9, autopilot_trip_s
            )
        )
        self._drift = self._fitted_drift()
        self._disagreement_s = self._greatest_disagreement_s()

    @property
    def samples(self) -> int:
        """How many answers are in the window."""
        return len(self._samples)

    @property
    def round_trip_s(self) -> float:
        """Median round trip in seconds; nan without a sample."""
        if not self._samples:
            return float("nan")
        return sorted(s.round_trip_s for s in self._samples)[len(self._samples) // 2]

    @property
    def autopilot_trip_s(self) -> float:
        """Median round trip on the autopilot's clock (seconds); nan without a sample.

        In a simulation that runs faster or slower than real time this is what a setpoint's way costs the vehicle.
        """
        trips = sorted(s.autopilot_trip_s for s in self._samples if s.autopilot_trip_s >= 0.0)
        return trips[len(trips) // 2] if trips else float("nan")

    @property
    def drift(self) -> float:
        """By how much the autopilot's clock runs faster than ours (0.01: 1 %); 0 where no drift is proven."""
        return self._drift

    def _fitted_drift(self) -> float:
        samples = self._samples
        lowest = max(s.offset_s - 0.5 * s.round_trip_s for s in samples)
        highest = min(s.offset_s + 0.5 * s.round_trip_s for s in samples)
        if len(samples) < LEAST_SAMPLES or lowest <= highest + ROUNDING_S:
            return 0.0
        weights = [(s.round_trip_s + COARSENESS_S) ** -2 for s in samples]
        total = sum(weights)
        wall_s = sum(w * s.wall_s for w, s in zip(weights, samples, strict=True)) / total
        offset_s = sum(w * s.offset_s for w, s in zip(weights, samples, strict=True)) / total
        spread = sum(w * (s.wall_s - wall_s) ** 2 for w, s in zip(weights, samples, strict=True))
        if spread <= 0.0:
            return 0.0
        together = sum(
            w * (s.wall_s - wall_s) * (s.offset_s - offset_s) for w, s in zip(weights, samples, strict=True)
        )
        drift = together / spread
        left_over = sum(
            w * (s.offset_s - offset_s - drift * (s.wall_s - wall_s)) ** 2
            for w, s in zip(weights, samples, strict=True)
        )
        error = math.sqrt(left_over / (len(samples) - 2) / spread)
        return drift if abs(drift) > SIGNIFICANT * error else 0.0

    @property
    def offset_s(self) -> float:
        """Autopilot's clock minus ours at the newest sample (seconds); nan without one.

        From the quickest round trip, carried on by the drift.
        """
        return self._offset_s(self._samples[-1].wall_s) if self._samples else float("nan")

    def _offset_s(self, our_time_s: float) -> float:
        quickest = min(self._samples, key=lambda s: s.round_trip_s)
        return quickest.offset_s + self._drift * (our_time_s - quickest.wall_s)

    @property
    def steady(self) -> bool:
        """Whether the autopilot's clock runs as fast as ours.

        It does not in a simulation that runs faster or slower than real time: delays on the wall clock
        then mean nothing in the vehicle's time, and nothing may be predicted from them.
        """
        if len(self._samples) < LEAST_SAMPLES:
            return False
        elapsed_s = self._samples[-1].wall_s - self._samples[0].wall_s
        return elapsed_s > 0.2 and abs(self._drift) < RATE_TOLERANCE and self._disagreement_s < UNEVEN_S

    def _greatest_disagreement_s(self) -> float:
        """By how much two answers contradict each other, drift aside: each bounds the offset by half its round trip."""
        newest_s = self._samples[-1].wall_s
        offsets = [
            (s.offset_s + self._drift * (newest_s - s.wall_s), 0.5 * s.round_trip_s) for s in self._samples
        ]
        return max(offset - half for offset, half in offsets) - min(offset + half for offset, half in offsets)

    def lateness_s(self, time_s: float, our_time_s: float) -> float:
        """How much later than the link's own delay allows for a state stamped `time_s` is at `our_time_s`; nan if unknown.

        An old state can only be old because the way here takes long, and then so did the last round trips. A
        simulation that falls behind real time also lets its clock fall behind, with round trips as short as ever:
        its states are young. So the age by the clocks counts up to the longest of the last round trips only.
        """
        if not self._samples:
            return float("nan")
        longest = max(sample.round_trip_s for sample in list(self._samples)[-RECENT:])
        return min(self.autopilot_time_s(our_time_s) - time_s, longest)

    def autopilot_time_s(self, our_time_s: float) -> float:
        """The autopilot's clock at a moment of ours (seconds)."""
        return our_time_s + (self._offset_s(our_time_s) if self._samples else float("nan"))
