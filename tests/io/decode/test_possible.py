"""Values that no event has: where they are, and what lies before them with --partial."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import refused

from evflow.io import read_recording, write_recording
from evflow.io.decode.chunk import Chunk
from evflow.io.decode.possible import first_odd, possible_times
from evflow.types import Events, Recording


@pytest.mark.parametrize(("bad", "code"), [
    ("99999999999999999999.0 1 1 1", "EV003"), ("0.2005 1 1 7", "EV006"),
    ("0.2005 1.5 1 1", "EV003"), ("0.2005 900 1 1", "EV005"), ("nan 1 1 1", "EV009")])
def test_what_comes_before_is_read(tmp_path: Path, bad: str, code: str) -> None:
    rows = [f"{0.001 * i:.6f} {i % 5} {i % 4} {i % 2}" for i in range(1, 400)]
    path = tmp_path / "a.txt"
    path.write_text("\n".join(["5 4", *rows[:200], bad, *rows[200:]]) + "\n")
    error = refused(path)
    assert error.code == code
    assert "200 events up to 0.199 s before that are sound" in error.seen
    assert "--partial" in error.fix or code == "EV005"
    found = read_recording(path, partial=True)
    assert len(found.events) == 200
    assert [note.code for note in found.notes] == ["events.partial"]


@pytest.mark.parametrize("garbage", [b"\xff" * 64, bytes(range(64))])
def test_an_aedat4_with_damaged_bytes(tmp_path: Path, garbage: bytes) -> None:
    """Wherever they are: a time beyond all, one that goes back, or a place outside the sensor."""
    pytest.importorskip("lz4")
    rng, n = np.random.default_rng(0), 40_000
    t = np.sort(rng.integers(0, 10**6, n)) + 5
    events = Events(rng.integers(0, 64, n), rng.integers(0, 48, n), t, rng.random(n) < 0.5,
                    (64, 48))
    path = tmp_path / "a.aedat4"
    write_recording(path, Recording.of_events(events))
    whole = path.read_bytes()
    for at in range(len(whole) // 4, len(whole) - 200, len(whole) // 5):
        path.write_bytes(whole[:at] + garbage + whole[at + 64:])
        part = read_recording(path, partial=True).events
        assert 0 < len(part) <= n
        np.testing.assert_array_equal(part.t[:-1_000], events.t[:len(part)][:-1_000])


def test_times_of_another_unit_are_no_damage(tmp_path: Path) -> None:
    t = 1_643_243_628_737_093 + np.arange(60)
    path = tmp_path / "a.txt"
    path.write_text("4 4\n" + "".join(f"{time} 1 1 1\n" for time in t))
    assert "--time-unit us" in refused(path, time_unit="s").fix


def test_the_first_odd_one_is_found() -> None:
    t = np.array([1, 2, 3, 2**63], np.uint64)
    assert possible_times(t, "us").tolist() == [True, True, True, False]
    assert possible_times(np.array([0.5, np.nan, np.inf]), "s").tolist() == [True, False, False]
    p = np.array([0, 1, 5, 1])
    chunk = Chunk(np.zeros(4), np.zeros(4), t, p, int)
    assert first_odd(chunk, "us") == (2, "p")
    assert first_odd(chunk._replace(p=p % 2), "us") == (3, "t")
    assert first_odd(chunk._replace(p=p % 2, t=np.arange(4)), "us") is None
