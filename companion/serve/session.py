"""`companion serve`: the process that passes messages on, and the one that flies for clients, started by it.

Whatever becomes of the flying process, messages go on; it is started again. When the passing one is gone, so are the
clients' words and ours: the autopilot's own offboard-loss action follows, as when a client is killed.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from companion.config.errors import UserError
from companion.config.provenance import as_text
from companion.config.settings import Settings
from companion.control.prediction import Predictor
from companion.flight import realtime
from companion.flight.control_loop import ControlLoop
from companion.flight.known_vehicle import KnownVehicle
from companion.flight.outcome import Refused, WaitedTooLong
from companion.flight.recorder import Recorder
from companion.flight.reporter import Reporter
from companion.flight.session import (
    SessionOptions,
    _attachments,
    _control_loop,
    _fitted,
    _law,
    _notices,
    _preflight,
    _signals,
    _versions,
    _wall,
)
from companion.flight.stage import FlightRequest, Interrupts
from companion.flight.vehicle import Vehicle
from companion.flightlog.writer import FlightLog
from companion.mavlink.bandwidth import LinePlan
from companion.mavlink.connection import Connection
from companion.mavlink.link import Link
from companion.mavlink.transport import open_transport
from companion.reference.hold import Hold
from companion.reference.trajectory import Frame
from companion.serve.client_flight import ClientFlight
from companion.serve.client_setpoints import ClientSetpoints
from companion.serve.client_wires import Door, open_door
from companion.serve.forwarder import LAW_COMPONENT, READY, Forwarder
from companion.serve.law_wire import LawWire

AGAIN_AFTER_S = 2.0
"""Before a law that ended is started again."""
LAST_WORDS_S = 5.0
"""For the law to let go and close its log."""


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """What standing in for an autopilot needs beside the flight's settings."""

    connection: Connection
    clients: tuple[str, ...]
    settings: Settings
    demand_signing: bool = False
    real_time: bool = True  # ask for real-time scheduling
    command_line: str = ""
    law_text: str = ""  # of a law of one's own, for the log
    law_file: str = ""  # the same, for the process that flies


Law = Callable[[socket.socket, socket.socket, ServeOptions], None]
"""What the law's process does: calls `fly_for_clients` with its own reporter. A function of a module."""


def serve(options: ServeOptions, law: Law, say: Callable[[str], None]) -> int:
    """Pass messages on until SIGINT or SIGTERM; returns the exit code.

    Raises:
        UserError: a wire cannot be opened.
    """
    signer = options.connection.signer(say)
    transport = open_transport(options.connection.endpoint)
    doors: list[Door] = []
    try:
        for text in options.clients:
            doors.append(open_door(text))
        forwarder = Forwarder(
            transport, doors, say, options.connection.system, signer, options.demand_signing
        )
    except UserError:
        transport.close()
        for door in doors:
            door.close()
        raise
    wish = _Wish()
    with wish:
        if options.real_time:
            for line in realtime.prepare():
                say(line)
        try:
            return _pass_on(forwarder, options, law, wish, say)
        finally:
            forwarder.close()
            realtime.restore()
            counted = {**forwarder.counters, **forwarder.switch.counters}
            for door in doors:
                counted |= door.counters
            say(
                "passed on; "
                + (", ".join(f"{count} {what}" for what, count in sorted(counted.items())) or "nothing lost")
            )


class _Wish:
    """SIGINT and SIGTERM end the service; a closed terminal does not."""

    def __init__(self) -> None:
        self.count = 0
        self._before: dict[signal.Signals, object] = {}

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.count += 1

    def __enter__(self) -> _Wish:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._ask)
        self._before[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]


def _pass_on(
    forwarder: Forwarder, options: ServeOptions, fly: Law, wish: _Wish, say: Callable[[str], None]
) -> int:
    law: multiprocessing.process.BaseProcess | None = None
    next_s = 0.0
    last_s = float("inf")
    while True:
        now_s = time.monotonic()
        if law is not None and not law.is_alive():
            if law.exitcode:
                say(f"our law has ended (exit code {law.exitcode}); setpoints of clients are passed on")
            forwarder.dismiss()
            law, next_s = None, now_s + AGAIN_AFTER_S
        if wish.count and last_s == float("inf"):
            last_s = now_s + LAST_WORDS_S
            if law is not None and law.pid is not None:
                law.terminate()
        if wish.count > 1 or (wish.count and law is None) or now_s > last_s:
            if law is not None:
                law.kill()
            return 0
        if law is None and now_s >= next_s and not wish.count:
            law = _start_law(forwarder, options, fly)
        forwarder.step()


