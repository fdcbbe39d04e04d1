"""A camera that runs before its video begins: what its pixels remember then is unknown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import jax
import numpy as np

from evflow.camera import Camera

Array = np.ndarray
Picture = tuple[Array, int]  # (H, W) in DN, time in us


def running(
    key: jax.Array, pictures: Iterable[Picture], camera: Camera, added_dn: float = 0.0
) -> Iterator[Picture]:
    """A video whose first frame is such that the pixels' memories start anywhere between their
    thresholds. added_dn: what a pixel adds to light before its logarithm."""
    share = np.asarray(jax.random.uniform(key, camera.shape))
    both = np.asarray(camera.theta_on) + np.asarray(camera.theta_off)
    memory = np.exp(np.asarray(camera.theta_off) - share * both)
    for number, (frame, t_us) in enumerate(pictures):
        if not number:
            frame = np.clip((frame + added_dn) * memory - added_dn, 0.0, 255.0)
        yield np.asarray(frame, np.float32), t_us
