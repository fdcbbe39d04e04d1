"""Noise rates by three systems, small: each law is its sensor's, ours keeps to its std."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from evflow import Camera, Recording, SensorModel, estimate_camera, simulate
from experiments import noise_rates
from experiments.noise_rates import Options
from experiments.shared import alone, measured_noise, noise_scenes, noise_systems
from experiments.shared.common import plain
from experiments.shared.noise_scenes import MODELS, SCENES
from experiments.shared.noise_systems import BENCH, DN, SYSTEMS, THETA, inside

KEY = jax.random.key(5)


@pytest.mark.parametrize("sensor", MODELS)
@pytest.mark.parametrize("row", [0, 5])
def test_truth_counts_and_ours_agree_at_rest(sensor: str, row: int) -> None:
    """10 s of 4096 pixels, at least 1700 events per rate: counting error, 4 std; where the truth
    is none, none."""
    recording, truth = noise_scenes.record(KEY, sensor, "flat", THETA[row], float(DN[7]), 64)
    events = truth * 64 * 64 * noise_scenes.FLAT_S
    seen = noise_scenes.counting(recording)
    assert np.abs(seen - truth)[events < 1].max(initial=0.0) == 0.0
    assert (events >= 1).sum() == (1 if sensor == "dvs346" else 2)
    some = events >= 1
    assert (np.abs(seen - truth)[some] < 4.0 * truth[some] / np.sqrt(events[some])).all()
    found = measured_noise.ours(None, recording)
    assert (np.abs(found["ours"] - truth) <= 4.0 * found["std"]).all()


def test_rest_with_a_texture_has_the_noise_of_its_light() -> None:
    """Truth of a textured scene: the mean over its pixels of their own laws, and what comes."""
    counts = np.zeros((2, 2))
    for k in range(3):
        recording, truth = noise_scenes.record(
            jax.random.fold_in(KEY, k), "eq12", "still", THETA[0], 100.0, 64)
        assert recording.frames.std(0).max() < 1.0 < recording.frames.std((1, 2)).min()
        seconds = 1e-6 * recording.events.duration_us
        counts += np.stack([recording.events.count_map().sum((1, 2)), truth * 64**2 * seconds])
    assert (np.abs(counts[0] - counts[1]) < 4 * np.sqrt(counts[1])).all()
    np.testing.assert_allclose(truth, noise_scenes.law("eq12", THETA[0], 100.0), rtol=1e-3)


def test_refused_estimates_are_neither_inside_nor_outside() -> None:
    rates = {"truth": np.ones((2, 1, 1, 2)), "ours": np.full((2, 1, 1, 2), np.nan),
             "std": np.full((2, 1, 1, 2), 0.1)}
    assert np.isnan(inside(rates)).all()
    rates["ours"][0] = [1.05, 1.15]
    assert inside(rates) == [0.5, 1.0]
    rates["ours"][0], rates["std"][0, ..., 0] = [1.0, 1.15], 0.0  # none, and known to be none
    assert inside(rates) == [0.5, 1.0]


def test_a_moving_disc_leaves_quiet_parts() -> None:
    """Its path fires far more than noise, the half of the sensor beside it no more."""
    recording, truth = noise_scenes.record(KEY, "eq12", "moving", THETA[0], 100.0, 64)
    moved = np.ptp(recording.frames.astype(float), axis=0) > 25
    counts = recording.events.count_map().sum(0)
    still = cv2.dilate(moved.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    assert 0.1 < moved.mean() < 0.5 < still.mean()
    expected = truth.sum() * 1e-6 * recording.events.duration_us
    assert counts[still].mean() == pytest.approx(expected, abs=4 * np.sqrt(expected / still.sum()))
    assert counts[moved].mean() > 5 * expected
    assert (noise_scenes.counting(recording) > 1.5 * truth).all()


def test_closed_forms_at_the_bench_and_elsewhere() -> None:
    """v2e's constant is right at the bench in sum, falls with light as Eq. 12 does, and as
    1 / threshold; the voltmeter's is its sensor's law."""
    bench = noise_scenes.law("eq12", THETA[BENCH[0]], DN[BENCH[1]])
    there = noise_systems.closed_forms(THETA[BENCH[0]], float(DN[BENCH[1]]), bench)
    assert there["v2e"].sum() == pytest.approx(bench.sum(), rel=1e-5)
    np.testing.assert_array_equal(there["constant"], bench)
    bright = noise_systems.closed_forms(THETA[BENCH[0]], float(DN[7]), bench)
    light = noise_scenes.law("eq12", THETA[BENCH[0]], DN[7]) / bench
    np.testing.assert_allclose(bright["v2e"] / there["v2e"], light, rtol=1e-5)
    other = noise_systems.closed_forms(2 * THETA[BENCH[0]], float(DN[BENCH[1]]), bench)
    np.testing.assert_allclose(other["v2e"], there["v2e"] / 2, rtol=1e-5)
    np.testing.assert_allclose(there["evolt, θ"], noise_scenes.law(
        "dvs346", THETA[BENCH[0]], DN[BENCH[1]]), rtol=1e-5)


def test_scores_leave_out_what_is_not_told() -> None:
    truth = np.zeros((3, 2, 1, 2))
    seen = np.full(truth.shape, 0.1)
    seen[..., 1] = 0.3
    seen[0, 0], seen[2] = np.nan, 0.7
    row = noise_systems.scored({"truth": truth, "a": seen, "b": truth * np.nan}, "a")
    assert row["answered"] == pytest.approx(5 / 6)
    assert row["ON"][0] == pytest.approx(0.3)  # .1, .1, .7
    assert row["OFF"][0] == pytest.approx((0.3 + 0.3 + 0.7) / 3)
    assert row["ON"][1] == pytest.approx(4.3027 * np.sqrt(0.12) / np.sqrt(3), rel=1e-3)
    assert noise_systems.scored({"truth": truth, "b": truth * np.nan}, "b")["answered"] == 0.0


def test_measured_histograms_are_shared_out(
    data_file: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three lights, the darkest of them a hundredth of a DN."""
    monkeypatch.setattr(measured_noise, "HISTOGRAM_S", 2)
    found = measured_noise.histograms(
        data_file("data/recordings/iebcs_noise_hist/noise_cumhist.npz"), None, KEY)
    assert found["lux"] == [0.1, 161.0, 3000.0]
    for shares in found["shares"].values():
        assert np.shape(shares) == (3, 2)
        assert np.nansum(shares) == pytest.approx(1.0, abs=0.3)
    assert found["distance"]["measured"] == 0.0


