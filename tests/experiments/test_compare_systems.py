"""The comparison of systems, small: every system has its row, errors are those of the truth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from evflow import Recording
from evflow.baselines import SYSTEMS
from evflow.light.log_maps import lin_log
from evflow.light.logarithm import Logarithm
from evflow.types import Events
from experiments import compare_systems
from experiments.compare_systems import Options
from experiments.shared import alone
from experiments.shared.compared import CONSTANT, KNOWN, OURS
from experiments.shared.second_half import Changes, blurred, halves


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


def test_thresholds_predict_frames_in_the_logarithm_they_were_measured_in() -> None:
    """Of pixels that see 20 DN more than the frames show: right ones leave next to nothing, in
    lin-log of the frames, and in another logarithm most of the change."""
    before = np.linspace(30, 90, 48).reshape(6, 8).astype(np.float32)
    after = 0.5 * (before + 20) - 20 + np.float32(6)
    counts = np.zeros((2, 6, 8), np.float32)
    counts[1] = np.log((before + 20) / (after + 20)) / 0.01
    seen = np.asarray(lin_log(after)) - np.asarray(lin_log(before))
    found = Changes(counts[None], before[None], blurred(seen)[None])
    theta = np.full((6, 8), 0.01, np.float32)
    right, wrong = (np.abs(found.left(theta, theta, Logarithm(dn))).mean() for dn in (20.0, 0.0))
    size = np.abs(found.seen).mean()
    assert right < 1e-3 * size
    assert wrong > 0.2 * size


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
