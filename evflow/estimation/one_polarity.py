"""Fallback when one polarity has too few events to determine its threshold."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from evflow.camera import Summary
from evflow.estimation.refine import Chunk, high_threshold_explains, refine_alone
from evflow.estimation.static import uniform
from evflow.network.pooling import Stats
from evflow.training.config import PRESETS

POLARITIES = ("on", "off")
BEYOND_NOISE = 3.0  # standard deviations by which events must exceed the noise
ALLOWED = 2.0  # the same, by which noise may exceed a polarity's events
UNREFINED = (0.5, 1.0)  # relative errors of theta, eta from the network alone


def without_those(stats: Stats, hot: np.ndarray) -> Stats:
    """The statistics without the events (2,), ON and OFF, that hot pixels sent."""
    left = {f"events_{name}": jnp.maximum(getattr(stats, f"events_{name}") - jnp.float32(n), 0.0)
            for name, n in zip(POLARITIES, hot, strict=True)}
    return dataclasses.replace(stats, **left) if hot.any() else stats


def undetermined(stats: Stats, summary: Summary) -> tuple[str, ...]:
    """The polarities, "on" and "off", with no more events than noise explains."""
    found = []
    for name in POLARITIES:
        events = float(getattr(stats, f"events_{name}"))
        noise = float(getattr(summary, f"eta_{name}") * stats.exposure)
        if events - noise < BEYOND_NOISE * np.sqrt(max(events, 1.0)):
            found.append(name)
    return tuple(found)


def no_more_than_all(stats: Stats, summary: Summary, std: Summary) -> tuple[Summary, Summary]:
    """The summary and its std with noise rates that a polarity's events allow: noise sends no more
    than all of them."""
    known = {}
    for name in POLARITIES:
        events, watched = float(getattr(stats, f"events_{name}")), float(stats.exposure)
        rate, error = (float(getattr(s, f"eta_{name}")) for s in (summary, std))
        most = (events + ALLOWED * math.sqrt(events) + 1.0) / max(watched, 1e-9)
        if rate > most:
            known[f"eta_{name}"] = most, min(error, most)
    return _changed(summary, std, known)


def with_prior(
    names: tuple[str, ...], chunks: list[Chunk], summary: Summary, std: Summary
) -> tuple[Summary, Summary, tuple[str, ...]]:
    """The summary and its std with the prior's thresholds for undetermined polarities. Re-estimates
    the other polarity by itself, unless a high threshold in the summary already explains the
    missing events. Also returns the polarities that were re-estimated."""
    known = {f"theta_{n}": _theta_prior() for n in names}
    alone: list[str] = []
    for side, name in enumerate(POLARITIES):
        if name in names or (chunks and high_threshold_explains(chunks, summary, std, side)):
            continue
        theta, eta = (float(getattr(summary, f"{p}_{name}")) for p in ("theta", "eta"))
        if chunks:
            theta, error, noise = refine_alone(
                chunks, *_changed(summary, std, known), side, _theta_prior())
            known[f"theta_{name}"] = theta, error
            alone.append(name)
            if not noise:
                known[f"eta_{name}"] = _eta_prior()
        else:
            known[f"theta_{name}"] = theta, UNREFINED[0] * theta
            known[f"eta_{name}"] = eta, UNREFINED[1] * eta
    return *_changed(summary, std, known), tuple(alone)


def _theta_prior() -> tuple[float, float]:
    return uniform(PRESETS["default"].prior.theta)


def _eta_prior() -> tuple[float, float]:
    """Median and standard deviation of a log-uniform rate."""
    low, high = PRESETS["default"].prior.eta
    log_range = math.log(high / low)
    mean, square = (high - low) / log_range, (high**2 - low**2) / (2 * log_range)
    return math.sqrt(low * high), math.sqrt(square - mean**2)


def _changed(
    summary: Summary, std: Summary, known: dict[str, tuple[float, float]]
) -> tuple[Summary, Summary]:
    values, errors = ({k: jnp.float32(v[i]) for k, v in known.items()} for i in (0, 1))
    return dataclasses.replace(summary, **values), dataclasses.replace(std, **errors)
