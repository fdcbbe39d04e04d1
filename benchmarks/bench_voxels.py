"""Events to a voxel grid (Eq. 2): evflow on the host and on the device, against plain NumPy.

One million events, uniform over 346x260 pixels and 50 ms: no locality helps anyone.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Case, Setting, Workload
from evflow.types import Events
from evflow.voxel import voxelize, voxelize_padded

WINDOW_US, BINS = 50_000, 16


def random_events(setting: Setting) -> Events:
    rng = np.random.default_rng(0)
    (width, height), count = ((48, 36), 1000) if setting.quick else ((346, 260), 1_000_000)
    return Events(rng.integers(0, width, count), rng.integers(0, height, count),
                  np.sort(rng.integers(0, WINDOW_US, count)), rng.integers(0, 2, count) > 0,
                  (width, height))


def add_at(events: Events) -> np.ndarray:
    """The textbook form of Eq. 2: two unbuffered additions per event."""
    width, height = events.size
    grid = np.zeros((height, width, 2, BINS), np.float32)
    position = events.t * ((BINS - 1) / WINDOW_US)
    low = np.floor(position).astype(np.int64)
    weight = (position - low).astype(np.float32)
    where = (events.y.astype(np.int64), events.x.astype(np.int64), (~events.p).astype(np.int64))
    np.add.at(grid, (*where, low), 1 - weight)
    np.add.at(grid, (*where, np.minimum(low + 1, BINS - 1)), weight)
    return grid.reshape(height, width, 2 * BINS)


def host(setting: Setting, method: Callable[[Events], np.ndarray]) -> Workload:
    events = random_events(setting)
    return Workload(lambda: method(events), partial(_work, len(events)))


def device(setting: Setting) -> Workload:
    """From arrays that are on the device already, padded to a fixed length (none here)."""
    events = random_events(setting)
    arrays = [jnp.asarray(a) for a in (events.x, events.y, events.t.astype(np.int32), events.p)]
    valid, shape = jnp.ones(len(events), bool), events.size[::-1]
    grid = jax.jit(lambda *a: voxelize_padded(*a, shape=shape, window=float(WINDOW_US), bins=BINS))
    return Workload(lambda: grid(*arrays, valid), partial(_work, len(events)))


def _work(events: int, grid: Any) -> dict[str, float]:
    return {"events": events, "GB": 1e-9 * (13 * events + grid.nbytes)}


CASES = (
    Case("voxels", "1 window", "evflow, voxelize",
         partial(host, method=partial(voxelize, t0_us=0, window_us=WINDOW_US, bins=BINS))),
    Case("voxels", "1 window", "evflow, voxelize_padded (jit)", device),
    Case("voxels", "1 window", "numpy, add.at", partial(host, method=add_at)),
)
