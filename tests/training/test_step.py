"""One step: finite, learning, resumable bit by bit."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers.networks import small_config

from evflow.errors import EvflowDataError
from evflow.scenes import TextureBank, make_bank
from evflow.training import config as configs
from evflow.training import step as training_step
from evflow.training.batch import sample_batch
from evflow.training.checkpoint import Checkpoints
from evflow.training.losses import adaptive_weight
from evflow.training.objective import loss_fn
from evflow.training.step import (
    TrainState,
    init_state,
    make_run_step,
    optimiser,
    step_key,
)

CONFIG = small_config(steps=2, warmup=1)  # that of test_same_bytes.py: compiled once for both
TX = optimiser(CONFIG)
WEIGHTS = configs.LossConfig(inverse_flow=0.5)
PARTS = ("summary", "condition", "change_l1", "parameter", "flow", "event", "inverse_flow",
         "spread")


@pytest.fixture(scope="module")
def bank() -> TextureBank:
    return make_bank(jax.random.key(0), 4, photos=False, size=64, cutout_size=32)


@pytest.fixture(scope="module")
def fresh(bank: TextureBank) -> TrainState:
    """Committed to a device, as what is restored is, so that one program runs both."""
    return jax.device_put(init_state(CONFIG, TX, bank, "default"), jax.devices()[0])


@pytest.fixture(scope="module")
def step():
    return jax.jit(make_run_step(CONFIG, TX))


def leaves(state: TrainState) -> list[np.ndarray]:
    plain = [state.params, state.average, state.opt_state, state.step]
    return [np.asarray(a) for a in jax.tree.leaves(plain)]


@pytest.fixture(scope="module")
def moved(fresh: TrainState) -> TrainState:
    """Away from the start, at which couplings are zero and what lies before them learns nothing."""
    return dataclasses.replace(fresh, params=jax.tree.map(lambda p: p + 0.01, fresh.params))


def test_every_trainable_leaf_gets_a_gradient(
    moved: TrainState, bank: TextureBank, step
) -> None:
    """Adam's momentum after one step is a share of the gradient. Only actnorm's buffers have none.
    """
    state, _ = step(moved, bank)
    momenta = [leaf for _, found in optax.tree.get_all_with_path(state.opt_state, "mu")
               for leaf in jax.tree_util.tree_leaves_with_path(found)]
    assert len(momenta) == len(jax.tree.leaves(moved.params))
    for path, leaf in momenta:
        assert np.isfinite(leaf).all(), path
        is_buffer = path[-1].key == "base"
        assert bool(np.any(leaf != 0)) is not is_buffer, path


def test_every_loss_teaches_with_its_weight(moved: TrainState, bank: TextureBank) -> None:
    """Eq. 11: the total is the sum of all parts, weighted and scaled, and so is its derivative,
    here along one random direction: a fraction of the work of all gradients."""
    batch = jax.jit(sample_batch, static_argnames="config")(jax.random.key(1), bank, CONFIG)
    config = dataclasses.replace(CONFIG, loss=WEIGHTS)
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda p: rng.normal(size=p.shape).astype(np.float32), moved.params)

    @jax.jit
    def program(params: Any, direction: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        def of(params: Any) -> dict[str, Any]:
            metrics = loss_fn(params, batch, jax.random.key(2), config)[1]
            return {k: v for k, v in metrics.items() if k.startswith("loss")}

        return jax.jvp(of, (params,), (direction,))

    values, slopes = program(moved.params, direction)
    assert set(values) == {"loss", *(f"loss/{part}" for part in PARTS)}
    assert all(np.isfinite(slope) and slope != 0 for slope in slopes.values()), slopes
    factors = {f"loss/{part}": getattr(WEIGHTS, part) * float(adaptive_weight(
        values[f"loss/{part}"])) for part in PARTS}
    for found in (values, slopes):
        parts = [factor * float(found[name]) for name, factor in factors.items()]
        assert float(found["loss"]) == pytest.approx(sum(parts), abs=1e-4 * max(map(abs, parts)))


def test_every_step_and_use_has_random_numbers_of_its_own(
    fresh: TrainState, bank: TextureBank, monkeypatch: pytest.MonkeyPatch
) -> None:
    states = [dataclasses.replace(fresh, step=jnp.int32(i)) for i in range(3)]
    keys = [step_key(state, use) for state in states for use in ("losses", "data")]
    assert len({tuple(jax.random.key_data(key).tolist()) for key in keys}) == 6
    drawn: list[Any] = []
    monkeypatch.setattr(training_step, "sample_batch", lambda key, *_: drawn.append(key))
    monkeypatch.setattr(training_step, "make_train_step", lambda *_: lambda state, batch: state)
    for state in states:
        make_run_step(CONFIG, TX)(state, bank)
    for key, expected in zip(drawn, keys[1::2], strict=True):
        np.testing.assert_array_equal(jax.random.key_data(key), jax.random.key_data(expected))


@pytest.mark.slow
def test_the_summary_learns(bank: TextureBank) -> None:
    config = small_config(steps=40, warmup=2)
    tx = optimiser(config)
    state, step, losses = init_state(config, tx, bank, "default"), jax.jit(
        make_run_step(config, tx)), []
    for _ in range(40):
        state, metrics = step(state, bank)
        losses.append(float(metrics["loss/summary"]))
    assert np.mean(losses[-8:]) < 0.8 * np.mean(losses[:4])
    assert all(np.isfinite(leaf).all() for leaf in leaves(state))


def test_resume_is_bit_exact(
    tmp_path: Path, bank: TextureBank, fresh: TrainState, step
) -> None:
    half, _ = step(fresh, bank)
    straight, _ = step(half, bank)
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, half)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest == 1
        resumed, _ = step(checkpoints.restore(fresh), bank)
    for a, b in zip(leaves(resumed), leaves(straight), strict=True):
        np.testing.assert_array_equal(a, b)
    assert jax.random.key_data(resumed.key).tolist() == jax.random.key_data(fresh.key).tolist()


def test_missing_checkpoint_is_named(tmp_path: Path, fresh: TrainState) -> None:
    with (Checkpoints(tmp_path) as checkpoints, pytest.raises(EvflowDataError, match="EV016")):
        checkpoints.restore(fresh)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "literal"])
def test_the_paper_preset_steps(bank: TextureBank, name: str) -> None:
    """64 steps per level set, tanh output, condition from the events: one finite update."""
    known = configs.preset(name)
    paper = dataclasses.replace(
        known, crop=16, scenes=2, cameras=1, block=(8, 8), warmup=1, steps=3, windows=1,
        sequences=min(4, known.sequences), loss=dataclasses.replace(known.loss, patches=(4, 8)))
    tx = optimiser(paper)
    state = init_state(paper, tx, bank, "paper")
    state, metrics = jax.jit(make_run_step(paper, tx))(state, bank)
    assert all(np.isfinite(float(v)) for v in metrics.values())
    assert all(np.isfinite(leaf).all() for leaf in leaves(state))


def test_unknown_preset() -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        configs.preset("best")


@pytest.mark.parametrize("change", [
    {"parts": ("summary", "foo")}, {"parts": ()}, {"steps": 0}, {"cameras": 0}, {"cameras": 5},
    {"sensors": configs.TrainConfig.sensors[:3]}, {"sensors": ()}, {"steps_per_window": 10},
    {"windows": 0}, {"steps_per_window": 0}, {"window_s": (0.0, 0.1)}, {"window_s": (0.1, 0.05)},
    {"ema": float("nan")}, {"ema": 1.0}, {"clip": 0.0}, {"seed": 5_000_000_000}, {"textures": 0},
    {"flow_rate": float("nan")}, {"summary_rate": -1e-3},
    {"block": (4, 16)}, {"block": (8, 80)}, {"sequences": 15}, {"sequences": 300}],
    ids=str)
def test_impossible_configurations_are_refused(change: dict[str, Any]) -> None:
    name, = change
    with pytest.raises(EvflowDataError, match=f"EV020.*TrainConfig: {name}"):
        configs.TrainConfig(**change)


def test_a_network_without_width_is_refused() -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*model\.encoder_hidden 0"):
        configs.TrainConfig(model=dataclasses.replace(configs.ModelConfig(), encoder_hidden=0))
