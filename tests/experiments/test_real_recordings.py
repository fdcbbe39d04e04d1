"""A recording beside what its camera makes of its own frames, as a table says it."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.networks import hidden

from evflow.io import write_recording
from experiments import real_recordings
from experiments.shared import recordings


def test_a_row_for_each_pixel(tmp_path: Path) -> None:
    write_recording(tmp_path / "some.npz", hidden(15, 440)[0])
    result = real_recordings.main(real_recordings.Options(
        out=tmp_path / "out", recordings=(tmp_path / "some.npz",)))["some.npz"]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "real_recordings.json", "real_recordings.md", "some.png"]
    rows = (tmp_path / "out" / "real_recordings.md").read_text().splitlines()[2:]
    for row, pixel in zip(rows, real_recordings.PIXELS, strict=True):
        found = result[pixel]
        assert row.startswith(f"| some.npz | {pixel} | {found['theta_on']:.3f} ± ")
        assert 0.8 < found["events"]["on"] < 1.25
        assert found["r"]["off"] > 0.5
    assert result["ideal"]["cutoff_hz"] == result["maps alone"]["cutoff_hz"] == 0
    assert result["maps alone"]["theta_on"] == result["measured"]["theta_on"]


def test_none_is_held_where_none_lies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("EVFLOW_DATA", raising=False)
    assert recordings.held_recordings() == []
    monkeypatch.setenv("EVFLOW_DATA", str(tmp_path))
    (tmp_path / "data/recordings/ijrr_slider_depth").mkdir(parents=True)
    assert [p.name for p in recordings.held_recordings()] == ["ijrr_slider_depth"]
