"""Recordings of a simulated bench: a screen whose light steps between rests."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import numpy as np

from evflow import Events, Recording, simulate
from evflow.camera import Camera, CameraPrior
from evflow.camera.sensors import SensorModel

IDEAL, SHAPE = SensorModel(), (24, 32)
CYCLES = [25, 225, 25, 225, 25, 225, 25]
STAIRS = [25, 40, 64, 100, 160, 225, 160, 100, 64, 40, 25]


def screen(levels: list[float], rest: int = 100, ramp: int = 20) -> np.ndarray:
    """DN over time, a frame every ms: `rest` ms at each level, `ramp` ms (even in log) between."""
    logs = [np.full(rest, np.log(levels[0]))]
    for a, b in itertools.pairwise(levels):
        logs += [np.linspace(np.log(a), np.log(b), ramp + 1)[1:], np.full(rest, np.log(b))]
    return np.exp(np.concatenate(logs)).astype(np.float32)


def bench(
    camera: Camera, levels: list[float], before: tuple[float, ...] = (),
    model: SensorModel = IDEAL,
) -> Recording:
    """Events of a screen and its frames every 10 ms. before: levels that the camera saw first.
    The simulation is shown every ms of a ramp, and of a rest no more than the frames."""
    lead = len(screen([*before, levels[0]])) - 100 if before else 0
    dn = screen([*before, *levels])
    frames, times = np.broadcast_to(dn[:, None, None], (len(dn), *SHAPE)), 1000 * np.arange(len(dn))
    kept, moving = np.arange(lead, len(dn), 10), np.diff(dn, prepend=dn[0], append=dn[-1]) != 0
    shown = np.union1d(np.flatnonzero(moving[:-1] | moving[1:]), np.arange(0, len(dn), 10))
    events = simulate(jax.random.key(0), frames[shown], times[shown], camera, model=model)
    events = events.slice(int(times[lead]) + 1, int(times[-1]) + 1)
    return Recording(events, np.ascontiguousarray(frames[kept]), times[kept])


def cameras(mismatch: float, noise: str = "none") -> Camera:
    prior = CameraPrior(theta=(0.15, 0.35), mismatch=(mismatch, mismatch), noise=noise)
    return Camera.sample(jax.random.key(3), SHAPE, prior)


def without(recording: Recording, begin_us: int, end_us: int) -> Recording:
    """The recording without its events in [begin_us, end_us), as where packets are lost."""
    events = recording.events
    kept = (events.t < begin_us) | (events.t >= end_us)
    columns = (getattr(events, name)[kept] for name in ("x", "y", "t", "p"))
    return dataclasses.replace(recording, events=Events(*columns, events.size))
