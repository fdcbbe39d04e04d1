"""Ablations: what differs, which rate is taken, what the table says, that they train and score."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import evflow as ef
from evflow import load_weights
from evflow.training.config import as_dict
from experiments import ablate
from experiments.shared import ablate_pages, ablated, variants
from experiments.shared.common import slug

STUDIES = ("losses", "steps", "networks")
BASE = ablated.base_config(400, small=False)


def flat(value: Any, name: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {name: value}
    return {k: v for key, part in value.items() for k, v in flat(part, f"{name}.{key}").items()}


@pytest.mark.parametrize(("study", "of"), [("losses", ".loss."), ("steps", ".model.flow.steps")])
def test_variants_differ_in_what_is_ablated_alone(study: ablated.Study, of: str) -> None:
    base = flat(as_dict(BASE))
    for config in ablated.chosen(study, BASE).values():
        changed = {k for k, v in flat(as_dict(config)).items() if base[k] != v}
        assert all(name.startswith(of) for name in changed)
    assert base[".model.pool"] is False  # no summary, so none to hand over


def test_the_two_networks_see_the_same_cameras() -> None:
    paper, ours = map(as_dict, ablated.chosen("networks", BASE).values())
    assert ours["model"]["pool"]
    assert ours["model"]["flow"]["steps"] == paper["model"]["flow"]["steps"]
    same = set(paper) - {"model", "loss", "parts"}
    assert all(paper[k] == ours[k] for k in same)


def row(theta: float, **more: float) -> variants.Row:
    return {f"{kind}/{name}": theta for kind in ("sequence", "pixel") for name in variants.NAMES
            } | {"events": 1.0, "log p(z)": 0.0, "seconds": 1.0} | more


def test_a_rate_at_which_training_diverged_is_not_taken() -> None:
    assert variants.error_of(row(0.2)) < variants.error_of(row(np.nan))


@pytest.mark.parametrize("best", variants.RATES)
def test_the_best_rate_lies_between_worse_ones(best: float) -> None:
    tried: list[float] = []

    def error(rate: float) -> float:
        tried.append(rate)
        return abs(np.log(rate / best))

    assert variants.best_rate(error) == best
    at = variants.RATES.index(best)
    assert set(variants.RATES[max(at - 1, 0):at + 2]) <= set(tried)
    assert len(tried) == len(set(tried))


def test_the_table_says_what_so_many_seeds_show(tmp_path: Path) -> None:
    """Differences -.01 and -.03: mean -.02, Student's t of one degree 12.706, times .01."""
    result = {ablate_pages.CONSTANT: row(0.1),
              "L_P": {"rate": 1.0, "seeds": [row(0.10), row(0.12)]},
              "L_P + L_E": {"rate": 0.3, "seeds": [row(0.09), row(0.09)]}}
    lines = ablate_pages.table(result, 400).splitlines()
    assert lines[-1].startswith("| L_P + L_E | 0.090 / 0.090 | 0.037 / 0.073 |")
    assert "| -0.0200 | 0.1271 |" in lines[-1]
    assert lines[-3].startswith("| constant | 0.100 / 0.100 |  |")
    ablate_pages.draw(result, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_weights_that_are_not_made_again_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("Trainer", "make_errors"):
        monkeypatch.setattr(variants, name, lambda *_: None)
    monkeypatch.setattr(ablate, "resumed", lambda *_: [row(0.1)])
    options = ablate.Options("losses", out=tmp_path, rows=tmp_path / "rows.json")
    for _ in range(2):
        ablate.compared("L_P", BASE, (None, None), [0], options)
        (tmp_path / "L_P.safetensors").touch()
    assert capsys.readouterr().out.count("L_P.safetensors is not written") == 1


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES)
def test_ablations_train_and_score(study: ablated.Study, tmp_path: Path) -> None:
    def run(out: Path) -> dict[str, Any]:
        return ablate.main(ablate.Options(
            study, out=out, steps=2, batches=1, rows=tmp_path / "rows.json"))

    result = run(tmp_path)
    names = [name for name in result if name != ablate_pages.CONSTANT]
    assert len(names) == 2
    for name in names:  # weights that estimate
        assert np.isfinite(result[name]["seeds"][0]["pixel/theta_on"])
        params = load_weights(tmp_path / study / f"{slug(name)}.safetensors")
        seen = ef.estimate(params, jnp.zeros((2, 3, 32)), jnp.zeros((2, 3)))
        assert np.isfinite(seen.theta_on).all()
    assert run(tmp_path / "again") == result  # of the rows kept