def _start_law(forwarder: Forwarder, options: ServeOptions, fly: Law) -> multiprocessing.process.BaseProcess:
    """A new interpreter, with nothing of this one but its ends of the sockets."""
    ours, theirs = zip(
        *(socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)), strict=True
    )
    process = multiprocessing.get_context("spawn").Process(
        target=fly, args=(*theirs, options), name="companion serve: law", daemon=True
    )
    process.start()
    for each in theirs:
        each.close()
    forwarder.employ(*ours)
    return process


# The law's process --------------------------------------------------------------------------------------


def fly_for_clients(
    wire: socket.socket,
    control: socket.socket,
    options: ServeOptions,
    reporter: Reporter,
    new_log: Callable[[], Path],
) -> None:
    """Fly for clients, at the other ends of these sockets, until the link is lost or somebody wishes an end.

    Raises:
        UserError: there is no multirotor that we can fly.
        FlightEnd: LinkLost, Interrupted.
    """
    settings, plan = _fitted(options.settings, options.connection, reporter)
    _law(settings, settings.flight.controller, None).warm_up()  # seconds, in which nothing is to wait for us
    Predictor(settings.profile, settings.level)
    connection = options.connection
    link = Link(LawWire(wire), signer=connection.signer(), system=connection.system, component=LAW_COMPONENT)
    control.send(READY)
    vehicle = Vehicle(link, settings.flight.safety.silence_s)
    vehicle.address = str(connection.endpoint)
    vehicle.on_notice = reporter.say
    vehicle.connect(math.inf)
    if options.real_time:
        realtime.prepare()
    else:
        realtime.steady_interpreter()
    refused = ""
    while True:
        session = SessionOptions(
            connection,
            new_log(),
            overwrite=True,
            command_line=options.command_line,
            law_text=options.law_text,
        )
        try:
            quiet = Reporter() if refused else reporter
            text = _one_flight(vehicle, control, settings, session, quiet, plan)
            reporter.say(f"{text}; log: {session.log_path}")
            refused = ""
        except Refused as end:
            if str(end) != refused:
                refused = str(end)
                reporter.say(f"cannot fly, setpoints of clients are passed on: {refused}")
            with suppress(WaitedTooLong):
                vehicle.until(lambda: False, AGAIN_AFTER_S)


def _one_flight(
    vehicle: Vehicle,
    control: socket.socket,
    settings: Settings,
    session: SessionOptions,
    reporter: Reporter,
    plan: LinePlan | None,
) -> str:
    """Stand by until the vehicle has been armed and disarmed; its log is kept where it was armed. Says how it went."""
    flight: ClientFlight | None = None
    try:
        with (
            FlightLog(
                session.log_path,
                metadata={"controller": settings.flight.controller, "level": settings.level.value},
                attachments=_attachments(settings, session),
                overwrite=True,
            ) as log,
            _signals(Interrupts()) as interrupts,
        ):
            log.metadata("versions", _versions())
            log.metadata("wall", _wall(session))
            recorder, known = Recorder(log), KnownVehicle(settings, reporter)
            vehicle.on_notice = _notices(vehicle, recorder, reporter)

            def make_loop(heard: Vehicle) -> ControlLoop:
                log.attach("settings.json", json.dumps(known.settings.as_tables(), indent=1, sort_keys=True))
                log.metadata("vehicle", {row.key: as_text(row) for row in known.provenance()})
                return _control_loop(known.settings, heard, recorder, reporter, (settings.flight.controller,))

            request = FlightRequest(
                level=settings.level,
                trajectory=Hold(0.0, 0.0, 1.0, 0.0),  # none of ours is flown
                frame=Frame.LOCAL,
                duration_s=math.inf,
                may_arm=False,
                fix=False,
                wait_for_offboard=True,
            )
            flight = ClientFlight(
                vehicle,
                request,
                settings.flight,
                recorder,
                _preflight(known, vehicle, reporter, plan),
                reporter,
                interrupts,
                make_loop,
                lambda _plan, _ground_m: None,
            )
            flight.clients = ClientSetpoints(control, flight.surroundings)
            return flight.run().text
    finally:
        vehicle.link.tap, vehicle.on_notice = None, reporter.say
        if flight is None or not flight.was_armed:
            with suppress(OSError):
                session.log_path.unlink()
