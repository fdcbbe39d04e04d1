"""The image experiments, small: direct integrated images and intensity changes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from evflow import estimate_camera
from evflow.camera import Camera
from evflow.light.logarithm import LIN_LOG, Logarithm
from evflow.types import Events, Recording
from experiments import changes, integrate
from experiments.shared import integrated, integrated_pages
from experiments.shared.images import mean_ci, score
from experiments.shared.recordings import cut

SHAPE = (40, 48)


def sweep(count: int = 9) -> Recording:
    """A ramp that brightens by .1 log units a frame, a quarter of it at rest; two ON events
    of .05 in each interval, near its ends."""
    rng = np.random.default_rng(0)
    base = rng.uniform(40, 90, SHAPE).astype(np.float32)
    moving = np.zeros(SHAPE, bool)
    moving[:, 12:] = True
    frames = np.stack([base * np.exp(0.1 * k * moving) for k in range(count)]).astype(np.float32)
    times = 20_000 * np.arange(count)
    y, x = np.nonzero(moving)
    t = np.repeat((times[:-1, None] + [500, 19_500]).ravel(), len(x))
    steps = 2 * (count - 1)
    return Recording(Events(np.tile(x, steps), np.tile(y, steps), t, np.ones(len(t), bool),
                            (SHAPE[1], SHAPE[0])), frames, times)


def test_means_have_the_interval_of_student() -> None:
    mean, half = mean_ci(np.array([1.0, 2.0, 3.0]))
    assert mean == 2.0
    assert half == pytest.approx(4.3027 / np.sqrt(3), rel=1e-4)
    assert mean_ci(np.array([5.0])) == (5.0, 0.0)


def test_scores_are_those_of_bytes() -> None:
    frame = np.random.default_rng(1).integers(20, 200, (1, *SHAPE)).astype(np.float32)
    rmse, psnr, windowed, whole = score(frame + 10.3, frame)[0]
    assert rmse == pytest.approx(10, abs=1e-3)
    assert psnr == pytest.approx(20 * np.log10(255 / 10), abs=1e-3)
    assert 0.9 < windowed < 1
    assert 0.9 < whole < 1


def test_what_was_not_sought_took_no_time() -> None:
    averages = integrated.averages({"ramp": {"1 frame": {
        name: [[1.0, 2.0, 3.0, 4.0, 5, took]] for name, took in (("held", None), ("ours", 2.0))}}})
    table = integrated_pages.table(averages)
    assert "4.000 |  |  |" in table  # nothing was sought
    assert "4.000 | 2.0 |  |" in table


def test_images_of_the_right_thresholds_are_the_frames() -> None:
    recording = sweep()
    right, wrong = (integrated.Thresholds(Camera.constant(SHAPE, t, t)) for t in (0.05, 0.07))
    held = integrated.Thresholds(None)
    case = integrated.Case("ramp", "", recording)
    rows = integrated.scored(case, {"right": right, "wrong": wrong, "none": held}, 24)
    assert {"1 frame", "5 frames"} <= set(rows)
    for row in rows.values():
        assert row["right"][0] < 0.5
        assert 2 * row["right"][0] < row["wrong"][0] < row["none"][0]
    assert rows["1 frame"]["right"][-1] == 8
    assert rows["5 frames"]["right"][-1] == 4


def test_our_thresholds_are_of_the_light_that_was_measured_with_them(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ECC's authors' are of their offset: other light makes other images of the same events."""
    recording = sweep()
    ours = estimate_camera(recording)
    ours = dataclasses.replace(ours, optics=dataclasses.replace(ours.optics, offset_dn=12.0))
    monkeypatch.setattr(integrated, "estimate_camera", lambda *_: ours)
    monkeypatch.setattr(integrated.alone, "fitted", lambda *_: {})
    case = integrated.Case("ramp", "", recording)
    found = integrated.thresholds(case, recording, None, ("ecc offset 40",))
    measured = Logarithm(12.0)
    assert {name: one.logarithm for name, one in found.items()} == {
        "no events": LIN_LOG, "default .2": LIN_LOG, "ecc offset 40": Logarithm(40.0, "log"),
        "ours, summary": measured, "ours, maps": measured}


def test_spans_end_at_the_first_frame_after_so_many_events() -> None:
    recording = sweep()
    per_frame = len(recording.events) // 8
    assert per_frame > 1000
    assert integrated.spans(recording, 2 * per_frame, 99)[0] == (0, 2)
    assert integrated.spans(recording, 2 * per_frame + 1, 99)[0] == (0, 3)
    assert integrated.spans(recording, 9 * per_frame, 99) == []
    assert integrated.spans(recording, 1, 3) == [(0, 1), (4, 5), (7, 8)]


def test_halves_share_the_middle_frame_and_lose_no_event() -> None:
    recording = sweep()
    first, second = integrated.halves(recording)
    assert first.frame_times[-1] == second.frame_times[0]
    assert len(first.events) + len(second.events) == len(recording.events)
    part = cut(recording, (0.02, 0.1))
    assert part.frame_times.tolist() == [20_000, 40_000, 60_000, 80_000]
    assert 0 < len(part.events) < len(recording.events)


@pytest.mark.slow
def test_integrated_images_are_scored_beside_the_paper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EVFLOW_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    result = integrate.main(integrate.Options(
        out=tmp_path, systems=("ecc", "ecc median"), seeds=1))
    for horizons in result.values():
        row = horizons["1 frame"]
        assert row["true, maps"]["rmse"][0] < row["no events"]["rmse"][0]
        assert row["ours, maps"]["rmse"][0] < row["no events"]["rmse"][0]
    assert "37.56" in (tmp_path / "integrate.md").read_text()
    assert cv2.imread(str(tmp_path / "integrate.png")) is not None


@pytest.mark.slow
def test_changes_are_told_by_every_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EVFLOW_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    result = changes.main(changes.Options(out=tmp_path, batches=1, seeds=1))
    tasks = result["recordings"]["simulated"]
    assert set(tasks) == {"next", "path", "middle"}
    for rows in tasks.values():
        for system in ("encoder", "AKF", "integration"):
            assert rows[system]["log"][0] < rows["no change"]["log"][0]
    assert tasks["next"]["frames alone"]["log"][0] < 0.1  # it is told the answer
    assert cv2.imread(str(tmp_path / "changes.png")) is not None


def test_a_picture_shows_the_systems_that_there_are(tmp_path: Path) -> None:
    frame = np.full(SHAPE, 90.0, np.float32)
    shown = [("ramp", frame, {"lgan": frame, "ours": frame})]
    integrated_pages.picture(tmp_path / "one.png", shown)
    assert cv2.imread(str(tmp_path / "one.png")) is not None
