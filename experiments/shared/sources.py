"""Scenes to look at: the paper's Figure 4 simulated, and each source of noise by itself.

Every function returns what is drawn: counts or rates per pixel, a measured curve, and the law
that it should follow.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr

from evflow import simulate
from evflow.camera import Camera, Summary, noise_of_threshold, sample_pixels
from evflow.camera.perturb import with_faults
from evflow.camera.sensors import SENSORS, SensorModel
from evflow.types import Events
from experiments.shared import laws

SHAPE = (64, 96)
DT_US = 10_000
ETA = SensorModel()
Source = dict[str, Any]


def still(key: jax.Array, camera: Camera, model: SensorModel, seconds: float, dn: Any = 60.0
          ) -> Events:
    """What a scene at rest makes of itself; dn: a number or a row (W,)."""
    times = np.arange(0, round(seconds * 1e6) + 1, DT_US)
    frames = np.broadcast_to(np.asarray(dn, np.float32), (len(times), *camera.shape))
    return simulate(key, frames, times, camera, model=model)


def gaps(events: Events) -> np.ndarray:
    """Seconds between events of one pixel, both polarities together."""
    at = events.y.astype(np.int64) * events.size[0] + events.x
    order = np.argsort(at, kind="stable")
    return np.diff(events.t[order])[np.diff(at[order]) == 0] * 1e-6


def density(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.histogram(values, edges)[0] / (len(values) * np.diff(edges))


def middles(edges: np.ndarray) -> np.ndarray:
    return 0.5 * (edges[1:] + edges[:-1])


def shot(key: jax.Array) -> Source:
    dn = np.linspace(0, 255, SHAPE[1])
    counts = still(key, Camera.constant(SHAPE), SensorModel(shot_hz=20.0), 5.0, dn).count_map()
    by_dn = counts.reshape(2, SHAPE[0], 16, -1).sum((1, 3)) / (SHAPE[0] * 6 * 5.0)
    x = dn.reshape(16, -1).mean(1)
    return {"title": "shot noise, R = 20 Hz, 0 to 255 DN", "map": counts.sum(0) / 5.0, "x": x,
            "measured": by_dn.sum(0), "law": 20 * laws.dimmed(x),
            "xlabel": "DN", "ylabel": "Hz"}


def leak(key: jax.Array, model: SensorModel, title: str) -> Source:
    """Intervals of a leak; the law: first passages of a contrast that rises in jittered steps."""
    events = still(key, Camera.constant(SHAPE), model, 8.0)
    edges = np.linspace(0.0975, 0.3225, 46)
    variance = max(model.leak_jitter * model.leak_hz, 1e-3) ** 2 * DT_US * 1e-6
    law = np.diff(laws.passage(edges, 1 / model.leak_hz, 1 / variance)) / np.diff(edges)
    return {"title": title, "map": events.count_map().sum(0) / 8.0,
            "x": middles(edges), "measured": density(gaps(events), edges), "law": law,
            "xlabel": "interval [s]", "ylabel": "density", "steps": True}


def pattern(key: jax.Array) -> Source:
    model, edges = SensorModel(leak_hz=5.0, leak_fpn_decades=0.2), np.linspace(-0.2, 1.6, 40)
    rates = still(key, Camera.constant(SHAPE), model, 20.0).count_map().sum(0) / 20.0
    x = middles(edges)
    law = np.exp(-0.5 * ((x - np.log10(5.0)) / 0.2) ** 2) / (0.2 * np.sqrt(2 * np.pi))
    return {"title": "leak pattern, 5 Hz, .2 decades", "map": rates, "x": x, "law": law,
            "measured": density(np.log10(rates.ravel() + 0.025), edges),  # counts round down
            "xlabel": "log10 Hz", "ylabel": "density", "steps": True}


def above(values: np.ndarray, x: np.ndarray) -> np.ndarray:
    return (values.ravel()[:, None] > x).mean(0)


def hot(key: jax.Array) -> Source:
    """Share of the pixels above a rate: drawn (the law) and simulated."""
    camera = with_faults(key, Camera.constant(SHAPE, eta_on=0.5, eta_off=0.5), 0.02, dead=0.0)
    rates = still(key, camera, ETA, 5.0).count_map().sum(0) / 5.0
    x = np.geomspace(4, 150, 20)
    return {"title": "hot pixels, 2 %, 5 to 100 Hz", "map": rates, "x": x, "log": True,
            "measured": above(rates, x),
            "law": above(np.asarray(camera.eta_on + camera.eta_off), x),
            "xlabel": "rate > x [Hz]", "ylabel": "share of pixels"}


def screen_counts(key: jax.Array, camera: Camera) -> np.ndarray:
    """ON events of a screen that brightens ninefold in 100 ms."""
    dn = 25.0 * 9.0 ** np.linspace(0, 1, 51)
    frames = np.broadcast_to(dn[:, None, None].astype(np.float32), (51, *camera.shape))
    return simulate(key, frames, 2000 * np.arange(51), camera).count_map()[0].astype(float)


def dead(key: jax.Array) -> Source:
    camera = with_faults(key, Camera.constant(SHAPE, 0.2), 0.0, dead=0.02)
    x = np.arange(14)
    counts = screen_counts(key, camera)
    law = np.where(x == 0, 0.02, np.where(x == np.floor(np.log(9.0) / 0.2), 0.98, 0.0))
    return {"title": "dead pixels, 2 %, ninefold brighter", "map": counts, "x": x, "law": law,
            "measured": np.bincount(counts.ravel().astype(int), minlength=14)[:14] / counts.size,
            "xlabel": "events", "ylabel": "share of pixels", "discrete": True, "log": "y"}


def mismatch(key: jax.Array) -> Source:
    """A pixel sends n events where its threshold lies in (ln 9 / (n + 1), ln 9 / n]."""
    still_one = (jnp.float32(v) for v in (0.2, 0.2, 0.0, 0.0, 0.03, 0.03))
    counts = screen_counts(key, sample_pixels(key, Summary(*still_one), SHAPE))
    x = np.arange(5, 21)
    at = np.log(9.0) / np.arange(5, 22)
    law = -np.diff(ndtr((at - 0.2) / 0.03))
    return {"title": "threshold mismatch, .2 ± .03, ninefold brighter", "map": counts, "x": x,
            "measured": np.array([(counts == n).mean() for n in x]), "law": law,
            "xlabel": "events", "ylabel": "share of pixels", "discrete": True}


def together(key: jax.Array) -> Source:
    """v2e's noisy sensor with faults; rates per pixel, hot pixels to the right."""
    sensor = SENSORS["noisy"]
    nominal = Summary(*(jnp.float32(v) for v in (
        sensor.theta, sensor.theta, 0.0, 0.0, sensor.mismatch, sensor.mismatch)))
    for_pixels, for_faults, for_events = jax.random.split(key, 3)
    camera = with_faults(for_faults, sample_pixels(for_pixels, nominal, SHAPE), 0.01, dead=0.01)
    rates = still(for_events, camera, sensor.model, 5.0).count_map().sum(0) / 5.0
    x = np.geomspace(0.5, 150, 30)
    on, off = (np.asarray(sensor.theta / t) for t in (camera.theta_on, camera.theta_off))
    hz = 2.5 * laws.dimmed(60.0) * (on + off) + np.asarray(
        camera.eta_on + camera.eta_off)
    drawn = np.random.default_rng(0).poisson(5.0 * hz) / 5.0
    return {"title": "all of it: noisy sensor, 1 % hot, 1 % dead", "map": rates, "x": x,
            "log": True, "measured": above(rates, x), "law": above(drawn, x),
            "xlabel": "rate > x [Hz]", "ylabel": "share of pixels"}


