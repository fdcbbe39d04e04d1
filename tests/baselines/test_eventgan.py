"""EventGAN: shapes, losses on known cases, one step that learns, repeats, and goes on."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.baselines import eventgan, eventgan_losses
from evflow.baselines.eventgan import GANS, GanState, generate
from evflow.baselines.eventgan_losses import Pair
from evflow.camera import Camera
from evflow.errors import EvflowDataError
from evflow.light.log_maps import lin_log
from evflow.training.batch import Batch
from evflow.training.checkpoint import Checkpoints

CONFIG = GANS["debug"]
SIDE, BINS = CONFIG.data.crop, CONFIG.bins


@pytest.fixture(scope="module")
def fresh() -> GanState:
    return eventgan.init_state(CONFIG)


@pytest.fixture(scope="module")
def pair() -> Pair:
    """Four windows of an edge that moves; every pixel that it crosses has two events."""
    rng, x = np.random.default_rng(0), np.arange(SIDE)
    frames = np.zeros((4, SIDE, SIDE, 2), np.float32)
    voxels = np.zeros((4, SIDE, SIDE, 2 * BINS), np.float32)
    for i, at in enumerate(rng.integers(2, SIDE - 6, 4)):
        before, after = (np.broadcast_to(x < a, (SIDE, SIDE)) for a in (at, at + 3))
        frames[i] = np.stack([before, after], -1) - 0.5
        voxels[i, :, at:at + 3, 5] = 2.0
    return Pair(jnp.asarray(frames), jnp.asarray(voxels))


@pytest.mark.parametrize("shape", [(16, 16), (2, 19, 23)])
def test_generated_voxels_are_counts_of_any_size(fresh: GanState, shape: tuple[int, ...]) -> None:
    key = jax.random.key(0)
    one, two = (255.0 * jax.random.uniform(k, shape) for k in jax.random.split(key))
    voxels = generate(fresh.params["generator"], one, two)
    assert voxels.shape == (*shape, 2 * BINS)
    assert voxels.dtype == jnp.float32
    assert float(voxels.min()) == 0.0
    assert float(voxels.max()) > 0.0


def test_frames_that_differ_in_shape_are_refused(fresh: GanState) -> None:
    with pytest.raises(EvflowDataError, match="EV002"):
        generate(fresh.params["generator"], jnp.zeros((8, 8)), jnp.zeros((8, 9)))


def test_pairs_hold_the_frames_that_made_the_change() -> None:
    dn = jnp.array([[[[20.0, 80.0]], [[60.0, 40.0]]]])  # one sequence, two frames of one row
    log = lin_log(dn)
    maps = [jnp.ones((1, 1, 2))] * 4
    batch = Batch(
        jnp.ones((1, 1, 1, 2, 4)), log[:, 1:] - log[:, :-1], jnp.zeros((1, 1, 1, 2, 16)),
        0.5 * (log[:, 1:] + log[:, :-1]), jnp.ones(1), Camera(*maps), None)  # type: ignore
    made = eventgan.make_pairs(batch)
    np.testing.assert_allclose(127.5 * (made.frames[0, 0] + 1.0), [[20, 60], [80, 40]], rtol=1e-5)
    assert made.voxels.shape == (1, 1, 2, 4)


def test_true_flow_costs_less_than_none() -> None:
    """A smooth image that moves by (2, 1) px: the second frame is the first, moved back."""
    rng = np.random.default_rng(1)
    wide = rng.normal(size=(40, 40))
    for _ in range(3):
        wide = sum(np.roll(wide, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
    frames = np.stack([wide[:32, :32], wide[1:33, 2:34]], -1)[None] / np.abs(wide).max()
    pair = Pair(jnp.asarray(frames, jnp.float32), jnp.ones((1, 32, 32, 2)))

    def cost(x: float, y: float) -> float:
        logit = np.arctanh(np.array([x, y]) / (eventgan_losses.REACH * 32))
        flow = jnp.broadcast_to(jnp.asarray(logit, jnp.float32), (1, 32, 32, 2))
        return float(eventgan_losses.flow_loss([flow], pair))

    assert cost(2.0, 1.0) < 0.1 * cost(0.0, 0.0)
    assert cost(2.0, 1.0) < cost(2.0, -1.0)


def test_flow_that_varies_is_not_held_back_by_its_smoothness() -> None:
    """Half of the image moves: smoothness is of flow in sides of the frame, as published. In
    pixels it outweighed the frames, and the flow network gave one vector for all."""
    rng = np.random.default_rng(1)
    wide = rng.normal(size=(60, 60))
    for _ in range(3):
        wide = sum(np.roll(wide, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
    wide /= 2 * np.abs(wide).max()
    left = np.arange(48) < 24
    frames = np.stack([wide[:48, :48], np.where(left, wide[:48, 3:51], wide[:48, :48])], -1)
    pair = Pair(jnp.asarray(frames[None], jnp.float32), jnp.ones((1, 48, 48, 2)))

    def cost(one: float, other: float) -> float:
        x = np.broadcast_to(np.where(left, one, other), (1, 48, 48))
        logit = np.arctanh(np.stack([x, 0 * x], -1) / (eventgan_losses.REACH * 48))
        return float(eventgan_losses.flow_loss([jnp.asarray(logit, jnp.float32)], pair))

    assert cost(3.0, 0.0) < 0.5 * min(cost(0.0, 0.0), cost(1.5, 1.5), cost(3.0, 3.0))


def test_the_second_frame_itself_is_the_best_reconstruction(pair: Pair) -> None:
    exact = jnp.arctanh(pair.frames[..., 1:])
    best = float(eventgan_losses.reconstruction_loss([exact], pair))
    assert best == pytest.approx(-1.0, abs=1e-3)
    assert float(eventgan_losses.reconstruction_loss([0.5 * exact], pair)) > best + 0.01


def test_hinge_loss_of_a_critic_that_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    class Known(nn.Module):
        @nn.compact
        def __call__(self, x: jax.Array) -> jax.Array:
            return x[..., 0]

    real, fake = jnp.full((2, 4, 4, 1), 2.0), jnp.full((2, 4, 4, 1), -1.5)
    monkeypatch.setattr(eventgan_losses, "FLIPPED", 0.0)
    args = {}, Known(), jax.random.key(0)
    assert float(eventgan_losses.critic_loss(*args, fake, real)) == 0.0
    assert float(eventgan_losses.critic_loss(*args, real, fake)) == pytest.approx(5.5)


def test_one_draw_initialises_as_flax_does(fresh: GanState) -> None:
    """Names, shapes, ones, zeros; kernels have He's variance, 2 / fan-in."""
    network = eventgan.networks(CONFIG)["generator"]
    shapes = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, SIDE, SIDE, 2)))
    params = fresh.params["generator"]
    assert jax.tree.map(jnp.shape, params) == jax.tree.map(lambda s: s.shape, shapes["params"])
    kernel = params["block_0_a"]["conv"]["kernel"]
    assert float(kernel.var()) == pytest.approx(2 / np.prod(kernel.shape[:-1]), rel=0.15)
    np.testing.assert_array_equal(params["block_0_a"]["norm"]["scale"], 1.0)
    np.testing.assert_array_equal(params["head"]["bias"], 0.0)


