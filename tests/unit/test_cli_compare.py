"""A series of flights: what ends it, and what is said."""

from __future__ import annotations

import pytest

from companion.cli import compare
from companion.cli.main import main


@pytest.mark.parametrize(
    ("where", "outcome", "code", "flown"),
    [
        (["--endpoint", "udpin:127.0.0.1:14999"], "pilot took over", 3, 2),
        (["--endpoint", "udpin:127.0.0.1:14999"], "aborted", 3, 2),
        (["--endpoint", "udpin:127.0.0.1:14999"], "link lost", 1, 2),
        (["--sitl", "px4"], "interrupted", 3, 2),
        (["--sitl", "px4"], "aborted", 3, 6),  # a law that the stub aborts is part of the comparison
    ],
)
def test_what_ends_a_series(monkeypatch, capsys, tmp_path, where, outcome, code, flown) -> None:
    begun: list[str] = []
    shown: list[int] = []

    def fly_once(arguments, controller, seed, log, overwrite):
        begun.append(f"{controller} {seed}")
        return (outcome, "as it was", code) if len(begun) == 2 else ("completed", "flown as planned", 0)

    monkeypatch.setattr(compare, "fly_once", fly_once)
    monkeypatch.setattr(compare, "show_comparison", lambda logs, *_: shown.append(len(logs)))
    exit_code = main(["compare", *where, "--seeds", "1-2", "--folder", str(tmp_path)])
    assert len(begun) == flown
    if flown < 6:
        assert exit_code == code
        assert shown == [1]
        assert "the series ends here: 4 not flown" in capsys.readouterr().err
    else:
        assert (exit_code, shown) == (0, [6])
