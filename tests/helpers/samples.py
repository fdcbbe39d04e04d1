"""What the search for a photoreceptor sees of events that an independent pixel makes of a film."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from helpers.films import FRAME_S, INTERVALS, SHAPE, SUB, film, integrated, lin_log

from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.receptor_data import Sample, sample
from evflow.estimation.refine.sightings import Sightings, sight
from evflow.types import Events


def events_of(
    path: np.ndarray, dt_s: float, delay_s: float, on: float, off: float, noise_hz: float = 0.0
) -> Events:
    """Events of pixels that see path (T, H, W), instants dt_s apart: one instant and event at a
    time. Noise of either polarity stores what is seen, as every event does."""
    rng = np.random.default_rng(1)
    a, b = (rng.normal(theta, 0.03 * theta, path.shape[1:]) for theta in (on, off))
    memory = path[0] + rng.uniform(-a, b)
    rows = []

    def happen(where: np.ndarray, at: np.ndarray, up: np.ndarray) -> None:
        y, x = np.nonzero(where)
        rows.append(np.stack([x, y, np.round((at * dt_s + delay_s) * 1e6)[where], up[where]]))

    for i in range(1, len(path)):
        before, now = path[i - 1], path[i]
        if noise_hz:
            struck = rng.random(now.shape) < 2 * noise_hz * dt_s
            memory = np.where(struck, now, memory)
            happen(struck, np.full(now.shape, i), rng.random(now.shape) < 0.5)
        while (crossed := (now - memory > a) | (memory - now > b)).any():
            up = now > memory
            memory = memory + np.where(up, a, -b) * crossed
            part = (memory - before) / np.where(crossed, now - before, 1.0)
            happen(crossed, i - 1 + part, up)
    x, y, t, p = np.concatenate(rows, 1).astype(np.int64)
    order = np.argsort(t, kind="stable")
    return Events(x[order], y[order], t[order] + 10_000, p[order] > 0, SHAPE[::-1])


NONE_HOT = np.zeros(SHAPE[0] * SHAPE[1], bool)


def no_readouts(s: Sightings) -> np.ndarray:
    """How many events of their pixel that come with a readout precede those sighted: none."""
    return np.zeros(len(s.pixel), int)


def looked_at(
    offset: float, cutoff_hz: float, delay_s: float = 0.0, by_light: bool = True,
    noise_hz: float = 0.0, gain: float = 1.0, log: Callable[[np.ndarray], np.ndarray] = lin_log,
) -> Sample:
    """What such pixels, of .25 and .2, show of the film, whose light is multiplied by gain."""
    dn, dt_s = gain * film(), FRAME_S / STEPS
    tau_s = 1 / (2 * np.pi * cutoff_hz) if cutoff_hz else 0.0
    seen = integrated(dn, dt_s, offset, tau_s, SUB, by_light, log)
    events = events_of(seen, dt_s / SUB, delay_s, 0.25, 0.2, noise_hz)
    return sample_of(dn, events)


def sample_of(dn: np.ndarray, events: Events) -> Sample:
    """The sample of events beside a film."""
    times = 10_000 + np.round(np.arange(INTERVALS + 1) * FRAME_S * 1e6).astype(np.int64)
    s = sight(events, times, lin_log(dn).astype(np.float32), STEPS)
    steps_s = np.full(INTERVALS * STEPS, FRAME_S / STEPS)
    data = sample([(dn.astype(np.float32), steps_s, s, no_readouts(s), np.zeros(dn[0].size, bool))])
    assert data is not None
    return data
