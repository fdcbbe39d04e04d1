"""The experiment scripts, small: they run, resume, and write what they say."""

from __future__ import annotations

import collections
import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
import pytest

from evflow.errors import EvflowDataError
from evflow.network.weights import load_weights, model_card
from evflow.scenes import make_bank
from evflow.training.options import TrainOptions
from evflow.training.run import train_network
from experiments import (
    calibrate,
    changes,
    coverage,
    curves,
    evaluate,
    generate,
    one_polarity,
    quickstart,
    true_video,
)
from experiments.shared import curves_pages, hidden_scene
from experiments.shared.cameras import Protocol
from experiments.shared.generated_pages import auroc


def test_quickstart_draws_truth_beside_estimate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bank = make_bank(jax.random.key(0), 8, photos=False)
    monkeypatch.setattr(hidden_scene, "make_bank", lambda *_: bank)
    options = quickstart.Options(out=tmp_path, width=64, height=48, milliseconds=150)
    result = quickstart.main(options)
    text = capsys.readouterr().out
    assert "truth" in text
    assert "threshold ON" in text
    assert 0.7 < result["rate_remade"]["on"] / result["rate_recorded"]["on"] < 1.4
    page = cv2.imread(str(tmp_path / "quickstart.png"))
    assert page is not None
    assert min(page.shape[:2]) > 600
    saved = json.loads((tmp_path / "result.json").read_text())
    assert saved["result"] == result
    assert saved["config"]["seed"] == options.seed
    for polarity in ("on", "off"):
        ratio = result["rate_remade"][polarity] / result["rate_recorded"][polarity]
        assert 0.7 < ratio < 1.4


@pytest.mark.slow
def test_train_stops_resumes_and_calibrates(tmp_path: Path) -> None:
    out = tmp_path / "run"
    train_network(TrainOptions(out=out, preset="debug", steps=4))
    weights = out / "weights.safetensors"
    assert model_card(weights)["steps"] == 4
    assert len((out / "metrics.jsonl").read_text().splitlines()) == 4
    with pytest.raises(EvflowDataError, match="EV013"):
        train_network(TrainOptions(out=out, preset="debug", steps=4, resume="never"))
    calibrate.main(calibrate.Options(weights=weights, out=tmp_path / "final.safetensors", steps=2))
    before, after = load_weights(weights), load_weights(tmp_path / "final.safetensors")
    same = {part: all(np.array_equal(a, b) for a, b in zip(
        *(jax.tree.leaves(p["default"][part]) for p in (before, after)), strict=True))
        for part in before["default"]}
    assert same == {"encoder": True, "flow": True, "spread": False, "summary": True}


