"""Notes: values with a code to act on and a sentence to read."""

from __future__ import annotations

import ast
import dataclasses
import json
import pickle
from pathlib import Path

import pytest
from helpers.recordings import make

import evflow
from evflow.errors import CODES, EvflowDataError
from evflow.io.formats import npz
from evflow.io.hints import Hints
from evflow.notes import NOTES, Note, as_dicts, texts
from evflow.recordings.check.findings import Finding
from evflow.types import Recording

HOT = Note("pixels.hot", "4 hot pixels.")


def test_a_note_is_a_value() -> None:
    assert str(HOT) == HOT.text
    assert HOT == Note("pixels.hot", "4 hot pixels.") != Note("pixels.dead", "4 hot pixels.")
    assert len({HOT, Note("pixels.hot", "4 hot pixels.")}) == 1
    assert pickle.loads(pickle.dumps(HOT)) == HOT
    with pytest.raises(dataclasses.FrozenInstanceError):
        HOT.code = "pixels.dead"  # type: ignore[misc]


def test_only_known_codes_are_noted() -> None:
    with pytest.raises(ValueError, match=r"pixels\.warm"):
        Note("pixels.warm", "4 warm pixels.")
    assert not set(NOTES) & set(CODES)


def test_notes_go_into_json() -> None:
    assert json.loads(json.dumps(as_dicts([HOT]))) == [
        {"code": "pixels.hot", "text": "4 hot pixels."}]
    assert texts([HOT, HOT]) == ["4 hot pixels."]


def test_a_finding_is_a_note_of_its_code() -> None:
    found = Finding("EV024", "warning", "12 ms apart.", "Move them.")
    assert found.note() == Note("EV024", str(found))


def test_a_recording_takes_notes_alone() -> None:
    events = make(10).events
    assert Recording.of_events(events, (HOT,)).notes == (HOT,)
    with pytest.raises(EvflowDataError, match="EV020"):
        Recording.of_events(events, ("4 hot pixels.",))  # type: ignore[arg-type]


def test_every_code_in_the_table_is_used() -> None:
    """As a word of the source, or as the end of one that begins with a name."""
    root = Path(evflow.__file__).parent
    words = {node.value for path in root.rglob("*.py") if path.name != "notes.py"
             for node in ast.walk(ast.parse(path.read_text()))
             if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    made = {f"theta_{side}.{end}" for side in ("on", "off")
            for end in ("drift", "extrapolated", "uncertain", "undetermined")
            if f".{end}" in words}
    made |= {f"pixels.{kind}" for kind in ("hot", "dead") if {"pixels.", kind} <= words}
    assert set(NOTES) <= words | made


def test_hints_do_not_change_while_a_file_is_read(tmp_path: Path) -> None:
    evflow.write_events(tmp_path / "a.npz", make(100).events, "npz")
    hints = Hints(size=(2, 2), drop_outside=True)
    before = dataclasses.asdict(hints)
    for _ in range(2):  # of the same hints twice, the note once each
        found = npz.read(tmp_path / "a.npz", hints)
        assert [note.code for note in found.notes] == ["events.outside"]
    assert dataclasses.asdict(hints) == before
