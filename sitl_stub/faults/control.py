"""The control channel: faults injected while the stub runs, as JSON lines on its standard input. It is not MAVLink.

    {"inject": "link_loss", "for_s": 2.0, "direction": "to_client"}
    {"clear": true}

Each line is answered by one on standard output: `{"control": "ok", "begins_s": 12.34}` (null while what the fault comes
after has not happened) or `{"control": "refused", "problems": ["..."]}`. Without `at_s` a fault begins at the next control
period, so that one injected while lockstep waits for the client's answer begins at an instant that is always the same.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from typing import Any

from sitl_stub.faults.director import FaultDirector
from sitl_stub.faults.fault import FaultError
from sitl_stub.faults.scenario import Target, entry_from

LONGEST_LINE = 1 << 20


class ControlChannel:
    """Reads commands from a file descriptor whenever the server finds something there."""

    def __init__(
        self, descriptor: int, director: FaultDirector, target: Target, answer: Callable[[str], None]
    ) -> None:
        self.descriptor = descriptor
        self.director = director
        self.target = target
        self.answer = answer
        self.open = True
        self._tail = b""

    def fileno(self) -> int:
        """For selectors."""
        return self.descriptor

    def read(self) -> None:
        """Take what is there and obey every whole line of it; at the end of the input, close."""
        data = b""
        with contextlib.suppress(OSError):
            data = os.read(self.descriptor, LONGEST_LINE)
        self.open = bool(data)
        *lines, self._tail = (self._tail + data).split(b"\n")
        if len(self._tail) > LONGEST_LINE:
            self._tail = b""
        for line in lines:
            if line.strip():
                self.answer(json.dumps(self._obey(line)))

    def _obey(self, line: bytes) -> dict[str, Any]:
        try:
            command = json.loads(line)
        except (ValueError, RecursionError):
            command = None
        if isinstance(command, dict) and command.get("clear") is True and len(command) == 1:
            self.director.clear()
            return {"control": "ok"}
        if not isinstance(command, dict) or "inject" not in command:
            problem = 'give {"inject": "KIND", ...} or {"clear": true} as one line of JSON'
            return {"control": "refused", "problems": [problem]}
        table = {("kind" if name == "inject" else name): value for name, value in command.items()}
        try:
            begins_us = self.director.plan(entry_from(table, self.target))
        except FaultError as error:
            return {"control": "refused", "problems": error.problems}
        return {"control": "ok", "begins_s": None if begins_us is None else begins_us * 1e-6}
