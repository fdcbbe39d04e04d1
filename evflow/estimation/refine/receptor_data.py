"""What the search for a photoreceptor looks at: some pixels of some stretches, and their events."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax
import numpy as np

from evflow.estimation.refine.receptor_noise import noise_rates
from evflow.estimation.refine.sightings import Sightings, counted, trusted
from evflow.estimation.refine.smear import smeared

Array = jax.Array

PIXELS, EVENTS = 2048, 1 << 14  # of a stretch that are looked at
SETTLE_S = 0.03  # of a stretch: before, what the pixel saw earlier still counts
TILES = (6, 8)  # blocks of the image whose errors are independent
ENOUGH = 200  # events of either polarity to look at
LEAST = 20  # of these, that are used: frames may hide what most of the pixels saw


class Sample(NamedTuple):
    """Stretches of one length, stacked: dn (C, T + 1, P) path in DN, dt_s (C, T); events (C, N) by
    pixel and time: pixel (0..P-1), at (in fine steps), on, off (counts so far), weight, and group,
    with whose events one shares a constant: those of its pixel, unless a readout (readouts.py) or
    noise (receptor_noise.py) came between; block (C, P); noise_hz (C, 2): of `noise_rates`."""

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


def sample(
    parts: Iterable[tuple[np.ndarray, np.ndarray, Sightings, np.ndarray]], seed: int = 0
) -> Sample | None:
    """What the search looks at. parts: of each stretch the path (T + 1, H, W) in DN, dt_s (T,) of
    its fine steps, its sightings, and how often readouts disturbed the pixel before each, all of
    one length; None where too little happens. One is looked at at a time."""
    rng, count, told = np.random.default_rng(seed), np.zeros(2, int), np.zeros(2, int)
    rows: list[tuple[np.ndarray, ...]] = []
    for dn, dt_s, s, disturbed in parts:
        if len(s.pixel):
            row, used = _row(dn, dt_s, s, disturbed, rng, len(rows))
            rows.append(row)
            count += _of_both(s.on)
            told += _of_both(used)
        del dn, s  # before the next is made
    if count.min() < ENOUGH or told.min() < LEAST:
        return None
    return Sample(*(jax.device_put(np.stack(column)) for column in zip(*rows, strict=True)))


def _of_both(on: np.ndarray) -> np.ndarray:
    """How many ON and how many OFF events."""
    return np.array([on.sum(), (~on).sum()])


def smeared_sample(data: Sample, seconds: float) -> Sample:
    """The sample with each count replaced by its mean over that time (smear.py)."""
    on, off = np.array(data.on), np.array(data.off)
    weight, pixel, at = (np.asarray(a) for a in (data.weight, data.pixel, data.at))
    for c, dt_s in enumerate(np.asarray(data.dt_s)):
        used = np.flatnonzero(weight[c] > 0)
        place = pixel[c, used], at[c, used]
        for counts in (on[c], off[c]):
            counts[used] = smeared(*place, counts[used], seconds / float(dt_s.mean()))
    return data._replace(on=jax.device_put(on), off=jax.device_put(off))


def _row(
    dn: np.ndarray, dt_s: np.ndarray, s: Sightings, disturbed: np.ndarray,
    rng: np.random.Generator, number: int,
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """The fields of a Sample, of one stretch, and which of the events in it are ON."""
    steps = len(dt_s) // (len(s.frames) - 1)
    at = (s.interval + s.fraction) * steps
    group, on, off = counted(s)
    weight = trusted(s) * (at > SETTLE_S / dt_s.mean())
    pixels = s.pixel[s.first]
    chosen = np.flatnonzero(np.bincount(group, weight > 0, len(pixels)) >= 2)
    if len(chosen) > PIXELS:
        chosen = np.sort(rng.choice(chosen, PIXELS, replace=False))
    place = np.full(len(pixels), -1)
    place[chosen] = np.arange(len(chosen))
    kept = np.flatnonzero((place[group] >= 0) & (weight > 1e-6))[:EVENTS]
    (height, width), where = s.shape, pixels[chosen]
    block = (where // width * TILES[0] // height) * TILES[1] + where % width * TILES[1] // width

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
           filled(block + number * TILES[0] * TILES[1], PIXELS).astype(np.int32),
           noise_rates(s, interval_s))
    return row, s.on[kept]
