"""What `real_pixels` does with real recordings."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import recordings

from evflow.errors import EvflowDataError
from experiments import real_pixels
from experiments.shared import real_scores


def test_halves_of_runs_have_nothing_in_common() -> None:
    runs = [list(range(first, first + n)) for first, n in ((0, 1), (10, 2), (20, 3), (30, 5))]
    assert real_scores.in_two(runs) == [[30, 31], [32, 33]]
    assert real_scores.in_two(runs[:3]) == []


def test_a_recording_of_short_runs_determines_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(real_pixels, "read_recording", lambda _: recordings.make(count=3))
    monkeypatch.setattr(real_pixels, "plan_runs", lambda *_: [[0, 1]])
    assert real_pixels.halves(Path("short.aedat4")) is None


def test_recordings_are_read_before_cameras_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(real_pixels, "measured", lambda *_: pytest.fail("measured"))
    absent = tmp_path / "absent.aedat4"
    with pytest.raises(EvflowDataError, match=r"EV016.*absent\.aedat4"):
        real_pixels.main(real_pixels.Options(out=tmp_path / "out", recordings_at=(absent,)))
