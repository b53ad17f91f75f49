"""What a flight looks like in a terminal. All of it goes to standard error: standard output is for results."""

from __future__ import annotations

import math
import os
import sys

from companion.autopilot.adapter import Finding, Verdict
from companion.cli.output import Speaker
from companion.flight.phases import Phase
from companion.flight.reporter import Reporter

_MARKS = {Verdict.OK: "ok     ", Verdict.WARNING: "warning", Verdict.REFUSAL: "REFUSED"}
_BAR = 24
_STDERR = 2
_LAST_WORDS_S = 1.0  # how long the end of a flight waits for such a terminal


class ConsoleReporter(Reporter):
    """One line a phase; on a terminal the last line moves while the flight goes on.

    Words leave through a thread of their own: a terminal that is stopped, closed or gone costs words, never control.
    """

    def __init__(self) -> None:
        self._speaker = Speaker(_STDERR)
        self._moving = _is_terminal()
        self._open_line = False
        self._phase: Phase | None = None
        self._quiet_until_s = -math.inf

    def say(self, text: str) -> None:
        """See `Reporter.say`."""
        self._close_line()
        self._put(text + "\n")

    def finding(self, finding: Finding) -> None:
        """See `Reporter.finding`."""
        tail = "".join(f"; {part}" for part in (finding.why, finding.remedy) if part)
        self.say(f"  {_MARKS[finding.verdict]} {finding.subject} = {finding.found}{tail}")

    def progress(self, phase: Phase, time_s: float, of_s: float, text: str) -> None:
        """See `Reporter.progress`; without a terminal a line for each phase and every 10 s."""
        if phase is not self._phase:
            self._phase = phase
            self.say(f"[{phase.value}]")
            self._quiet_until_s = -math.inf
        if math.isnan(time_s):
            return
        done = min(1.0, max(0.0, time_s / of_s)) if of_s > 0 else 0.0
        bar = "#" * round(done * _BAR)
        line = f"  {bar:.<{_BAR}} {time_s:5.1f} of {of_s:.1f} s  {phase.value}: {text}"
        if self._moving:
            self._put(f"\r{line}\x1b[K")
            self._open_line = True
        elif time_s >= self._quiet_until_s:
            self._quiet_until_s = time_s + 10.0
            self._put(line + "\n")

    def close(self) -> None:
        """Leave the terminal with a finished line; one that takes nothing is not waited for."""
        self._close_line()
        self._speaker.finish(_LAST_WORDS_S)

    def _put(self, words: str) -> None:
        self._speaker.put(words.encode(_encoding(), "replace"))

    def _close_line(self) -> None:
        if self._open_line:
            self._put("\n")
            self._open_line = False


def _encoding() -> str:
    return getattr(sys.stderr, "encoding", None) or "utf-8"


def _is_terminal() -> bool:
    try:
        return os.isatty(_STDERR)
    except OSError:
        return False
