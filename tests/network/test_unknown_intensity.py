"""What the network makes of windows whose intensity is not given."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import evflow as ef
from evflow.light.log_maps import lin_log
from evflow.network.api import estimate_y
from evflow.network.pooling import MIDDLE

pytestmark = pytest.mark.usefixtures("optimised")

WINDOW_S = 0.032
SHAPE = (24, 32)


@pytest.fixture(scope="module")
def scene() -> dict[str, Any]:
    """A moving grating, a camera and its voxels."""
    t, y, x = np.meshgrid(np.arange(33), *map(np.arange, SHAPE), indexing="ij")
    frames = 120.0 + 90.0 * np.sin((x + 0.4 * t) / 3.0) * np.cos(y / 5.0)
    log_frames = lin_log(frames.astype(np.float32))
    prior = ef.CameraPrior(theta=(0.15, 0.4), mismatch=(0.1, 0.1))
    camera = ef.Camera.sample(jax.random.key(4), SHAPE, prior)
    voxels = ef.simulate_voxels(jax.random.key(5), log_frames, camera, frame_dt_s=1e-3)
    return {"log": log_frames, "camera": camera, "voxels": voxels,
            "changes": jnp.moveaxis(jnp.diff(log_frames[::2], axis=0), 0, -1)}


def test_unknown_intensity_is_the_middle_of_those_in_training(scene: dict[str, Any]) -> None:
    """In training the pixels' parts know it: as good as unknown, it must be one that they know."""
    params, camera = ef.load_weights(), scene["camera"]
    dlogI = scene["log"][-1] - scene["log"][0]
    names = "theta_on", "theta_off", "eta_on", "eta_off"
    medians = [jnp.median(getattr(camera, name)) for name in names]
    known = ef.Summary(*medians, jnp.std(camera.theta_on), jnp.std(camera.theta_off))
    given = {"window_s": WINDOW_S, "summary": known}
    without, middle, own = (
        estimate_y(params, scene["voxels"], dlogI, intensity=value, **given)[0]
        for value in (None, MIDDLE, scene["log"].mean(0)))
    np.testing.assert_allclose(without, middle, atol=1e-5)
    missing = jnp.full(SHAPE, jnp.nan)
    np.testing.assert_allclose(
        estimate_y(params, scene["voxels"], dlogI, intensity=missing, **given)[0], without,
        atol=1e-5)
    off = [np.abs(y - ef.unsquash(camera))[..., :2].mean() for y in (without, own)]
    assert off[0] < 1.1 * off[1]


def test_made_events_are_as_many_without_the_intensity(scene: dict[str, Any]) -> None:
    params, counts = ef.load_weights(), []
    for intensity in (None, scene["log"].mean(0)):
        code = ef.code_from_video(
            params, scene["changes"], scene["camera"], window_s=WINDOW_S, intensity=intensity)
        made = ef.generate(params, jax.random.key(3), scene["camera"], code)
        counts.append(made.reshape(-1, 2, 16).sum((0, 2)))
    np.testing.assert_allclose(counts[0], counts[1], rtol=0.1)
    still = ef.code_from_video(
        params, jnp.zeros((*SHAPE, 16)), ef.Camera.constant(SHAPE, 0.2, 0.2, 1.0, 1.0))
    noise = ef.generate(params, jax.random.key(1), ef.Camera.constant(SHAPE, 0.2, 0.2, 1.0, 1.0),
                        still)
    assert noise.reshape(-1, 2, 16).sum(2).mean() == pytest.approx(0.05, rel=0.4)