def small(monkeypatch: pytest.MonkeyPatch, scenes: tuple[str, ...]) -> None:
    monkeypatch.setattr(noise_rates, "SCENES", scenes)
    monkeypatch.setattr(Options, "grid", lambda *_: ([0, 5], [0, 3, 7]))
    monkeypatch.delenv("EVFLOW_DATA", raising=False)


@pytest.mark.slow
def test_table_has_all_cells_and_follows_from_the_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    small(monkeypatch, ("flat",))
    options = Options(out=tmp_path, seeds=2)
    noise_rates.main(options)
    assert capsys.readouterr().out.count("left out") == 2
    saved = json.loads((tmp_path / "noise_rates.json").read_text())
    assert saved["config"]["seed"] == options.seed
    assert set(saved["result"]["simulated"]) == set(MODELS)
    again = plain(noise_rates.table_of(None, "dvs346", "flat", options))
    assert json.loads(json.dumps(again)) == saved["result"]["simulated"]["dvs346"]["flat"]
    text = (tmp_path / "noise_rates.md").read_text()
    for sensor, scenes in saved["result"]["simulated"].items():
        rates = scenes["flat"]["rates"]
        assert set(rates) == {"truth", "std", *SYSTEMS}
        for name, values in rates.items():
            assert np.shape(values) == (2, 2, 3, 2)
            assert np.isfinite(values).all() != (name in alone.RATES)  # they need frames
        draws = np.array(rates["ours"])
        assert (draws[0, ..., 0] != draws[1, ..., 0]).all()  # each seed draws anew
        for name in SYSTEMS:
            assert f"| {sensor} | flat (6 x 2) | {name} |" in text
        for scp in (101, 201):
            row = next(x for x in text.splitlines() if x.startswith(f"| {sensor}, flat, SCP {scp}"))
            assert sum("(" in cell for cell in row.split("|")) == 3
        assert cv2.imread(str(tmp_path / f"{sensor}.png")) is not None
    assert "0.037, 0.033 | 0.026, 0.030" in text
    errors = {s: one["flat"]["errors"] for s, one in saved["result"]["simulated"].items()}
    for sensor, rows in errors.items():
        worst = max(rows["ours"]["ON"][0], rows["ours"]["OFF"][0])
        assert worst < 0.01, sensor
        assert rows["ours"]["ON"][0] < rows["constant"]["ON"][0]


