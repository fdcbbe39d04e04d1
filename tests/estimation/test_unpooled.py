"""Weights that see pixels alone: the mean of the windows' maps, and errors that nobody made up."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.networks import hidden, random_params

from evflow import CameraEstimator, estimate_camera
from evflow.camera import Camera
from evflow.camera.optics import read_summary
from evflow.errors import EvflowDataError
from evflow.estimation import unpooled
from evflow.network.config import MODELS
from evflow.report.text import describe
from evflow.report.verdict import judge_estimate, known


@pytest.fixture(scope="module")
def params() -> dict[str, Any]:
    paper = MODELS["paper"]
    small = dataclasses.replace(paper.flow, steps=2, hidden=16)
    return random_params(dataclasses.replace(paper, flow=small), "paper")


@pytest.fixture
def found(params: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Any:
    """An estimate of windows whose maps are known: one pixel is never shown, one falls below."""
    recording, _ = hidden(3)
    maps = np.broadcast_to(np.array([0.2, 0.3, 0.1, 0.4])[:, None, None], (4, 48, 64)).copy()
    maps[0, :, 32:], maps[2, 5, 6] = 0.4, -1.0
    shown = np.ones((48, 64), bool)
    shown[0, 0] = False
    steps = iter(range(1, 100))
    monkeypatch.setattr(unpooled, "window_map", lambda *_: (
        maps + 0.01 * next(steps) - 0.035, shown))
    return estimate_camera(recording, params)


def test_maps_are_the_mean_of_the_windows(found: Any) -> None:
    assert found.windows == 6
    theta = np.asarray(found.camera.theta_on)
    np.testing.assert_allclose(theta[10, [3, 60]], [0.2, 0.4], atol=1e-6)
    np.testing.assert_allclose(found.summary.theta_off, 0.3, atol=1e-6)
    assert 0.2 <= theta[0, 0] <= 0.4  # where nothing was shown, as the others
    assert float(found.camera.eta_on[5, 6]) == 0.0
    assert [note.code for note in found.notes] == ["std.none", "maps.raised"]


def test_no_error_is_made_up(found: Any, tmp_path: Path) -> None:
    for std in (found.std, found.summary_std):
        assert all(np.isnan(np.asarray(v)).all() for v in dataclasses.asdict(std).values())
    assert known(found, "on")
    judged = judge_estimate(found, None, None)
    assert [j.grade for j in judged[:2]] == ["fair", "fair"]
    assert "do not estimate the error" in judged[0].seen
    assert "± –" in describe(found)
    told = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert told["summary_std"]["theta_on"] is None
    path = found.save(tmp_path / "camera.npz")
    camera, std_maps = Camera.load_with_std(path)
    np.testing.assert_array_equal(camera.theta_on, found.camera.theta_on)
    assert std_maps is None
    summary, std = read_summary(path) or ({}, {})
    assert summary["theta_off"] == pytest.approx(0.3, abs=1e-6)
    assert np.isnan(std["theta_off"])


@pytest.mark.slow
def test_the_flow_itself_is_run(params: dict[str, Any]) -> None:
    found = estimate_camera(hidden(3)[0], params)
    assert found.windows == 6
    assert np.asarray(found.camera.theta_on).std() > 0


def test_an_estimator_of_pieces_needs_weights_that_pool(params: dict[str, Any]) -> None:
    with pytest.raises(EvflowDataError, match=r"EV018.*every pixel separately"):
        CameraEstimator(params, refine="off")
