"""LGAN: its simulator is ours with gradients, its critics sort and score, its fits are defined."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow import Recording, simulate
from evflow.baselines import critics, lgan, lgan_simulator
from evflow.baselines.lgan import PUBLISHED, Lgan
from evflow.baselines.lgan_simulator import straight_through
from evflow.camera import THETA_MIN, Camera
from evflow.simulator import simulate_counts, simulate_voxels
from evflow.types import Events

SHAPE = (32, 40)
SMALL = Lgan(iterations=3, hidden=(8,), groups=2, draws=2, critic_steps=2, patch=12,
             classes=(1, 1, 2))


def path_of(steps: int, seed: int = 0) -> np.ndarray:
    """Log frames (steps + 1, H, W): a smooth pattern that moves right, a pixel per step."""
    rng = np.random.default_rng(seed)
    wave = rng.normal(0, 1, (SHAPE[0], SHAPE[1] + steps))
    for _ in range(3):
        wave = sum(np.roll(wave, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
    wave = 4.3 + 0.8 * np.clip(wave / wave.std(), -1.4, 1.4)
    return np.stack([wave[:, steps - i:steps - i + SHAPE[1]] for i in range(steps + 1)]).astype(
        np.float32)


def moving(theta_on: float, theta_off: float) -> Recording:
    video = np.exp(path_of(100))
    times = np.arange(101) * 1000
    camera = Camera.constant(SHAPE, theta_on, theta_off)
    events = simulate(jax.random.key(0), video, times, camera)
    return Recording(events, np.rint(video[::25]).astype(np.uint8), times[::25])


@pytest.fixture(scope="module")
def runs() -> lgan_simulator.Runs:
    path = jnp.asarray(path_of(24))
    clips = jnp.stack([path[i * 8:i * 8 + 9] for i in range(3)])[None]
    seen = jnp.zeros((1, 3, 2, *SHAPE))
    return lgan_simulator.Runs(
        clips, seen, jnp.ones((1, *SHAPE)), jnp.full(1, 1e-3), jnp.zeros(2))


@pytest.mark.parametrize("eta", [0.0, 20.0])
def test_forward_pass_is_the_simulator(eta: float) -> None:
    """Counts and voxels, event for event, noise included; the gradient is -counts / theta."""
    path, key = jnp.asarray(path_of(8)), jax.random.key(3)
    theta = jax.random.uniform(key, (2, *SHAPE), minval=0.05, maxval=0.4)
    camera = Camera(*theta, *jnp.full((2, *SHAPE), eta))
    counts = jnp.moveaxis(simulate_counts(key, path, camera, frame_dt_s=1e-3), -1, 0)
    made = lgan_simulator.simulate_run(
        key, path[None], theta, jnp.full(2, eta), jnp.float32(1e-3), None)[0]
    np.testing.assert_array_equal(made, counts)
    assert float(counts.sum()) > 1000
    voxels = jnp.moveaxis(simulate_voxels(key, path, camera, frame_dt_s=1e-3, bins=4), -1, 0)
    spread = jnp.repeat(theta, 4, 0)
    for exact, at in ((counts, theta), (voxels, spread)):
        through = straight_through(exact, at)
        np.testing.assert_array_equal(through, exact)
        slope = jax.grad(lambda t, n=exact: straight_through(n, t).sum())(at)
        np.testing.assert_allclose(slope, -exact / at, rtol=1e-5)


def test_clips_go_on_where_the_one_before_ended(runs: lgan_simulator.Runs) -> None:
    """The counts of a run's clips add up to those of the run as one clip."""
    key, theta = jax.random.key(1), jnp.full((1, 2, *SHAPE), 0.15)
    clips = lgan_simulator.simulate_runs(key, runs, theta, blind=False)
    path = jnp.concatenate([runs.path[:, 0], runs.path[:, 1, 1:], runs.path[:, 2, 1:]], 1)
    whole = dataclasses.replace(runs, path=path[:, None])
    once = lgan_simulator.simulate_runs(key, whole, theta, blind=False)
    np.testing.assert_array_equal(clips.sum(1), once[:, 0])
    assert (np.asarray(clips).sum((0, 2, 3, 4)) > 100).all()
    assert lgan_simulator.compared(runs, clips).shape == (2, 2, *SHAPE)


def test_gradient_descent_through_the_simulator_finds_the_threshold(
    runs: lgan_simulator.Runs,
) -> None:
    """The mean count as a loss: from .3 to the .12 and .2 that made the events."""
    true = jnp.array([0.12, 0.2])[None, :, None, None] * jnp.ones((1, 2, *SHAPE))
    seen = lgan_simulator.simulate_runs(jax.random.key(5), runs, true, False).sum((0, 1, 3, 4))

    @jax.jit
    def slope(key: jax.Array, log_theta: jax.Array) -> jax.Array:
        def loss(log_theta: jax.Array) -> jax.Array:
            theta = jnp.exp(log_theta)[None, :, None, None] * jnp.ones((1, 2, *SHAPE))
            made = lgan_simulator.simulate_runs(key, runs, theta, False).sum((0, 1, 3, 4))
            return (jnp.log(made / seen) ** 2).sum()

        return jax.grad(loss)(log_theta)

    log_theta = jnp.log(jnp.full(2, 0.3))
    for i in range(20):
        log_theta = log_theta - 0.25 * slope(jax.random.key(i), log_theta)
    np.testing.assert_allclose(np.exp(log_theta), [0.12, 0.2], rtol=0.07)


