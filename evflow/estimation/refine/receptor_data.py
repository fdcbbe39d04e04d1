"""Data of the search for a photoreceptor: some pixels of some stretches, and their events."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax
import numpy as np

from evflow.camera.sensors import LogMap
from evflow.estimation.refine.fine_steps import seconds_at
from evflow.estimation.refine.net_changes import Changes, changes, joined, offset_by_changes
from evflow.estimation.refine.sightings import Sightings, counts_so_far, path_weights
from evflow.estimation.refine.smear import smeared
from evflow.estimation.refine.still_noise import noise_rates

Array = jax.Array

PIXELS, EVENTS = 2048, 1 << 14  # used of a stretch
SETTLE_S = 0.03  # initial part of a stretch, where the low-pass still remembers earlier light
TILES = (6, 8)  # blocks of the image whose errors are independent
ENOUGH = 200  # events of each polarity
MAPS: tuple[LogMap, ...] = ("linlog", "log_eps")  # that are distinguished
LEAST = 20  # usable ones of these: most may lie beside saturated or black frames


# A stretch: path (T + 1, H, W) in DN, dt_s (T,) of its fine steps, its sightings, the number of
# readouts before each in its pixel, and (H * W,) bool, its hot pixels: one that fires regularly
# beside a constant path outweighs thousands of others.
Part = tuple[np.ndarray, np.ndarray, Sightings, np.ndarray, np.ndarray]


class Sample(NamedTuple):
    """C stretches of one length, stacked.

    dn: (C, T + 1, P) path in DN; dt_s: (C, T). Events (C, N) by pixel and time: pixel (0..P-1); at,
    in fine steps; on, off, counts so far; weight; group, of events that share a regression
    constant: those of a pixel, divided at readouts (readouts.py) and noise (receptor_noise.py).
    block: (C, P); noise_hz: (C, 2), of `noise_rates`; watched: (C,) pixel seconds of all pixels;
    net_offset: (C, len(MAPS), 2) offset of the frames and its std by net_changes.py, of all
    stretches, with each log map; lost: (C, N) log units, the pixel's contrast lost in dead times so
    far (lost_contrast.py), None if it is kept."""

    dn: Array
    dt_s: Array
    pixel: Array
    at: Array
    on: Array
    off: Array
    weight: Array
    group: Array
    block: Array
    noise_hz: Array
    watched: Array
    net_offset: Array | None = None
    lost: Array | None = None


def one_stretch(data: Sample, c: int) -> Sample:
    """The fields of stretch c, without its axis, as NumPy arrays."""
    return jax.tree.map(lambda v: np.asarray(v[c]), data)


def sample(
    parts: Iterable[Part], seed: int = 0
) -> Sample | None:
    """Choose pixels and events of each stretch.

    Args:
        parts: all of one length, read one at a time.
        seed: of the random choice.

    Returns:
        The sample; None with too few events.
    """
    rng, count, usable = np.random.default_rng(seed), np.zeros(2, int), np.zeros(2, int)
    rows: list[tuple[np.ndarray, ...]] = []
    nets: list[tuple[Changes, ...]] = []
    seen = 0
    for dn, dt_s, s, disturbed, hot in parts:
        if len(s.pixel):
            row, used = _row(dn, dt_s, s, disturbed, hot, rng, len(rows))
            rows.append(row)
            nets.append(_changes(dn, s, hot, rng, len(nets)))
            seen += s.inner.size
            count += _of_both(s.on)
            usable += _of_both(used)
        del dn, s  # free the memory before the next is made
    if count.min() < ENOUGH or usable.min() < LEAST:
        return None
    all_nets = joined(nets)
    offsets = np.array([offset_by_changes(all_nets, seen, log_map) for log_map in MAPS], np.float32)
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    return Sample(*map(jax.device_put, [*columns, np.stack([offsets] * len(rows))]))


def _changes(
    dn: np.ndarray, s: Sightings, hot: np.ndarray, rng: np.random.Generator, number: int
) -> tuple[Changes, ...]:
    """`net_changes.changes` of a stretch."""
    steps = (len(dn) - 1) // (len(s.frames) - 1)
    block = _block(np.arange(dn[0].size), s.shape, number)
    return changes(dn[::steps], s, block, hot, rng)


def _block(where: np.ndarray, shape: tuple[int, int], number: int) -> np.ndarray:
    """Index of the tile of each pixel, distinct for each stretch."""
    (height, width), tiles = shape, TILES[0] * TILES[1]
    y, x = where // width * TILES[0] // height, where % width * TILES[1] // width
    return np.asarray(y * TILES[1] + x + number * tiles)


def _of_both(on: np.ndarray) -> np.ndarray:
    """Number of ON and of OFF events."""
    return np.array([on.sum(), (~on).sum()])


def smeared_sample(data: Sample, seconds: float) -> Sample:
    """The sample with counts averaged over so many seconds (smear.py)."""
    on, off = np.array(data.on), np.array(data.off)
    weight, pixel, at = (np.asarray(a) for a in (data.weight, data.pixel, data.at))
    for c, dt_s in enumerate(np.asarray(data.dt_s)):
        used = np.flatnonzero(weight[c] > 0)
        place = pixel[c, used], seconds_at(at[c, used], dt_s)
        for counts in (on[c], off[c]):
            counts[used] = smeared(*place, counts[used], seconds)
    return data._replace(on=jax.device_put(on), off=jax.device_put(off))


def _row(
    dn: np.ndarray, dt_s: np.ndarray, s: Sightings, disturbed: np.ndarray, hot: np.ndarray,
    rng: np.random.Generator, number: int,
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Fields of `Sample` for one stretch, and (N,) bool: which of its events are ON."""
    steps = len(dt_s) // (len(s.frames) - 1)
    at = (s.interval + s.fraction) * steps
    group, on, off = counts_so_far(s)
    weight = path_weights(s) * (seconds_at(at, dt_s) > SETTLE_S)
    pixels = s.pixel[s.first]
    chosen = np.flatnonzero(np.bincount(group, weight > 0, len(pixels)) >= 2)
    if len(chosen) > PIXELS:
        chosen = np.sort(rng.choice(chosen, PIXELS, replace=False))
    chosen = chosen[~hot[pixels[chosen]]]
    place = np.full(len(pixels), -1)
    place[chosen] = np.arange(len(chosen))
    kept = np.flatnonzero((place[group] >= 0) & (weight > 1e-6))[:EVENTS]
    where = pixels[chosen]

    def filled(values: np.ndarray, n: int) -> np.ndarray:
        pad = [(0, 0)] * (values.ndim - 1) + [(0, n - values.shape[-1])]
        return np.pad(values.astype(np.float32), pad)

    light = filled(dn.reshape(len(dn), -1)[:, where], PIXELS)
    events = [filled(v[kept], EVENTS) for v in (at, on, off, weight)]
    pixel = filled(place[group][kept], EVENTS).astype(np.int32)
    interval_s = dt_s.reshape(-1, steps).sum(1)
    new = (np.diff(group[kept], prepend=-1) != 0) | (np.diff(disturbed[kept], prepend=-1) != 0)
    part = filled(np.cumsum(new) - 1, EVENTS).astype(np.int32)
    row = (light, dt_s.astype(np.float32), pixel, *events, part,
           filled(_block(where, s.shape, number), PIXELS).astype(np.int32),
           noise_rates(s, interval_s), np.asarray(dt_s.sum() * dn[0].size, np.float32))
    return row, s.on[kept]
