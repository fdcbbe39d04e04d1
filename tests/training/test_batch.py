"""Training data: the true values given to the network are those that happened."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.networks import small_config

from evflow.camera import CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.scenes import TextureBank, make_bank
from evflow.training import batch as batches
from evflow.training.batch import Batch
from evflow.training.batch import sample_batch as sample_batch_eagerly
from evflow.training.config import PRESETS, NuisanceConfig

sample_batch = jax.jit(sample_batch_eagerly, static_argnames="config")
CONFIG = small_config()  # its program is that of test_step.py


@pytest.fixture(scope="module")
def bank() -> TextureBank:
    return make_bank(jax.random.key(0), 4, photos=False, size=64, cutout_size=32)


@pytest.fixture(scope="module")
def batch(bank: TextureBank) -> Batch:
    return sample_batch(jax.random.key(5), bank, config=CONFIG)  # both scenes move


def test_fixed_sequences_are_the_same_in_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene depends on its key and number alone: these repeat, and each step takes some."""
    monkeypatch.setattr(batches, "_sample_scenes", lambda key, bank, numbers, _: (key, numbers))
    config = small_config(sequences=12)
    drawn = [batches.sample_batch(jax.random.key(i), None, config) for i in range(20)]
    assert len({tuple(jax.random.key_data(key).tolist()) for key, _ in drawn}) == 1
    taken = [tuple(numbers.tolist()) for _, numbers in drawn]
    assert all(len(set(numbers)) == config.scenes for numbers in taken)
    assert {n for numbers in taken for n in numbers} == set(range(6))  # of two cameras each
    other = batches.sample_batch(jax.random.key(0), None, small_config(sequences=12, seed=1))
    assert jax.random.key_data(other[0]).tolist() != jax.random.key_data(drawn[0][0]).tolist()
    new = [batches.sample_batch(jax.random.key(i), None, small_config()) for i in range(2)]
    assert [numbers.tolist() for _, numbers in new] == [[0, 1]] * 2
    assert jax.random.key_data(new[0][0]).tolist() != jax.random.key_data(new[1][0]).tolist()


def test_shapes(batch: Batch) -> None:
    assert batch.voxels.shape == (4, 2, 16, 16, 32)
    assert batch.dlogI.shape == batch.intensity.shape == (4, 2, 16, 16)
    assert batch.changes.shape == (4, 2, 16, 16, 16)
    assert batch.camera.shape == (4, 16, 16)
    assert batch.window_s.shape == batch.nominal.theta_on.shape == (4,)


def test_events_carry_the_change(bank: TextureBank) -> None:
    """Noise-free, theta x events over all windows tracks the true change within two thresholds:
    the phase at the start and the remainder at the end."""
    config = small_config(prior=CameraPrior(noise="none"), sensors=(SensorModel(),) * 2)
    batch = sample_batch(jax.random.key(2), bank, config=config)
    on, off = jnp.split(batch.voxels, 2, -1)
    camera = batch.camera
    carried = on.sum((1, -1)) * camera.theta_on - off.sum((1, -1)) * camera.theta_off
    true = batch.changes.sum((1, -1))
    assert float(jnp.abs(carried).max()) > 0.3
    limit = camera.theta_on + camera.theta_off + 1e-3
    assert bool((jnp.abs(carried - true) <= limit).all())


def test_frames_see_the_same_change_up_to_their_noise(batch: Batch) -> None:
    # Half a DN of noise and rounding is .03 in the linear part of the log map, per frame.
    error = batch.dlogI - batch.changes.sum(-1)
    assert float(jnp.abs(error).mean()) < 0.05
    assert float(jnp.abs(error).max()) > 1e-4


def test_cameras_share_scenes_not_parameters(batch: Batch) -> None:
    assert all(float(jnp.abs(changes).max()) > 1.0 for changes in batch.changes)
    np.testing.assert_array_equal(batch.changes[0], batch.changes[1])
    # Not the minimum: thresholds are clamped at .01, where any two cameras may meet.
    assert float(jnp.median(jnp.abs(batch.camera.theta_on[0] - batch.camera.theta_on[1]))) > 0


def test_key_decides_everything(bank: TextureBank) -> None:
    one, same, other = (sample_batch(jax.random.key(k), bank, config=CONFIG) for k in (3, 3, 4))
    jax.tree.map(np.testing.assert_array_equal, one, same)
    assert not np.array_equal(one.voxels, other.voxels)


def test_noise_target_is_the_rate_that_was_simulated(bank: TextureBank) -> None:
    """With Eq. 12's intensity dependence the target is the mean rate over the sequence."""
    prior = CameraPrior(theta=(5.0, 5.0), mismatch=(0.0, 0.0), noise="independent",
                        eta=(40.0, 40.0))
    config = dataclasses.replace(
        small_config(prior=prior, sensors=(SensorModel(eta_intensity=True),) * 2), crop=48,
        windows=4, window_s=(0.1, 0.1))
    batch = sample_batch(jax.random.key(5), bank, config=config)
    rate = batch.voxels.sum((1, 2, 3, 4)) / (4 * 0.1 * 48 * 48)
    expected = batch.nominal.eta_on + batch.nominal.eta_off
    np.testing.assert_allclose(rate, expected, rtol=0.03)


@pytest.mark.slow
def test_nuisances_touch_what_they_say(bank: TextureBank) -> None:
    """Every sensor model and nuisance of the default preset: finite data, frames that differ from
    the true changes (without noise, as it would hide that), some hot pixels, fresh cameras."""
    default = PRESETS["default"]
    silent = dataclasses.replace(NuisanceConfig.none(), frame_noise_dn=0.0)
    plain = small_config(sensors=default.sensors, nuisances=silent)
    nuisances = dataclasses.replace(
        default.nuisances, hot_pixels=0.2, fresh=1.0, frame_noise_dn=0.0)
    config = dataclasses.replace(plain, nuisances=nuisances)
    batches = [[sample_batch(jax.random.key(k), bank, config=c) for k in range(4)]
               for c in (plain, config)]
    assert all(bool(jnp.isfinite(leaf).all()) for b in batches[1] for leaf in jax.tree.leaves(b))

    def error(group: list[Batch]) -> float:
        return float(np.mean([jnp.abs(b.dlogI - b.changes.sum(-1)).mean() for b in group]))

    assert error(batches[1]) > 1.2 * error(batches[0])
    hottest = [max(float(b.camera.eta_on.max()) for b in group) for group in batches]
    assert hottest[0] < 5 < hottest[1]
