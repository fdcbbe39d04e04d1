"""The events that the event loss expects, which set its variance."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.camera import Camera
from evflow.errors import EvflowDataError
from evflow.network.config import MODELS
from evflow.network.coordinates import unsquash
from evflow.network.pooling import window_features
from evflow.training.objective import Block, _expected
from evflow.training.run import configuration


@pytest.mark.parametrize("network", ["default", "paper"])
def test_expected_events_are_changes_over_thresholds_and_noise(network: str) -> None:
    """In either network's coordinates."""
    shape, output = (2, 3, 4), MODELS[network].output
    keys = jax.random.split(jax.random.key(0), 3)
    camera = Camera(*(jax.random.uniform(keys[0], shape, minval=0.1, maxval=0.5) * scale
                      for scale in (1.0, 1.1, 0.9, 0.8)))
    changes = 0.3 * jax.random.normal(keys[1], (*shape, 16))
    context = window_features(jnp.full(shape, 0.05), jnp.full(shape, 4.0), shape)
    block = Block(voxels=jnp.zeros((*shape, 32)), dlogI=changes.sum(-1), changes=changes,
                  context=context, y=unsquash(camera, output))
    bin_s = 0.05 / 16
    by_hand = np.concatenate([
        np.maximum(sign * changes, 0.0) / np.asarray(theta)[..., None]
        + np.asarray(eta)[..., None] * bin_s
        for sign, theta, eta in ((1.0, camera.theta_on, camera.eta_on),
                                 (-1.0, camera.theta_off, camera.eta_off))], -1)
    np.testing.assert_allclose(_expected(block, output), by_hand, rtol=2e-5, atol=1e-7)


def test_one_scene_a_step_cannot_train_on_true_and_predicted_changes() -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*scenes=1.*2 or more"):
        configuration(SimpleNamespace(preset="debug", scenes=1), 1)  # type: ignore[arg-type]
    alone = SimpleNamespace(preset="debug", scenes=1, parts=("summary",))
    assert configuration(alone, 1).scenes == 1  # type: ignore[arg-type]
