"""The fit of the fusion: what it corrects by, and what it says where nothing was searched for."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from evflow.estimation.refine.path_signs import NAMES, NEEDED
from experiments.fuse import AS_DRAWN, EXPOSURE_TOLD, KINDS, OTHER_SHAPES, drawn, told
from experiments.shared.fusion_fit import (
    cross_validated,
    fit,
    folds_of,
    of_kinds,
    predict,
    scaling_of,
)
from experiments.shared.real_cameras import draw_real, draw_single

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


def test_a_continued_fit_begins_from_what_was_learnt(
    rows: dict[str, np.ndarray], fusion: dict[str, Any]
) -> None:
    """On few rows it corrects as before, where as few steps anew learn next to nothing."""
    few, rest = ({k: v[part] for k, v in rows.items()} for part in (slice(40), slice(40, None)))
    features, y = jnp.asarray(rest["features"]), jnp.asarray(rest["y"])
    missed = {start is None: float(np.abs(predict(fit(few, 30, 0, start), features, y)[0]
                                          - rest["true"]).mean()) for start in (None, fusion)}
    assert missed[False] < 0.5 * missed[True]


def test_a_continued_fit_clips_to_both_ranges(
    rows: dict[str, np.ndarray], fusion: dict[str, Any]
) -> None:
    wide = {**rows, "features": rows["features"] * [2.0, 0.5, *[1.0] * (EVENTS + len(NAMES) - 2)]}
    new = scaling_of(wide["features"], fusion)
    assert new["high"][0] > 1.5 * fusion["high"][0]
    assert new["low"][0] < 1.5 * fusion["low"][0]
    assert (new["low"][1], new["high"][1]) == (fusion["low"][1], fusion["high"][1])
    assert new["scale"] is fusion["scale"]


def test_every_fold_has_recordings_of_every_kind() -> None:
    folds = folds_of(3000, 0)
    for regular in (AS_DRAWN, EXPOSURE_TOLD, len(KINDS)):
        assert set(folds[::regular]) == set(folds)
    assert np.ptp(np.bincount(folds)) <= 1


def test_size_and_scenes_do_not_betray_the_kind_of_camera() -> None:
    numbers = range(0, AS_DRAWN * len(KINDS) * len(OTHER_SHAPES) * EXPOSURE_TOLD, AS_DRAWN)
    seen = {(KINDS[i % len(KINDS)], drawn(0, i).shape, drawn(0, i).scene) for i in numbers
            if not told(i)}
    assert len(seen) == len(set(KINDS)) * len(set(OTHER_SHAPES))
    assert drawn(0, 6).shape != drawn(0, 0).shape


def test_every_fifteenth_recording_tells_its_exposure() -> None:
    cameras = [drawn(0, i) for i in range(20 * EXPOSURE_TOLD) if told(i)]
    assert len(cameras) == 20
    assert all(p.exposure_known and 2 <= p.exposure_ms <= p.frame_ms for p in cameras)


def test_noise_follows_the_thresholds_in_a_quarter_of_cameras_as_they_may_be() -> None:
    """Where it always does, the fusion takes noise for a high threshold."""
    kinds = [drawn(0, i).prior.noise for i in range(340)
             if KINDS[i % len(KINDS)] in (draw_real, draw_single)]
    assert 0.15 < kinds.count("eq12") / len(kinds) < 0.35
    assert kinds.count("none") > 5


def test_single_faults_are_all_drawn() -> None:
    cameras = [draw_single(np.random.default_rng(i)) for i in range(300)]
    for fault in ("black_dn", "dark_dn", "exposure_ms"):
        assert 0.02 < np.mean([getattr(p, fault) != 0 for p in cameras]) < 0.4
    models = {(p.model.kind, p.model.log_map, p.model.cutoff_hz > 0, p.model.refractory_s > 0,
               p.model.shot_hz > 0) for p in cameras}
    assert len(models) == 7
