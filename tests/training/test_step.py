"""One step: finite, learning, resumable bit by bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.networks import small_config

from evflow.errors import EvflowDataError
from evflow.scenes import TextureBank, make_bank
from evflow.training import config as configs
from evflow.training.batch import sample_batch
from evflow.training.checkpoint import Checkpoints
from evflow.training.step import TrainState, init_state, loss_fn, make_run_step, optimiser

CONFIG = small_config(steps=40, warmup=2)
TX = optimiser(CONFIG)


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


def test_every_trainable_leaf_gets_a_gradient(bank: TextureBank, fresh: TrainState) -> None:
    """After one step (couplings start at zero) only actnorm's buffers have none."""
    batch = jax.jit(sample_batch, static_argnames="config")(jax.random.key(1), bank, CONFIG)
    params = jax.tree.map(lambda p: p + 0.01, fresh.params)
    grads = jax.jit(jax.grad(lambda p: loss_fn(p, batch, jax.random.key(2), CONFIG)[0]))(params)
    for path, leaf in jax.tree_util.tree_leaves_with_path(grads):
        assert np.isfinite(leaf).all(), path
        is_buffer = path[-1].key == "base"
        assert bool(jnp.any(leaf != 0)) is not is_buffer, path


@pytest.mark.slow
def test_the_summary_learns(bank: TextureBank, fresh: TrainState, step) -> None:
    state, losses = fresh, []
    for _ in range(40):
        state, metrics = step(state, bank)
        losses.append(float(metrics["loss/summary"]))
    assert np.mean(losses[-8:]) < 0.8 * np.mean(losses[:4])
    assert all(np.isfinite(leaf).all() for leaf in leaves(state))


def test_resume_is_bit_exact(
    tmp_path: Path, bank: TextureBank, fresh: TrainState, step
) -> None:
    straight = fresh
    for _ in range(4):
        straight, _ = step(straight, bank)
    half = fresh
    for _ in range(2):
        half, _ = step(half, bank)
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(2, half)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest == 2
        resumed = checkpoints.restore(fresh)
    for _ in range(2):
        resumed, _ = step(resumed, bank)
    for a, b in zip(leaves(resumed), leaves(straight), strict=True):
        np.testing.assert_array_equal(a, b)
    assert jax.random.key_data(resumed.key).tolist() == jax.random.key_data(fresh.key).tolist()


def test_missing_checkpoint_is_named(tmp_path: Path, fresh: TrainState) -> None:
    with (Checkpoints(tmp_path) as checkpoints, pytest.raises(EvflowDataError, match="EV016")):
        checkpoints.restore(fresh)


@pytest.mark.slow
def test_the_paper_preset_steps(bank: TextureBank) -> None:
    """64 steps per level set, tanh output, condition from the events: one finite update."""
    import dataclasses

    paper = dataclasses.replace(
        configs.preset("paper"), crop=16, scenes=2, cameras=1, block=(8, 8), warmup=1, steps=3,
        sensors=configs.preset("paper").sensors)
    tx = optimiser(paper)
    state = init_state(paper, tx, bank, "paper")
    state, metrics = jax.jit(make_run_step(paper, tx))(state, bank)
    assert all(np.isfinite(float(v)) for v in metrics.values())
    assert all(np.isfinite(leaf).all() for leaf in leaves(state))


def test_unknown_preset() -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        configs.preset("best")


@pytest.mark.parametrize("change", [
    {"parts": ("summary", "foo")}, {"parts": ()}, {"steps": -5}, {"cameras": 0}, {"cameras": 5},
    {"sensors": configs.TrainConfig.sensors[:3]}, {"sensors": ()}, {"steps_per_window": 10},
    {"block": (4, 16)}, {"block": (8, 80)}],
    ids=str)
def test_impossible_configurations_are_refused(change: dict[str, Any]) -> None:
    name, = change
    with pytest.raises(EvflowDataError, match=f"EV020.*TrainConfig: {name}"):
        configs.TrainConfig(**change)
