"""LGAN's simulator: stretches of a recording, simulated with straight-through gradients of the
event counts by the thresholds.

The forward pass is `evflow.simulator`, exactly. A run is cut into clips, each with its own counts.
The memory at a run's start is unknown, so the fair reading simulates the first clip without
comparing it (where light oscillates, a memory drawn uniformly between the thresholds sends up to
five times the events of one that has settled).
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from evflow.baselines.resimulate import Scene
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.scenes import watch

Array = jax.Array

MODEL = SensorModel()
BINS = 2  # the minimum; their sums are the counts
BLIND_START = 0.2  # log units: range of the initial memory, as published
MOST_CLIPS = 16  # of a long recording, evenly thinned


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Runs:
    """N runs of C clips of T steps. path: (N, C, T + 1, H, W) log frames, the last of a clip equal
    to the first of the next; seen: (N, C, 2, H, W) recorded counts; bright: (N, H, W), 0 where
    frames are black or saturated, else 1; dt_s: (N,) per step; eta: (2,) noise in Hz."""

    path: Array
    seen: Array
    bright: Array
    dt_s: Array
    eta: Array

    @property
    def frames(self) -> Array:
        """The first log frame (N, H, W) of each run."""
        return self.path[:, 0, 0]


def runs_of(scene: Scene, clip: int, apart: bool) -> Runs:
    """The scene's chunks as runs of clips of `clip` frame intervals, evenly thinned to MOST_CLIPS.
    apart: a run for every clip, without noise, as published."""
    parts = []
    for chunk in scene.chunks:
        each = min(clip, len(chunk.dt_s))
        count, steps = len(chunk.dt_s) // each, each * scene.steps
        path = np.stack([chunk.path[i * steps:(i + 1) * steps + 1] for i in range(count)])
        seen = np.asarray(chunk.recorded.counts)[:count * each]
        seen = seen.reshape(count, each, *seen.shape[1:]).sum(1)
        one = (chunk.bright, chunk.dt_s[:count * each].mean() / scene.steps)
        parts += [(path[i:i + 1], seen[i:i + 1], *one) for i in range(count)] if apart else [
            (path, seen, *one)]
    longest = max(part[0].shape for part in parts)
    parts = [part for part in parts if part[0].shape == longest]
    most = max(1, MOST_CLIPS // longest[0])
    if len(parts) > most:
        parts = [parts[round(k)] for k in np.linspace(0, len(parts) - 1, most)]
    paths, counts, bright, dt_s = (
        jnp.asarray(np.stack(a), jnp.float32) for a in zip(*parts, strict=True))
    eta = np.zeros(2) if apart else scene.eta
    return Runs(paths, counts, bright, dt_s, jnp.asarray(eta, jnp.float32))


def lead(runs: Runs) -> int:
    """Number of clips at the start of a run that are simulated, but not compared."""
    return min(1, runs.path.shape[1] - 1)


def compared(runs: Runs, counts: Array) -> Array:
    """The compared clips (M, 2, H, W) of counts (N, C, 2, H, W), 0 where light is unknown."""
    counts = (counts * runs.bright[:, None, None])[:, lead(runs):]
    return counts.reshape(-1, *counts.shape[2:])


def straight_through(counts: Array, theta: Array) -> Array:
    """Unchanged counts or voxels with the gradient -counts / theta: that of floor(d / theta) theta
    / theta with the first two factors held constant. theta: of a shape that broadcasts."""
    held = jax.lax.stop_gradient
    return held(counts) * (1.0 - (jnp.log(theta) - held(jnp.log(theta))))


def simulate_runs(key: Array, runs: Runs, theta: Array, blind: bool) -> Array:
    """Counts (N, C, 2, H, W) of cameras theta (N, 2, H, W), with gradients in theta. blind: the
    memory starts up to .2 below the first frame, else anywhere between the thresholds."""
    def one(key: Array, path: Array, theta: Array, dt_s: Array) -> Array:
        return simulate_run(key, path, theta, runs.eta, dt_s, blind)

    held = jax.lax.stop_gradient(theta)
    counts = jax.vmap(one)(jax.random.split(key, len(held)), runs.path, held, runs.dt_s)
    return straight_through(counts, theta[:, None])


def simulate_run(
    key: Array, path: Array, theta: Array, eta: Array, dt_s: Array, blind: bool | None
) -> Array:
    """Counts (C, 2, H, W) of a run, path (C, T + 1, H, W), by thresholds (2, H, W). blind: None
    starts with the memory at the first frame: one clip is then `simulate_counts`, bit by bit."""
    k_phase, key = (key, key) if blind is None else jax.random.split(key)
    on, off = theta
    camera = Camera(on, off, *(eta[:, None, None] * jnp.ones_like(theta)))
    phase: Array | float = 0.0
    if blind is not None:
        phase = (BLIND_START * jax.random.uniform(k_phase, on.shape) if blind
                 else watch.memory(k_phase, camera))
    frames = jnp.concatenate([path[0], *path[1:, 1:]])
    grids = watch.voxels(key, frames, camera, MODEL, len(path), dt_s, BINS, phase)
    # An event's weights sum to 1, up to rounding.
    counts = jnp.round(grids.reshape(*grids.shape[:-1], 2, BINS).sum(-1))
    return jnp.moveaxis(counts, -1, 1)
