"""Pixels that keep what changes in their dead time, as v2e's, and send it later, or never.

An event that waited says nothing of where the light was; and ON and OFF of one dead time cancel.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.estimation.refine.fine_steps import evenly, seconds_at
from evflow.estimation.refine.lost_contrast import LEAST, NEGLIGIBLE, Lost
from evflow.estimation.refine.receptor_data import Sample, one_stretch
from evflow.estimation.refine.receptor_noise import path_of
from evflow.estimation.refine.receptor_result import Found
from evflow.simulator.counts import simulate_counts

Array = np.ndarray

WAITED, HARDLY = 1.05, 1e-4  # of the dead time; of a weight
DARKEST = -6.9  # log units below the brightest, that a simulation of the log map log_eps takes
ENOUGH = 100  # events of a polarity, that such a simulation must send
SOLVED = 6  # steps towards the thresholds of as many events


def kept_contrast(data: Sample, found: Found, dead_s: float) -> Lost | None:
    """How many events fewer pixels send that keep the contrast of their dead time: ON and OFF of it
    may cancel, and what is owed at last is never sent. None if that is negligible, or unknown: too
    few events, or thresholds that are none."""
    if not np.min(found.theta) > LEAST:
        return None
    excess = np.ones(2)
    dead, free = (SensorModel(log_map="log_eps", refractory_s=s) for s in (dead_s, 0.0))
    paths = []
    for c in range(len(data.dn)):
        d = one_stretch(data, c)
        path = path_of(d, found.used)
        even = evenly(np.maximum(path - path.max(), DARKEST), d.dt_s)
        paths.append((even, float(np.mean(d.dt_s))))
    sent = _counted(paths, found.theta, dead)
    if sent.min() < ENOUGH:
        return None
    for _ in range(SOLVED):
        more = _counted(paths, found.theta * excess, free) / sent
        excess = np.maximum(excess * more**0.7, 1.0)
    if np.abs(np.log(excess)).max() < NEGLIGIBLE:
        return None
    return Lost("keeps", dead_s, excess, found.theta, found.unexplained)


def _counted(paths: list[tuple[Array, float]], theta: Array, model: SensorModel) -> Array:
    """(2,) ON and OFF events of pixels with these thresholds, along paths (T, N), and their
    steps in seconds."""
    total, unused = np.zeros(2), jax.random.key(0)  # there is no noise
    for path, dt_s in paths:
        camera = Camera.constant((path.shape[1], 1), *map(float, theta))
        counts = simulate_counts(unused, path[:, :, None].astype(np.float32), camera,
                                 frame_dt_s=dt_s, model=model)
        total += np.asarray(counts).sum((0, 1))
    return total


def without_waiting(data: Sample, dead_s: float) -> Sample:
    """The sample with hardly any weight of events as soon after the pixel's last as its dead time
    allows: v2e's pixel sends them late, when its light has gone on. They still count as sent."""
    weight = np.array(data.weight)
    for c, dt_s in enumerate(np.asarray(data.dt_s)):
        used = np.flatnonzero(weight[c] > 0)
        pixel, at = (np.asarray(v)[c, used] for v in (data.pixel, data.at))
        after = np.diff(seconds_at(at, dt_s), prepend=-np.inf)
        waited = (np.diff(pixel, prepend=-1) == 0) & (after < WAITED * dead_s)
        weight[c, used[waited]] *= HARDLY
    return data._replace(weight=jnp.asarray(weight))
