"""Where words leave the program: a terminal, pipe or disk that is stopped, full or gone costs words, nothing else.

Whatever is written to standard output and error while `results_and_words` holds goes through a thread of its own. So
printing never raises, never waits, and never changes the exit code of a command whose work is done.
"""

from __future__ import annotations

import errno
import io
import os
import queue
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

_WAITING = 1000  # pieces that a descriptor which takes none may owe; what is more is not written
_RESULTS_PATIENCE_S = 5.0  # without one byte taken: a reader that is merely slow loses nothing
_WORDS_PATIENCE_S = 1.0
_INTERRUPTED_AGAIN_S = 0.05


class Speaker:
    """Writes to a file descriptor from a thread of its own, which is started with the first words.

    It writes to the descriptor itself: a lock of a Python stream held there would stop the interpreter's end.
    """

    def __init__(self, descriptor: int) -> None:
        self.trouble: OSError | None = None
        """Why the descriptor took no more; None while it does."""
        self._descriptor = descriptor
        self._words: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        self._taken = 0
        self._process = os.getpid()
        self._thread: threading.Thread | None = None

    def put(self, words: bytes) -> None:
        """Write `words` soon; they are lost where too many wait already."""
        if os.getpid() != self._process:  # forked: the thread stayed behind
            with suppress(OSError):
                os.write(self._descriptor, words)
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._speak, name="words", daemon=True)
            self._thread.start()
        with suppress(queue.Full):
            self._words.put_nowait(words)

    def finish(self, patience_s: float) -> bool:
        """Wait until all is written, but no longer than `patience_s` without one byte taken; whether it is."""
        if self._thread is None:
            return True
        with suppress(queue.Full):
            self._words.put_nowait(None)
        before = -1
        while self._thread.is_alive() and before != self._taken:
            before = self._taken
            self._thread.join(patience_s)
        return not self._thread.is_alive()

    def _speak(self) -> None:
        while (words := self._words.get()) is not None:
            left = memoryview(words)
            try:
                while left:
                    count = os.write(self._descriptor, left)
                    left, self._taken = left[count:], self._taken + count
            except OSError as error:
                self.trouble = error


class _Descriptor(io.RawIOBase):
    """A file descriptor as Python's streams want it, spoken to by a `Speaker`."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self.speaker = Speaker(descriptor)
        self._descriptor = descriptor

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def write(self, data: Any) -> int:
        words = bytes(data)
        self.speaker.put(words)
        return len(words)


@contextmanager
def results_and_words() -> Iterator[None]:
    """Standard output and error through threads of their own; at the end they are waited for, within reason.

    Streams that somebody has put in place of the process's own stay as they are. Python loses a KeyboardInterrupt that
    falls into a callback of its own and prints a traceback: it is raised again instead.
    """
    before = sys.stdout, sys.stderr, sys.unraisablehook
    out = err = None
    if sys.stdout is sys.__stdout__ and sys.stderr is sys.__stderr__:
        _occupy_standard_descriptors()
        out, err = _Descriptor(1), _Descriptor(2)
        sys.stdout, sys.stderr = _text(out, before[0], False), _text(err, before[1], True)
    sys.unraisablehook = _interrupt_again
    try:
        yield
    finally:
        try:
            if out is not None and err is not None:
                _finish(out.speaker, err.speaker)
        except KeyboardInterrupt:
            pass
        sys.stdout, sys.stderr, sys.unraisablehook = before


def _finish(results: Speaker, words: Speaker) -> None:
    sys.stdout.flush()
    all_written, trouble = results.finish(_RESULTS_PATIENCE_S), results.trouble
    if trouble is not None and trouble.errno != errno.EPIPE:  # a reader that has seen enough is no trouble
        print(f"warning: results are lost: standard output: {trouble.strerror}", file=sys.stderr)
    elif not all_written:
        print("warning: results are lost: standard output takes nothing", file=sys.stderr)
    sys.stderr.flush()
    words.finish(_WORDS_PATIENCE_S)


def _text(descriptor: _Descriptor, like: Any, by_line: bool) -> io.TextIOWrapper:
    """A text stream; a terminal without ° or é is no reason to fail."""
    encoding = getattr(like, "encoding", None) or "utf-8"
    by_line = by_line or descriptor.isatty()
    buffered = io.BufferedWriter(descriptor)
    return io.TextIOWrapper(buffered, encoding, errors="replace", line_buffering=by_line)


def _occupy_standard_descriptors() -> None:
    """Where a process is started with one of them closed, the log or the link to the autopilot would get its number."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)  # the lowest that is free
            if nowhere != descriptor:
                os.dup2(nowhere, descriptor)
                os.close(nowhere)


def _interrupt_again(unraisable: sys.UnraisableHookArgs) -> None:
    if unraisable.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(unraisable)
        return
    # to the main thread itself, whose waiting then ends
    main_thread = threading.main_thread().ident
    assert main_thread is not None
    threading.Timer(_INTERRUPTED_AGAIN_S, signal.pthread_kill, (main_thread, signal.SIGINT)).start()
