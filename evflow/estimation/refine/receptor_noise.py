"""Noise in the pooled regression: a pixel's constant changes at each noise event.

A noise event resets the memory to the brightness, like any event, but adds a whole threshold to the
counts whatever the change was. After a few of them a pixel's counts are unrelated to its
brightness. An event counts as noise where the path changes so slowly that noise, at the rates of
still_noise.py, is its likely cause.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from evflow.estimation.refine.fine_steps import later, seconds_at
from evflow.estimation.refine.receptor_data import Sample, one_stretch
from evflow.estimation.refine.sightings import TYPICAL_THETA
from evflow.simulator.photoreceptor import FAST, Photoreceptor, seen_path

Array = np.ndarray

MISSED_HZ = 1.0  # signal events per pixel whose cause the path misses
LIKELY = 0.15  # probability of noise above which an event counts as noise
REACH = 2  # fine steps before and after an event over which the path's slope is taken


def split_at_noise(data: Sample, seen_by: Photoreceptor, theta: Array | None = None) -> Sample:
    """Divide the sample's groups at events that are likely noise; such an event begins a group.

    Args:
        data: the sample.
        seen_by: the photoreceptor by which the path is seen.
        theta: (2,) thresholds, to convert the path's slope into an event rate; at least
            TYPICAL_THETA is used, as noise lowers the thresholds of a regression.
    """
    noise_hz = np.asarray(data.noise_hz).mean(0)
    if noise_hz.max() * (1.0 - LIKELY) <= LIKELY * MISSED_HZ:
        return data
    scale = np.full(2, TYPICAL_THETA) if theta is None else np.maximum(theta, TYPICAL_THETA)

    groups = [_groups(one_stretch(data, c), seen_by, noise_hz, scale)
              for c in range(len(data.dn))]
    return data._replace(group=jnp.asarray(np.stack(groups)))


def _groups(d: Sample, seen_by: Photoreceptor, noise_hz: Array, theta: Array) -> Array:
    """(N,) int32 groups of one stretch."""
    path = path_of(d, seen_by)
    used = np.flatnonzero(np.asarray(d.weight) > 0)
    at, pixel, on, part = (np.asarray(v)[used] for v in (d.at, d.pixel, d.on, d.group))
    last = len(path) - 1
    step = np.minimum(later(at, d.dt_s, -seen_by.delay_s), last - 1).astype(np.int64)
    low, high = np.maximum(step - REACH, 0), np.minimum(step + 1 + REACH, last)
    slope = (path[high, pixel] - path[low, pixel]) / (
        seconds_at(high, d.dt_s) - seconds_at(low, d.dt_s))
    new = np.diff(pixel, prepend=-1) != 0
    rose = np.where(new, on > 0, np.diff(on, prepend=0.0) > 0)
    side = np.where(rose, 0, 1)
    cause_hz = np.maximum(np.where(rose, slope, -slope), 0.0) / theta[side] + MISSED_HZ
    noise = noise_hz[side]
    group = np.zeros(len(d.weight), np.int32)
    new |= np.diff(part, prepend=-1) != 0
    group[used] = np.cumsum(new | (noise > LIKELY * (noise + cause_hz))) - 1
    return group


def path_of(d: Sample, seen_by: Photoreceptor) -> Array:
    """(T + 1, P) path of one stretch, log units, as the pixels see it but for its delay."""
    return np.asarray(_seen(d.dn, d.dt_s, np.float32(seen_by.offset_dn),
                            np.float32(max(seen_by.tau_s, FAST)), seen_by.by_light,
                            seen_by.logarithmic))


_seen = jax.jit(seen_path)
