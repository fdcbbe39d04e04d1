"""Each estimator by itself: its errors by hand, and rows that say whose they are."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.light.logarithm import LIN_LOG, Logarithm
from experiments.shared import alone, compared, evaluated

SHAPE = (4, 6)


def test_errors_by_hand() -> None:
    nominal = np.array([0.2, 0.3, 0.1, 0.1])
    truth = np.broadcast_to(nominal[:, None, None], (4, *SHAPE)).copy()
    truth[0, :, :3] += 0.1
    fired = np.zeros((4, *SHAPE), bool)
    fired[0, :, 0] = True
    flat = np.broadcast_to(nominal[:, None, None], truth.shape)
    found = alone.errors([flat, flat + 0.02], truth, nominal, fired)
    np.testing.assert_allclose(found["mae_sequence"], 0.01)  # of windows that are 0 and .02 off
    np.testing.assert_allclose(found["mae_pixel"], [0.5 * (0.09 + 0.01), *[0.01] * 3])
    assert found["mae_fired"][0] == pytest.approx(0.09)
    assert np.isnan(found["mae_fired"][1:]).all()
    np.testing.assert_allclose(found["median"], 0.01)
    # A map that is right about its pixels: its error is none, its mae_sequence is not.
    right = alone.errors([truth], truth, nominal, fired)
    assert right["mae_pixel"][0] == 0
    assert right["mae_sequence"][0] == pytest.approx(0.05)


def test_a_scene_at_rest_has_no_rows() -> None:
    found: Any = SimpleNamespace(windows=0)
    assert alone.fitted({}, None, found, 1.0) == {}  # type: ignore[arg-type]


def test_each_estimator_was_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(*_: Any) -> list[np.ndarray]:
        time.sleep(0.01)
        return [np.full((4, *SHAPE), 0.2)]

    names = (alone.PAPER_FLOW, alone.NETWORK, alone.SUMMARY, alone.WINDOW)
    monkeypatch.setattr(alone, "estimators", lambda *_: dict.fromkeys(names, slow))
    found: Any = SimpleNamespace(
        valid=np.ones(SHAPE, bool), optics=Optics(12.0), sensor=SensorModel(log_map="log_eps"))
    made = alone.fitted({}, None, found, 7.0)  # type: ignore[arg-type]
    assert made.keys() == set(names) - {alone.WINDOW}
    assert 7 > made[alone.PAPER_FLOW].seconds >= 0.01 <= made[alone.NETWORK].seconds
    assert made[alone.SUMMARY].seconds == 7
    assert made[alone.SUMMARY].logarithm == Logarithm(12.0, "log_eps")
    assert made[alone.NETWORK].logarithm == LIN_LOG


def test_rows_of_evaluate_name_the_estimator_and_lack_what_none_tells() -> None:
    rows = [{f"{k}/{name}": 0.5 for name in evaluated.PAPER for k in (
        "true", "summary", "mae_sequence", "mae_pixel", "mae_fired", "constant", "constant_truth",
        "map_gain", *(f"{alone.PAPER_FLOW}: {metric}" for metric in evaluated.METRICS))}
        | {f"{k}/{name}": np.nan for name in evaluated.PAPER
           for k in ("network", "inside_68", "inside_95")}
        | {f"signal/{name}": 1e3 for name in evaluated.PAPER} for _ in range(3)]
    text = evaluated.table({"0.03": evaluated.averages(rows)})
    assert f"| {alone.PAPER_FLOW} | 0.03 | theta_on | 0.5000 |" in text
    assert f"| {alone.FLOW} |" not in text
    first = text.splitlines()[2].split(" | ")
    assert first[3] == "–"  # no network pools
    assert first[-1].startswith("–")  # no interval was given


def test_intervals_of_few_recordings_are_wide() -> None:
    values = [0.01, 0.02, 0.06]
    rows = [{f"{k}/theta_on": value if k == "summary" else 1e3 for k in (
        "true", "summary", "signal", "map_gain")} | {
        f"true/{name}": 0.0 for name in list(evaluated.PAPER)[1:]} for value in values]
    found = evaluated.averages(rows)["theta_on"]
    assert found["summary_ci95"] == pytest.approx(4.3027 * np.std(values, ddof=1) / np.sqrt(3),
                                                  rel=1e-4)
    assert compared.standard_error(values) == pytest.approx(stats.sem(values))
    assert compared.standard_error(values[:1]) == 0


@pytest.mark.parametrize(("error", "width", "within"), [(0.1, 0.2, 1.0), (-0.3, 0.2, 0.0)])
def test_within(error: float, width: float, within: float) -> None:
    assert evaluated.inside(error, width) == within
    assert np.isnan(evaluated.inside(error, float("nan")))
