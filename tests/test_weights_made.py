"""The scripts that make the released weights, in small: each changes its own part alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from networks import hidden

from evflow import estimate_camera, load_weights
from evflow.weights import model_card, weights_path
from experiments import fuse, tell_apart

pytestmark = pytest.mark.slow
RELEASED = weights_path("default")


def changed(before: dict[str, Any], after: dict[str, Any]) -> set[str]:
    """Top-level parts of two networks that differ."""
    (_, one), (_, two) = (next(iter(w.items())) for w in (before, after))
    same = jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), one, two)
    return {part for part, leaves in same.items() if not all(jax.tree.leaves(leaves))}


def test_the_fusion_is_fitted_and_resumes(tmp_path: Path) -> None:
    rows = tmp_path / "rows.npz"
    options = fuse.Options(RELEASED, tmp_path / "first.safetensors", recordings=12, steps=20,
                           rows=rows)
    first = fuse.main(options)
    assert first["recordings"] <= 12
    again = fuse.main(fuse.Options(RELEASED, tmp_path / "again.safetensors", recordings=12,
                                   steps=20, rows=rows))
    assert again == first
    made = load_weights(options.out)
    assert changed(load_weights("default"), made) == {"fusion"}
    assert model_card(options.out)["fusion"]["recordings"] == 12
    found = estimate_camera(hidden(14, 300)[0], made)
    assert np.isfinite(float(found.summary.theta_on))


def test_noise_is_told_apart_by_a_network_and_its_std_is_calibrated(tmp_path: Path) -> None:
    options = tell_apart.Options(RELEASED, tmp_path / "told.safetensors", recordings=15, steps=60)
    figures = tell_apart.main(options)
    assert figures["recordings"] == 3  # held out
    assert 0 < figures["mean"] < 1.0
    made = load_weights(options.out)
    assert changed(load_weights("default"), made) == {"signal"}
    (net,) = made.values()
    assert float(net["signal"]["widen"]) == pytest.approx(figures["widen"])
    assert np.isfinite(float(estimate_camera(hidden(14, 300)[0], made).summary.eta_on))
