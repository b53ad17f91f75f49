"""MAVSDK's whole flights of the suite once more, as they are, with `companion serve` in between."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from served_client import PATIENCE_S, Served

from sitl_stub import Stub

pytest.importorskip("mavsdk")
from conformance.test_mavsdk_client import (
    SPEED,
    _until,
    ardupilot_for_mavsdk,
    client_of,
    test_mavsdk_flies_a_whole_flight,
    test_mavsdk_flies_ardupilot_too,
)

pytestmark = [
    pytest.mark.flight,
    pytest.mark.skipif(
        not os.environ.get("SERVE_MAVSDK"),
        reason="in real time, five processes: SERVE_MAVSDK=1 runs it, on a machine with nothing else to do",
    ),
]
__all__ = ["test_mavsdk_flies_a_whole_flight", "test_mavsdk_flies_ardupilot_too"]


@contextmanager
def through_serve(stub: Stub, folder: Path) -> Iterator[Any]:
    """MAVSDK at the port of serve, which stands by."""
    serve = Served(stub.endpoint, folder)
    try:
        with client_of(stub, f"udpin://127.0.0.1:{serve.port}") as system:
            assert _until(lambda: serve.heard("ready after"), PATIENCE_S), serve.said
            yield system
        assert serve.heard("flying the client's setpoints"), serve.said
    finally:
        code = serve.stop()
    assert code == 0


@pytest.fixture
def connected(tmp_path: Path) -> Iterator[tuple[Stub, Any]]:
    with Stub(speed=SPEED) as stub, through_serve(stub, tmp_path) as system:
        yield stub, system


@pytest.fixture
def copter(tmp_path: Path) -> Iterator[Any]:
    with ardupilot_for_mavsdk() as stub, through_serve(stub, tmp_path) as system:
        yield system
