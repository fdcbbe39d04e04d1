"""The fit of the fusion: what it corrects by, and what it says where nothing was searched for."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from evflow.estimation.refine.path_signs import NAMES, NEEDED
from experiments.fuse import AS_DRAWN, EXPOSURE_TOLD, KINDS, OTHER_SHAPES, drawn
from experiments.shared.fusion_fit import cross_validated, fit, of_kinds, predict

EVENTS, ROWS = 4, 600


@pytest.fixture(scope="module")
def rows() -> dict[str, np.ndarray]:
    """Stepped thresholds that are off by N(0, .2), of which the regression tells nine tenths."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(ROWS, EVENTS + len(NAMES))).astype(np.float32)
    features[:, EVENTS + NEEDED] = rng.random(ROWS) < 0.4
    y = rng.normal(size=(ROWS, 6))
    away = 0.2 * features[:, [EVENTS + NAMES.index("regression_on")]]
    true = y + away + 0.02 * rng.normal(size=(ROWS, 6))
    return {"features": features, "y": y, "true": true}


@pytest.fixture(scope="module")
def fusion(rows: dict[str, np.ndarray]) -> dict[str, Any]:
    return fit(rows, 400, 0)


def test_what_the_regression_tells_is_corrected(
    rows: dict[str, np.ndarray], fusion: dict[str, Any]
) -> None:
    y, std = predict(fusion, jnp.asarray(rows["features"]), jnp.asarray(rows["y"]))
    before, after = (float(np.abs(v - rows["true"]).mean()) for v in (rows["y"], y))
    assert after < 0.5 * before
    assert float(std.mean()) < 0.2


def test_without_a_search_nothing_is_corrected_and_the_std_is_wider(
    rows: dict[str, np.ndarray], fusion: dict[str, Any]
) -> None:
    given = jnp.asarray(rows["features"])
    hidden = given.at[:, EVENTS:].set(0.0)
    y, std = predict(fusion, hidden, jnp.asarray(rows["y"]))
    _, searched = predict(fusion, given, jnp.asarray(rows["y"]))
    assert float(np.abs(np.asarray(y) - rows["y"]).mean()) < 0.05
    assert float(std.mean()) > 1.1 * float(searched.mean())


def test_figures_are_of_cameras_found_ideal_and_of_others(rows: dict[str, np.ndarray]) -> None:
    y, std = cross_validated(rows, 50, 0)
    found = of_kinds(rows, y, std)
    needed = rows["features"][:, EVENTS + NEEDED] > 0
    assert (found["other/recordings"], found["ideal/recordings"]) == (needed.sum(),
                                                                      (~needed).sum())
    exact = of_kinds(rows, rows["true"], std)
    assert exact["ideal/theta"] == 0.0
    assert exact["other/inside_68"] == 1.0


def test_size_and_scenes_do_not_betray_the_kind_of_camera() -> None:
    numbers = range(AS_DRAWN, AS_DRAWN + len(KINDS) * len(OTHER_SHAPES))
    seen = {(KINDS[i % len(KINDS)], drawn(0, i).shape, drawn(0, i).scene) for i in numbers}
    assert len(seen) == len(set(KINDS)) * len(set(OTHER_SHAPES))
    assert drawn(0, 6).shape != drawn(0, 0).shape


def test_recordings_that_tell_their_exposure_come_last_and_tell_it() -> None:
    told = [drawn(0, i) for i in range(EXPOSURE_TOLD, EXPOSURE_TOLD + 40)]
    assert all(p.exposure_known and 2 <= p.exposure_ms <= p.frame_ms for p in told)
    assert not any(drawn(0, i).exposure_known for i in range(EXPOSURE_TOLD - 40, EXPOSURE_TOLD))
