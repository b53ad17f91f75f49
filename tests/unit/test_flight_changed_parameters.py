"""Old values of parameters outlive the process that changed them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from companion.config.errors import UserError
from companion.flight.changed_parameters import Changed, ChangedParameters


class StandIn:
    """A vehicle with parameters; `deaf` ones are set but not confirmed, `vanished` ones take nothing."""

    identity, address = "0102", "udpin:0.0.0.0:14540"

    def __init__(self, values: dict[str, float], deaf: tuple[str, ...] = ()) -> None:
        self.parameters = self
        self.link = self
        self.target_system = 1
        self.values, self.deaf = values, deaf
        self.on_disk: list[Any] = []
        self.note: Path | None = None

    def read_parameters(self, names: tuple[str, ...]) -> None:
        """They are here."""

    def set_parameter(self, name: str, value: float) -> bool:
        if self.note is not None:
            self.on_disk.append(json.loads(self.note.read_text()) if self.note.exists() else [])
        self.values[name] = value
        return name not in self.deaf


def changes_of(vehicle: StandIn) -> ChangedParameters:
    said: list[str] = []
    changes = ChangedParameters(vehicle, said.append)  # type: ignore[arg-type]
    vehicle.note = changes.path
    return changes


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path


def test_the_old_value_is_on_disk_before_the_new_one_is_sent_and_gone_when_it_is_back() -> None:
    vehicle = StandIn({"GUID_OPTIONS": 0.0})
    changes = changes_of(vehicle)
    assert changes.set("GUID_OPTIONS", 8.0)
    assert vehicle.on_disk == [[{"name": "GUID_OPTIONS", "before": 0.0, "value": 8.0}]]
    assert "GUID_OPTIONS stays 8 (was 0)" in changes.in_words()
    assert changes.put_back() == [] and vehicle.values == {"GUID_OPTIONS": 0.0}
    assert not changes.path.exists() and changes.in_words() == ""


def test_a_killed_process_is_made_up_for_by_the_next() -> None:
    vehicle = StandIn({"GUID_OPTIONS": 0.0, "ATC_ANGLE_BOOST": 1.0}, deaf=("ATC_ANGLE_BOOST",))
    first = changes_of(vehicle)
    assert first.set("GUID_OPTIONS", 8.0)
    assert not first.set("ATC_ANGLE_BOOST", 0.0)  # whether it was set is not known: remembered all the same
    vehicle.deaf = ()
    again = changes_of(vehicle)
    assert again.pending() == [Changed("GUID_OPTIONS", 0.0, 8.0), Changed("ATC_ANGLE_BOOST", 1.0, 0.0)]
    assert again.set("GUID_OPTIONS", 9.0)
    assert again.pending()[0] == Changed("GUID_OPTIONS", 0.0, 9.0)  # what it was at first, not what we set
    assert again.put_back() == []
    assert vehicle.values == {"GUID_OPTIONS": 0.0, "ATC_ANGLE_BOOST": 1.0}


def test_what_somebody_has_changed_since_is_left_alone() -> None:
    vehicle = StandIn({"GUID_OPTIONS": 0.0})
    changes_of(vehicle).set("GUID_OPTIONS", 8.0)
    vehicle.values["GUID_OPTIONS"] = 10.0
    again = changes_of(vehicle)
    assert again.put_back() == [] and vehicle.values == {"GUID_OPTIONS": 10.0}


def test_another_vehicle_or_another_address_has_notes_of_its_own() -> None:
    vehicle = StandIn({"GUID_OPTIONS": 0.0})
    changes_of(vehicle).set("GUID_OPTIONS", 8.0)
    vehicle.address = "tcp:127.0.0.1:5760"  # type: ignore[misc]
    assert changes_of(vehicle).pending() == []


def test_without_a_place_nothing_is_set(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (place / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(place / "file"))
    vehicle = StandIn({"GUID_OPTIONS": 0.0})
    with pytest.raises(UserError, match=r"cannot be kept there .*set XDG_STATE_HOME"):
        changes_of(vehicle).set("GUID_OPTIONS", 8.0)
    assert vehicle.values == {"GUID_OPTIONS": 0.0}


def test_a_damaged_note_names_itself() -> None:
    vehicle = StandIn({"GUID_OPTIONS": 0.0})
    changes = changes_of(vehicle)
    changes.set("GUID_OPTIONS", 8.0)
    changes.path.write_text('[{"name": "GUID_')
    with pytest.raises(UserError, match=r"cannot be read .*compare them by hand, then remove this file"):
        changes_of(vehicle)
