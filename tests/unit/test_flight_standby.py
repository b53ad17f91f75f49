"""Standing by: who asks is answered, who cannot be asked is said, long texts to the ground station come in chunks."""

from __future__ import annotations

import socket

import pytest

from companion.cli.main import main
from companion.config.errors import UserError
from companion.flight.standby import Wishes
from companion.mavlink.link import mav
from companion.mavlink.received import read
from companion.mavlink.status_text import StatusText, StatusTexts, status_texts


@pytest.fixture
def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_newest_wish_is_taken_and_its_sender_answered(free_port):
    wishes = Wishes(free_port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.settimeout(5.0)
        asking.connect(("127.0.0.1", free_port))
        assert wishes.take() is None
        asking.send(b"tlmbc")
        asking.send(b"")
        assert wishes.take() == ""
        wishes.answer("engaging with dtlannc")
        assert asking.recv(100) == b"engaging with dtlannc"
        assert wishes.take() is None
    wishes.close()


def test_a_second_standby_is_told_of_the_first(free_port):
    first = Wishes(free_port)
    with pytest.raises(UserError, match=f"port {free_port} .* --engage-port"):
        Wishes(free_port)
    first.close()


def test_nobody_standing_by_is_one_line_and_exit_code_2(free_port, capsys):
    assert main(["engage", "--engage-port", str(free_port)]) == 2
    assert "start `companion standby` first" in capsys.readouterr().err


@pytest.mark.parametrize("length", [0, 1, 49, 50, 51, 99, 100, 101, 180])
def test_texts_to_the_ground_come_whole(length):
    """As a receiver puts chunks together: the last one is the first that is not full."""
    text = "".join(chr(ord("a") + place % 26) for place in range(length))
    sent = status_texts(mav.MAV_SEVERITY_WARNING, text)
    codec, receiver, heard = mav.MAVLink(None, 1, 191), StatusTexts(), []
    for message in sent:
        heard += receiver.take(read(bytes(message.pack(codec))), 0.0)
    assert heard == [StatusText(mav.MAV_SEVERITY_WARNING, text)]