@pytest.mark.slow
def test_training_on_one_batch_lowers_the_losses(fresh: GanState, pair: Pair) -> None:
    """30 steps on a fixed batch: all losses finite, the cycle networks learn what true events
    tell, and the events made approach the true ones; the same again is the same."""
    config = dataclasses.replace(CONFIG, paired=20.0)

    def trained(state: GanState) -> tuple[GanState, list[dict[str, float]]]:
        found = []
        for _ in range(30):
            state, metrics = eventgan.train_step(state, pair, config)
            found.append({k: float(v) for k, v in metrics.items()})
        return state, found

    state, found = trained(fresh)
    assert all(np.isfinite(v) for row in found for v in row.values())
    for name in ("true_reconstruction", "true_flow", "paired"):
        first, last = (np.mean([row[name] for row in part]) for part in (found[:5], found[-5:]))
        assert last < first, name
    assert found[-1]["paired"] < 0.7 * found[0]["paired"]
    again, _ = trained(fresh)
    jax.tree.map(np.testing.assert_array_equal, state.params, again.params)
    assert int(state.step) == 30


def test_checkpoints_bring_a_state_back(fresh: GanState, tmp_path: Path) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(0, fresh)
    with Checkpoints(tmp_path) as checkpoints:
        back = checkpoints.restore(fresh)
    jax.tree.map(np.testing.assert_array_equal, (back.params, back.opt_state),
                 (fresh.params, fresh.opt_state))
    assert jnp.array_equal(jax.random.key_data(back.key), jax.random.key_data(fresh.key))


@pytest.mark.slow
def test_the_command_trains_resumes_and_measures(tmp_path: Path) -> None:
    from evflow.network.weights import load_weights
    from experiments import train_eventgan as command

    straight, halves = tmp_path / "straight", tmp_path / "halves"
    command.main(command.Options(out=straight, preset="debug", scenes=1))
    for resume in ("never", "must"):
        result = command.main(command.Options(
            out=halves, preset="debug", scenes=1, resume=resume,
            max_seconds=0.0 if resume == "never" else 1e9))
    assert result["steps"] == CONFIG.steps
    a, b = (load_weights(p / "generator.safetensors") for p in (straight, halves))
    jax.tree.map(np.testing.assert_array_equal, a, b)
    assert np.isfinite([v for v in result.values()]).all()
    assert len((halves / "metrics.jsonl").read_text().splitlines()) == CONFIG.steps
    assert cv2.imread(str(halves / "eventgan.png")) is not None
