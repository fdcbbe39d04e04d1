"""Known sensors on one scene: their events, and the numbers of `models`' page."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow import simulate
from evflow.camera import Summary, noise_of_threshold, sample_pixels
from evflow.camera.sensors import SENSORS, KnownSensor
from evflow.types import Events
from experiments.shared.sources import density, gaps

FPS, SHOWN_US, RATE_US = 1000, 8_000, 5_000
EDGES_S = np.geomspace(1e-5, 1.0, 41)


def sensors() -> dict[str, KnownSensor]:
    """All known sensors, and the clean one with v2e's time stamps."""
    clean = SENSORS["clean"]
    slots = dataclasses.replace(clean, model=dataclasses.replace(clean.model, timestamps="v2e"))
    return {"clean": clean, "clean, slots": slots, **SENSORS}


def seen_by(
    key: jax.Array, sensor: KnownSensor, frames: np.ndarray
) -> tuple[Events, np.ndarray]:
    """Events and which of them are noise. The paper's sensor has the noise of Eq. 12 at the
    middle of its range of intensity factors."""
    k_camera, k_noise = jax.random.split(key)
    eta = 0.0
    if sensor.model.kind == "paper":
        eta = 0.625 * float(noise_of_threshold(jnp.float32(sensor.theta)))
    values = (sensor.theta, sensor.theta, eta, eta, sensor.mismatch, sensor.mismatch)
    camera = sample_pixels(k_camera, Summary(*map(jnp.float32, values)), frames.shape[1:])
    times = np.arange(len(frames)) * (1_000_000 // FPS)
    return simulate(k_noise, frames, times, camera, model=sensor.model, labels=True)


def describe(events: Events, noise: np.ndarray, seconds: float) -> dict[str, Any]:
    """The numbers of the page; densities are per decade of the interval."""
    pixels = events.size[0] * events.size[1]
    edges = np.arange(0, round(seconds * 1e6) + 1, RATE_US)
    rates = {name: np.histogram(events.t[events.p == on] - 1, edges)[0] / (pixels * RATE_US * 1e-6)
             for name, on in (("rate_on", True), ("rate_off", False))}
    between = gaps(events)
    decades = np.log10(EDGES_S)
    return {"on": int(events.p.sum()), "off": int((~events.p).sum()), "noise": int(noise.sum()),
            "distinct": len(np.unique(events.t)), "rate_s": (edges[:-1] * 1e-6).tolist(),
            **{k: v.tolist() for k, v in rates.items()},
            "interval_s": np.sqrt(EDGES_S[1:] * EDGES_S[:-1]).tolist(),
            "intervals": density(np.log10(np.maximum(between, 1e-6)), decades).tolist(),
            "median_interval_s": float(np.median(between))}


def table(result: dict[str, Any], seconds: float) -> str:
    lines = ["| sensor | θ | mismatch | ON | OFF | noise | distinct time stamps | median interval "
             "[ms] |", "|" + "---|" * 8]
    for name, sensor in sensors().items():
        row = result[name]
        lines.append(
            f"| {name} | {sensor.theta:.3f} | {sensor.mismatch} | {row['on']:,} | {row['off']:,} | "
            f"{row['noise']:,} | {row['distinct']:,} | {1e3 * row['median_interval_s']:.2f} |")
    return "\n".join([*lines, "", f"{seconds:g} s hold {1e6 * seconds:,.0f} microseconds: no more "
                      "time stamps can differ."])