def test_measured_noise(data_file: Callable[[str], Path]) -> None:
    """Ours counts what the DVXplorer sends without its hot pixels, from half of it too; v2e sees
    no difference between polarities, the voltmeter no OFF."""
    path = data_file("data/recordings/noise_static_dvxplorer640/events.npz")
    rows = measured_noise.at_rest(path, None)
    np.testing.assert_allclose(rows["counted"], [0.296, 0.248], atol=1e-3)
    np.testing.assert_allclose(rows["counted, without the top .1 %"], [0.232, 0.198], atol=2e-3)
    np.testing.assert_allclose(rows["ours"], [0.232, 0.198], rtol=0.02)
    np.testing.assert_allclose(rows["ours, first half"], rows["counted, second half"], rtol=0.05)
    assert rows["v2e, r = 1, 127 DN"].std() == 0
    assert rows["evolt, 127 DN"][1] == 0


@pytest.mark.slow
def test_every_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With frames: still and moving scenes within .05 Hz, where counting is not."""
    small(monkeypatch, SCENES)
    monkeypatch.setattr(Options, "grid", lambda *_: ([3], [3]))
    result = noise_rates.main(Options(out=tmp_path, seeds=1))
    for scene in ("still", "moving"):
        row = result["simulated"]["eq12"][scene]["errors"]
        assert max(row["ours"][side][0] for side in ("ON", "OFF")) < 0.05
    moving = result["simulated"]["eq12"]["moving"]["errors"]
    assert moving["counting"]["ON"][0] > 0.05


def test_a_dark_scene_has_no_black_level_above_its_light() -> None:
    """At 25 DN lin-log is much like log_eps less 15 DN, with thresholds 2.7 times as high."""
    key = jax.random.fold_in(jax.random.key(Options.seed), SCENES.index("moving"))
    recording, _ = noise_scenes.record(
        jax.random.fold_in(key, 0), "eq12", "moving", THETA[0], float(DN[0]), 64)
    found = estimate_camera(recording)
    assert found.sensor.log_map == "linlog"
    assert float(found.summary.theta_on) == pytest.approx(THETA[0, 0], rel=0.1)


def test_where_it_is_too_dark_to_tell_the_logarithm_the_error_says_so() -> None:
    """ESIM's pixels, found as lin-log with twice their thresholds: at 25 DN both explain all."""
    video, times = noise_scenes.video(jax.random.key(3), "moving", 25.0, 64)
    camera = Camera.constant((64, 64), 0.15, 0.2, 0.1, 0.1)
    events = simulate(jax.random.key(1), video, times, camera, model=SensorModel(kind="esim"))
    frames = np.rint(video[::25]).astype(np.uint8)
    found = estimate_camera(Recording(events, frames, times[::25]))
    for name, theta in (("theta_on", 0.15), ("theta_off", 0.2)):
        away = abs(float(getattr(found.summary, name)) - theta)
        assert away < 2 * float(getattr(found.summary_std, name))
    assert "pixels.map" in {note.code for note in found.notes}
