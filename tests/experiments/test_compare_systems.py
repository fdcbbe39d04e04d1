"""The comparison of systems, small: every system has its row, errors are those of the truth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from evflow import Recording
from evflow.baselines import SYSTEMS
from evflow.types import Events
from experiments import compare_systems
from experiments.compare_systems import Options
from experiments.shared import alone
from experiments.shared.compared import CONSTANT, KNOWN, OURS
from experiments.shared.second_half import halves


def test_halves_share_a_frame_and_no_event() -> None:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 200_000, 5000))
    events = Events(rng.integers(0, 8, 5000), rng.integers(0, 6, 5000), t,
                    rng.integers(0, 2, 5000), (8, 6))
    frames = rng.integers(90, 110, (9, 6, 8)).astype(np.uint8)
    recording = Recording(events, frames, 25_000 * np.arange(9))
    first, second = halves(recording)
    assert first.frame_times[-1] == second.frame_times[0] == 100_000
    assert first.events.t[-1] < 100_000 <= second.events.t[0]
    assert len(first.events) + len(second.events) == len(events)


@pytest.mark.slow
def test_every_system_is_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = tmp_path / "rows.json"
    result = compare_systems.main(Options(out=tmp_path, sequences=1, rows=rows))
    text = capsys.readouterr().out
    for systems in result["simulated"].values():
        assert set(systems) == {*SYSTEMS, OURS, CONSTANT, KNOWN, alone.PAPER_FLOW, alone.FLOW,
                                alone.NETWORK, alone.SUMMARY}
        for row in systems.values():
            assert row["recordings"] == 1
            assert np.isfinite([v for v in row.values()]).all()
        constant = systems[CONSTANT]
        assert constant["mae_sequence/on"] == pytest.approx(constant["median/on"], abs=1e-6)
        assert systems[KNOWN]["median/on"] < constant["median/on"]
    assert "0.023 | 0.022" in text
    saved = json.loads((tmp_path / "compare_systems.json").read_text())
    assert saved["config"]["systems"]["match"] == repr(SYSTEMS["match"])
    assert cv2.imread(str(tmp_path / "compare_systems.png")) is not None
    assert compare_systems.main(Options(out=tmp_path / "2", sequences=1, rows=rows)) == result