def sources(key: jax.Array) -> list[Source]:
    """Each source of noise by itself, and all together."""
    keys = jax.random.split(key, 8)
    plain = SensorModel(leak_hz=5.0)
    return [shot(keys[0]), leak(keys[1], plain, "leak, 5 Hz"), pattern(keys[2]),
            leak(keys[3], dataclasses.replace(plain, leak_jitter=0.5), "leak jitter .5"),
            hot(keys[4]), dead(keys[5]), mismatch(keys[6]), together(keys[7])]


def figure_four(key: jax.Array) -> list[dict[str, Any]]:
    """A darkening and two brightening screens; two luminances at rest, and a larger threshold.

    Thresholds are those of Table II, SCP 121 and 201; noise is that of Eq. 12.
    """
    low, high = (0.159, 0.249, 0.089, 0.107), (0.433, 0.479, 0.140, 0.109)
    change = 100.0 * 1.5 ** np.linspace(0, 1, 31)  # DN, half as bright again in 30 ms
    rest = {lux: np.full(301, lux * 255 / 4000) for lux in (500, 2000)}  # 30 s
    scenes = (("a: darker", low, change[::-1]), ("b: brighter", low, change),
              ("c: brighter, larger threshold", high, change),
              ("d: 500 lx", low, rest[500]), ("e: 2000 lx", low, rest[2000]),
              ("f: 500 lx, larger threshold", high, rest[500]))
    found = []
    for k, (title, (on, off, sigma_on, sigma_off), dn) in enumerate(scenes):
        k_pixels, k_noise = jax.random.split(jax.random.fold_in(key, k))
        eta = [float(noise_of_threshold(jnp.float32(t)) * laws.dimmed(dn[0])) for t in (on, off)]
        values = (jnp.float32(v) for v in (on, off, *eta, sigma_on, sigma_off))
        camera = sample_pixels(k_pixels, Summary(*values), (96, 128))
        frames = np.broadcast_to(dn[:, None, None].astype(np.float32), (len(dn), 96, 128))
        dt_us = 1000 if len(dn) == len(change) else 100_000
        events = simulate(k_noise, frames, dt_us * np.arange(len(dn)), camera,
                          model=SENSORS["paper"].model)
        end = dt_us * (len(dn) - 1)
        found.append({"title": title, "dn": dn, "seconds": end * 1e-6, "events": events,
                      "span_us": (end - 30_000, end + 1)})
    return found
