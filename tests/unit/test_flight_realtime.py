"""What is asked of the operating system before a flight, and what is said where it is refused."""

from __future__ import annotations

import ctypes
import gc
import os
import sys

import pytest

from companion.flight import realtime


class Libc:
    def __init__(self, result: int) -> None:
        self.asked: list[int] = []
        self.result = result

    def mlockall(self, flags: int) -> int:
        self.asked.append(flags)
        return self.result

    def munlockall(self) -> int:
        self.asked.append(0)
        return self.result


@pytest.fixture
def thawed():
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("thawed")
def test_where_all_is_allowed_nothing_is_said(monkeypatch) -> None:
    asked: list[tuple[int, int]] = []
    libc = Libc(0)
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda _, policy, p: asked.append((policy, p.sched_priority))
    )
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: libc)
    assert realtime.prepare() == []
    assert asked == [(os.SCHED_FIFO, realtime.FIFO_PRIORITY)]
    assert libc.asked == [1 | 2]  # MCL_CURRENT, MCL_FUTURE
    assert gc.get_freeze_count() > 0
    assert gc.get_threshold()[0] == realtime.YOUNG_OBJECTS
    assert sys.getswitchinterval() == pytest.approx(realtime.SWITCH_INTERVAL_S)
    realtime.restore()
    assert gc.get_threshold()[0] != realtime.YOUNG_OBJECTS
    assert sys.getswitchinterval() == pytest.approx(0.005)
    assert asked[-1] == (os.SCHED_OTHER, 0)
    assert libc.asked[-1] == 0
    assert gc.get_freeze_count() == 0


@pytest.mark.usefixtures("thawed")
def test_what_is_refused_is_said_with_what_it_takes(monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Libc(-1))
    scheduling, memory = realtime.prepare()
    assert "no SCHED_FIFO" in scheduling and "rtprio limit" in scheduling
    assert "memory not locked" in memory and "memlock limit" in memory
    assert gc.get_freeze_count() > 0
