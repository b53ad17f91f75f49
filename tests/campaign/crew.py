"""Flights on all cores: forked workers that take seeds and hand back results, and stop cleanly when told to."""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from campaign.draw import PlannedFlight
from campaign.evidence import Evidence, gather
from campaign.flying import Flown, fly
from campaign.invariants import judge
from campaign.result import Result, result_of

Plant = Callable[[], None]


def fly_and_judge(
    planned: PlannedFlight, folder: Path, plant: Plant | None = None
) -> tuple[Result, Evidence, Flown]:
    """One flight from beginning to end, in this process and its forks."""
    flown = fly(planned, folder, plant)
    evidence = gather(flown)
    return result_of(evidence, judge(evidence), flown.cpu_s), evidence, flown


def _work(orders: Any, reports: Any, scratch: Path, keep: Path | None, plant: Plant | None) -> None:
    """A worker: until there are no more orders. Folders of flights that broke something go to `keep`."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C is the crew's; it ends workers by closing the orders
    while True:
        try:
            planned: PlannedFlight = orders.recv()
        except EOFError:
            return
        folder = scratch / f"{planned.firmware}-{planned.seed}"
        try:
            result, _, _ = fly_and_judge(planned, folder, plant)
            reports.send(result)
        except Exception as error:
            result = _failed(planned, error)
            reports.send(result)
        if result.broken and keep is not None:
            with contextlib.suppress(OSError):
                shutil.copytree(folder, keep / folder.name, dirs_exist_ok=True)
        shutil.rmtree(folder, ignore_errors=True)


def _failed(planned: PlannedFlight, error: Exception) -> Result:
    words = {"campaign": f"{type(error).__name__}: {error}"}
    return Result(planned.firmware, planned.seed, planned.kinds, "none", "", None, None, 0, words, 0.0, 0.0)


class Crew:
    """Workers; `results` yields as flights end. Call `processes.warm_up` before, and make no threads."""

    def __init__(
        self, size: int, scratch: Path, keep: Path | None = None, plant: Plant | None = None
    ) -> None:
        """`keep`: where flights that broke an invariant leave their files; `plant`: see `campaign.planted`."""
        context = multiprocessing.get_context("fork")
        self._idle: list[int] = []
        self._orders: list[Any] = []
        self._reports: list[Any] = []
        self._processes: list[Any] = []
        self._busy: dict[int, PlannedFlight] = {}
        for number in range(size):
            orders_out, orders_in = context.Pipe(duplex=False)
            reports_out, reports_in = context.Pipe(duplex=False)
            mine = list(self._orders)  # ends that this worker inherits and must not hold open

            def work(
                orders: Any = orders_out, own: Any = orders_in, reports: Any = reports_in, others: Any = mine
            ) -> None:
                for end in (own, *others):
                    end.close()
                _work(orders, reports, scratch, keep, plant)

            process = context.Process(target=work, name=f"campaign {number}")
            process.start()
            orders_out.close()
            reports_in.close()
            self._orders.append(orders_in)
            self._reports.append(reports_out)
            self._processes.append(process)
            self._idle.append(number)

    def results(self, flights: Sequence[PlannedFlight] | Iterator[PlannedFlight]) -> Iterator[Result]:
        """Fly them all. Stopping the iteration leaves flights under way to `close`."""
        waiting = iter(flights)
        while True:
            while self._idle:
                planned = next(waiting, None)
                if planned is None:
                    break
                number = self._idle.pop(0)
                self._busy[number] = planned
                self._orders[number].send(planned)
            if not self._busy:
                return
            by_connection = {self._reports[number]: number for number in self._busy}
            for ready in multiprocessing.connection.wait(list(by_connection)):
                number = by_connection[ready]
                planned = self._busy.pop(number)
                try:
                    result = self._reports[number].recv()
                except EOFError:
                    yield _failed(planned, RuntimeError("the campaign's worker died"))
                    continue
                self._idle.append(number)
                yield result

    def close(self) -> None:
        """Let flights under way end, and the workers with them."""
        for orders in self._orders:
            orders.close()
        for process in self._processes:
            process.join(600.0)
            if process.is_alive():
                process.kill()


def default_size() -> int:
    """A worker per core that this process may use: of a flight's two programs one always waits for the other."""
    return len(os.sched_getaffinity(0))