@pytest.mark.slow
def test_interrupted_training_equals_straight_training(tmp_path: Path) -> None:
    straight, halves = tmp_path / "straight", tmp_path / "halves"
    train_network(TrainOptions(out=straight, preset="debug", steps=3))
    train_network(TrainOptions(out=halves, preset="debug", steps=3, max_seconds=0.0))
    train_network(TrainOptions(out=halves, preset="debug", steps=3, resume="must"))
    a, b = (load_weights(p / "weights.safetensors") for p in (straight, halves))
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.slow
def test_evaluate_prints_the_paper_beside_ours(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = evaluate.main(evaluate.Options(out=tmp_path, sequences=4))
    assert "0.023" in capsys.readouterr().out
    assert {"0.03", "0.15"} < set(results)
    row = results["0.03"]["theta_on"]
    assert 0 < row["summary"] < row["constant"]
    assert row["constant_truth"] == pytest.approx(0.024, abs=0.003)


@pytest.mark.slow
def test_the_true_video_gives_ratios(tmp_path: Path) -> None:
    result = true_video.main(true_video.Options(out=tmp_path, sequences=3))
    row = result["0.03"]["theta_on, all"]
    assert row["ratio"] == pytest.approx(row["ours"] / row["known"])
    assert 0 < result["0.03 free noise"]["eta_on, all"]["known"] < 0.1


@pytest.mark.slow
def test_coverage_counts_what_it_says(tmp_path: Path) -> None:
    result = coverage.main(coverage.Options(out=tmp_path, recordings=6))
    for curves_of in result["curves"].values():
        for curve in curves_of.values():
            assert (np.diff(curve) >= 0).all()
    counted = sum(v["recordings"] for k, v in result["strata"].items()
                  if k.startswith("theta_on, seconds"))
    assert counted == result["cameras"]
    assert cv2.imread(str(tmp_path / "coverage.png")) is not None


@pytest.mark.slow
def test_one_polarity_alone_is_scored_and_said(tmp_path: Path) -> None:
    result = one_polarity.main(one_polarity.Options(out=tmp_path))
    assert set(result) == set(one_polarity.CASES)
    assert all(row["said"] > 0.5 and row["std"] > 0 for row in result.values())


@pytest.mark.slow
def test_curves_compare_like_with_like_and_count_what_they_use() -> None:
    def row(signal: float, *lengths: int) -> dict[str, np.ndarray]:
        return {"signal": np.full(4, signal), "refined": np.full(4, 0.1),
                **{f"network {ms}": np.full(4, 0.2) for ms in lengths}}

    rows = [row(300, 25, 50, 100), row(5000, 25, 50), row(10, 25, 50, 100)]
    assert curves_pages.point(rows, "network 100") == {
        "recordings": 1, "theta": pytest.approx(0.2), "eta": pytest.approx(0.2)}
    assert curves_pages.point(rows, "refined", 0, 1000)["recordings"] == 2
    slow = dataclasses.replace(curves.BASE, frame_ms=20)
    assert curves.alike({curves.BASE: rows, slow: rows}) == [rows[0], rows[2]]
    counted = {kind: curves_pages.point(rows, key)
               for kind, key in (("refined", "refined"), ("network", "network 100"))}
    text = curves_pages.table({"duration [ms]": {50: counted}})
    assert "| 50 | 2 / 1 |" in text


def test_a_protocol_of_two_settings_is_simulated_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Protocol] = []

    def study(_score: object, _setup: object, protocols: list[Protocol], *_: object
              ) -> list[dict[str, np.ndarray]]:
        seen.append(protocols[0])
        return [{"signal": np.full(4, 300.0), "refined": np.ones(4), "network 50": np.ones(4)}]

    monkeypatch.setattr(curves, "study", study)
    curves.main(curves.Options(out=tmp_path, preset="full", recordings=1))
    assert len(set(seen)) == len(seen) == len(
        [*curves.RATES, *curves.DURATIONS, *curves.SPEEDS]) - 1


def test_curves_are_drawn(tmp_path: Path) -> None:
    result = curves.main(curves.Options(out=tmp_path, recordings=1))
    assert {"frame interval [ms]", "duration [ms]", "signal events"} < set(result)
    assert cv2.imread(str(tmp_path / "curves.png")) is not None


@pytest.mark.slow
def test_generated_events_are_compared_with_simulated_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is typical comes of simulations that are not scored themselves."""
    keys: collections.Counter[bytes] = collections.Counter()
    simulated = generate.simulated

    def counted(key: jax.Array, *args: Any) -> jax.Array:
        keys[np.asarray(jax.random.key_data(key)).tobytes()] += 1
        return simulated(key, *args)

    monkeypatch.setattr(generate, "simulated", counted)
    result = generate.main(generate.Options(out=tmp_path, scenes=2, shape=(32, 32)))
    assert {"as it is", "ON halved", "single pixels doubled", "auroc"} < set(result)
    assert 0 < result["as it is"]["two simulations"] <= 1
    for name in ("as it is", "halved", "doubled"):
        assert 0.8 < result[name]["on"] < 1.25
        assert 0.8 < result[name]["off"] < 1.25
    assert sum(n == 1 for n in keys.values()) == 2 * generate.REFERENCES


def test_equal_scores_count_half() -> None:
    inside, outside = np.array([[1.0, 2.0]]), np.array([[0.0, 2.0]])
    assert auroc(inside, outside) == (1 + 0 + 1 + 0.5) / 4


@pytest.mark.slow
def test_the_encoder_is_scored_beside_frames_and_events(tmp_path: Path) -> None:
    result = changes.main(changes.Options(out=tmp_path, batches=1))
    assert result["frames alone"]["log"] < result["no change"]["log"]
