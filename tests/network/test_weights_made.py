"""The scripts that make the released weights, in small: each changes its own part alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from helpers.networks import hidden

from evflow import estimate_camera, load_weights
from evflow.errors import EvflowDataError
from evflow.network.weights import model_card, save_weights, weights_path
from experiments import combine, fuse, tell_apart

RELEASED = weights_path("default")


def changed(before: dict[str, Any], after: dict[str, Any]) -> set[str]:
    """Top-level parts of two networks that differ."""
    (_, one), (_, two) = (next(iter(w.items())) for w in (before, after))
    same = jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), one, two)
    return {part for part, leaves in same.items() if not all(jax.tree.leaves(leaves))}


def doubled(path: Path) -> str:
    """Weights twice the released ones, as a run that trained pixels alone writes them."""
    (name, net), = load_weights("default").items()
    twice = {k: jax.tree.map(lambda a: 2 * a, net[k]) for k in (*combine.PIXELS, "summary")}
    save_weights(path, {name: twice}, {"steps": 3})
    return str(path)


@pytest.mark.parametrize(("part", "differ"), [
    ("pixels", {"encoder", "flow", "spread"}), ("summary", {"summary"})])
def test_parts_are_taken_from_other_weights(
    part: str, differ: set[str], tmp_path: Path
) -> None:
    first, out = tmp_path / "first.safetensors", tmp_path / "new.safetensors"
    save_weights(first, load_weights("default"), {"pixels": {"steps": 1}, "calibration": {},
                                                  "fusion": {}, "signal": {}})
    run = doubled(tmp_path / "run.safetensors")
    taken = {"pixels": (run,)} if part == "pixels" else {"summary": run}
    combine.main(combine.Options(str(first), out, **taken))
    before, made = load_weights("default"), load_weights(out)
    gone = set() if part == "pixels" else {"fusion", "signal"}  # they answer to the summary
    kept = {name: {k: v for k, v in net.items() if k not in gone} for name, net in before.items()}
    assert set(made["default"]) == set(kept["default"])
    assert changed(kept, made) == differ
    assert model_card(out)[part] == {"steps": 3}
    assert gone.isdisjoint(model_card(out))  # no figures of what is not there
    assert ("calibration" in model_card(out)) == (part == "summary")  # it is of the pixels
    with pytest.raises(EvflowDataError, match="neither"):
        combine.main(combine.Options("default", out))


def test_the_mean_of_several_runs_is_taken(tmp_path: Path) -> None:
    twice, out = doubled(tmp_path / "run.safetensors"), tmp_path / "mean.safetensors"
    combine.main(combine.Options("default", out, pixels=("default", twice)))
    (before,), (made,) = (load_weights(w).values() for w in ("default", out))
    for part in combine.PIXELS:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(b, 1.5 * a, rtol=1e-6),
                     before[part], made[part])
    assert model_card(out)["pixels"]["steps"] == 3
    assert len(model_card(out)["pixels"]["mean_with"]) == 1


@pytest.mark.slow
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


@pytest.mark.slow
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
