"""S2R: the contrast threshold at which simulated sequences have the recorded event rate.

Stoffregen, Scheerlinck et al., "Reducing the Sim-to-Real Gap for Event Cameras" (ECCV 2020): the
events per pixel and second of a recording are compared with those of simulated sequences at a grid
of contrast thresholds. The content of the sequences is assumed to average out: of a generic set of
scenes ("generic"), or of the recording itself ("same", the stronger reading). One threshold for
both polarities, as published, or one for each.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from evflow.baselines.base import Solution, System, constant
from evflow.baselines.match import PIXELS, camera_rows
from evflow.baselines.resimulate import scene_of
from evflow.camera import THETA_MIN, Camera
from evflow.errors import EvflowDataError
from evflow.light.log_maps import lin_log
from evflow.recordings import plan_windows
from evflow.scenes import make_bank, render, watch
from evflow.scenes.config import SceneConfig
from evflow.simulator import simulate_counts
from evflow.types import Recording

GRID = np.arange(0.05, 1.501, 0.05)  # log units, as published up to 1.5
SPREAD = 0.1  # of the other polarity's threshold, relative, from scene to scene
SHAPE, FRAMES, FRAME_S = (64, 64), 200, 1e-3  # of a generic scene


@dataclasses.dataclass(frozen=True)
class S2r(System):
    """scenes: "generic" or "same". per_polarity: separate thresholds for ON and OFF. count: of
    generic scenes; their table is computed once per process."""

    scenes: Literal["generic", "same"] = "generic"
    per_polarity: bool = False
    count: int = 16
    seed: int = 0

    def solve(self, recording: Recording) -> Solution:
        width, height = recording.events.size
        if self.scenes == "same":
            scene = scene_of(recording, "flow", quiet=False)
            rows = camera_rows(scene, np.stack([GRID] * 2, 1), 0.0)
            made = scene.simulate(jax.random.key(self.seed), rows, 1.0)[:, 0]  # starts afresh
            pixels = np.maximum(scene.seen[PIXELS], 1)  # none, where all frames are black
            seen, made = scene.seen[0] / pixels, made / pixels
        else:
            made, seen = generic_rates(self.count, self.seed), event_rate(recording)
        if not self.per_polarity:
            seen, made = np.full(2, seen.sum()), np.stack([made.sum(1)] * 2, 1)
        theta, inside = zip(*(invert(seen[i], made[:, i]) for i in range(2)), strict=True)
        notes = () if all(inside) else ("the rate lies outside the grid of thresholds",)
        return constant((height, width), np.array(theta), np.array(inside), *notes)


def event_rate(recording: Recording) -> np.ndarray:
    """Events per pixel and second, ON and OFF (2,), between the first and last usable frame, or of
    all events without frames. Raises EV001 without events."""
    events = recording.events
    if len(events) == 0:
        raise EvflowDataError("EV001", "the recording has no events.")
    begin, end = int(events.t[0]), int(events.t[-1]) + 1
    if len(recording.frame_times) >= 2:
        pairs = plan_windows(recording, 1).pairs
        if pairs:
            begin, end = (int(recording.frame_times[i]) for i in (pairs[0][0], pairs[-1][1]))
    counts = events.slice(begin, end).count_map()
    return counts.mean((1, 2)) / ((end - begin) * 1e-6)


def invert(rate: float, rates: np.ndarray) -> tuple[float, bool]:
    """The threshold of a rate by log-log interpolation of a table over GRID, clipped to the grid,
    and whether it lies inside."""
    if not rate > 0:
        return float(GRID[-1]), False
    falling = np.log(np.maximum(np.minimum.accumulate(rates), 1e-9))[::-1]
    theta = np.exp(np.interp(np.log(rate), falling, np.log(GRID)[::-1]))
    return float(theta), bool(falling[0] <= np.log(rate) <= falling[-1])


@functools.lru_cache(maxsize=4)
def generic_rates(count: int, seed: int) -> np.ndarray:
    """Events per pixel and second (len(GRID), 2) over generic scenes of textures and photographs in
    slow to fast motion. The polarity with the varied threshold alternates between scenes."""
    k_bank, k_scene, k_theta = jax.random.split(jax.random.key(seed), 3)
    bank = make_bank(k_bank, 48)
    times = (jnp.arange(FRAMES + 1) - FRAMES / 2) * FRAME_S
    total = np.zeros((len(GRID), 2))
    for i in range(count):
        scene = watch.draw_scene(jax.random.fold_in(k_scene, i), bank, SceneConfig(), SHAPE)
        frames = lin_log(render(scene, times, SHAPE))
        factor = 1.0 + SPREAD * float(jax.random.normal(jax.random.fold_in(k_theta, i)))
        pair = (1.0, factor) if i % 2 == 0 else (factor, 1.0)
        total += np.asarray(_counts(frames, jnp.asarray(GRID, jnp.float32), jnp.array(pair)))
    pixels = SHAPE[0] * SHAPE[1]
    rates = total / (count * pixels * FRAMES * FRAME_S)
    rates.flags.writeable = False
    return rates


@jax.jit
def _counts(frames: jax.Array, grid: jax.Array, pair: jax.Array) -> jax.Array:
    """Events (len(grid), 2) of a noise-free sensor at each threshold."""
    def one(theta: jax.Array) -> jax.Array:
        on, off = (jnp.full(SHAPE, 1.0) * jnp.maximum(theta * f, THETA_MIN) for f in pair)
        camera = Camera(on, off, jnp.zeros(SHAPE), jnp.zeros(SHAPE))
        counts = simulate_counts(jax.random.key(0), frames, camera, frame_dt_s=FRAME_S)
        return counts.sum((0, 1))

    return jax.lax.map(one, grid)