def test_patches_are_sorted_by_the_direction_of_their_gradient() -> None:
    x = np.linspace(0, 3, 32)
    across, down = np.broadcast_to(x, (32, 32)), np.broadcast_to(x[:, None], (32, 32))
    frames = np.stack([across, down])
    usable = np.ones((2, 21, 21), bool)
    found = critics.sort_patches(frames, usable, 12, 4, (4, 1, 1))
    assert found is not None
    used = np.asarray(found.share) > 0
    assert used.sum() == 2
    for places in np.asarray(found.places)[used]:
        assert len(np.unique(places[:, 0])) == 1  # one class for each frame
    np.testing.assert_allclose(np.asarray(found.share)[used], 0.5)
    assert critics.sort_patches(frames, ~usable, 12, 4, (4, 1, 1)) is None


def test_window_sums_and_cut_agree() -> None:
    image = np.random.default_rng(0).uniform(size=(2, 9, 11)).astype(np.float32)
    places = np.array([[0, 0, 0], [1, 4, 6], [1, 2, 3]])
    parts = critics.cut(jnp.asarray(image)[..., None], jnp.asarray(places), 5)
    sums = critics.window_sums(image, 5)
    np.testing.assert_allclose(parts.sum((1, 2, 3)), [sums[tuple(p)] for p in places], rtol=1e-5)


def test_a_fit_is_defined_and_repeats() -> None:
    """Three iterations: no answer yet, but a finite one, the same for the same seed."""
    recording = moving(0.2, 0.2)
    first, again = (SMALL.fit(recording) for _ in range(2))
    np.testing.assert_array_equal(first.camera.theta_on, again.camera.theta_on)
    assert first.notes[0] == "3 iterations"
    assert np.isfinite(np.asarray(first.camera.theta_on)).all()
    assert (first.theta < 0.3 * 1.25).all()
    assert (first.theta > 0.3 / 1.25).all()
    assert isinstance(Lgan.most_recordings, int)


def test_divergence_is_not_valid_and_not_nan(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*args: object) -> lgan.LganState:
        state = fresh(*args)
        generator = jax.tree.map(lambda a: a * jnp.nan, state.generator)
        return dataclasses.replace(state, generator=generator)

    fresh = lgan.start
    monkeypatch.setattr(lgan, "start", broken)
    found = SMALL.fit(moving(0.2, 0.2))
    assert not found.valid.any()
    assert found.notes == ("diverged after 1 iterations",)
    assert np.isfinite(found.theta).all()
    assert (np.asarray(found.camera.theta_off) >= THETA_MIN).all()


def test_the_clock_stops_a_fit() -> None:
    found = dataclasses.replace(SMALL, seconds=0.0).fit(moving(0.2, 0.2))
    assert found.notes[0] == "1 iterations"
    assert "stopped by the clock" in found.notes


@pytest.mark.slow
def test_published_thresholds_are_the_same_for_both_polarities() -> None:
    system = dataclasses.replace(
        PUBLISHED, iterations=2, hidden=(8,), groups=2, draws=2, critic_steps=1, patch=12)
    found = system.fit(moving(0.15, 0.3))
    np.testing.assert_array_equal(found.camera.theta_on, found.camera.theta_off)


@pytest.mark.parametrize("system", [Lgan(), PUBLISHED])
def test_what_tells_nothing_is_not_valid(system: Lgan) -> None:
    none = np.zeros(0, np.int64)
    events = Events(none, none, none, none, SHAPE[::-1])
    for frames in (np.full((4, *SHAPE), 100, np.uint8), np.zeros((0, *SHAPE), np.uint8)):
        found = system.fit(Recording(events, frames, 25_000 * np.arange(len(frames))))
        assert not found.valid.any()
        np.testing.assert_allclose(found.theta, 0.3)


def test_a_generator_says_the_mean_that_it_starts_from(runs: lgan_simulator.Runs) -> None:
    patches = lgan.patches_of(runs, SMALL)
    assert patches is not None
    state = lgan.start(jax.random.key(0), runs, patches, SMALL.program)
    mean, spread = lgan.thresholds(state.generator, runs, SMALL.program)
    assert mean.shape == spread.shape == (1, 2, *SHAPE)
    assert float(jnp.abs(jnp.log(mean / 0.3)).max()) <= lgan.DEPARTURE
    assert float(spread.std()) > 0
