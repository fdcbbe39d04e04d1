"""What a pixel's first event tells: nearly its threshold where the memory began as the first frame,
else that the thresholds are not wide; and silence, that they are not narrow."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow import simulate
from evflow.camera import Camera, Summary
from evflow.estimation.refine import PixelEvidence, pixel_posterior
from evflow.estimation.refine.bounds import NOTHING
from evflow.estimation.refine.pixels import pixel_evidence
from evflow.estimation.refine.start import (
    MEMORY_ERRORS,
    Belief,
    fresh_probability,
    with_running_start,
)
from evflow.light.log_maps import lin_log
from evflow.types import Events

SHAPE, STEPS, INTERVALS = (24, 32), 8, 4
MEDIAN, SIGMA = 0.3, 0.1
KNOWN = Summary(*(jnp.float32(v) for v in (MEDIAN, MEDIAN, 0.0, 0.0, SIGMA, SIGMA)))
LENGTH = STEPS * INTERVALS


def recorded(lead: float) -> tuple[PixelEvidence, np.ndarray, np.ndarray]:
    """Evidence, true thresholds (2, H, W) and events (2, H, W) of brightness that rises or falls
    steadily, after a time of which nothing is recorded, in which it changed by N(0, lead²)."""
    rng = np.random.default_rng(3)
    theta = np.maximum(MEDIAN + SIGMA * rng.standard_normal((2, *SHAPE)), 0.05)
    change, before = rng.normal(0, 0.35, SHAPE), rng.normal(0, lead, SHAPE)
    t = np.linspace(-1.0, 1.0, 2 * LENGTH + 1)[:, None, None]
    frames = 90 * np.exp(np.clip(np.where(t < 0, before, change) * t, -1.2, 1.0))
    camera = Camera(*(jnp.asarray(m, jnp.float32) for m in (*theta, *np.zeros((2, *SHAPE)))))
    events = simulate(
        jax.random.key(0), frames.astype(np.float32), 1000 * np.arange(len(t)), camera)
    kept = events.t > 1000 * LENGTH
    events = Events(*(a[kept] for a in (events.x, events.y, events.t, events.p)), events.size)
    times = 1000 * np.arange(LENGTH, 2 * LENGTH + 1, STEPS)
    path = np.asarray(lin_log(frames[LENGTH:].astype(np.float32)))
    evidence = pixel_evidence(events, times, path, STEPS, first=True)
    return evidence, theta, events.count_map()


def chance_of_start(evidence: PixelEvidence) -> np.ndarray:
    """(H, W), with nothing but the prior known beside the first event."""
    prior = Belief(np.full((2, *SHAPE), MEDIAN), np.einsum(
        "ij,yx->ijyx", SIGMA**2 * np.eye(2), np.ones(SHAPE)), np.full(SHAPE, 0.002))
    return fresh_probability(evidence.start, prior, np.full(2, MEDIAN))[1]


def test_a_single_event_tells_the_threshold_of_a_fresh_start() -> None:
    evidence, true, counts = recorded(lead=0.0)
    assert chance_of_start(evidence).mean() > 0.9
    theta, std = pixel_posterior(evidence, KNOWN)
    once = (counts == 1) & (counts.sum(0) == 1)
    assert once.sum() > 50
    error = np.abs(theta - true)
    assert error[once].mean() < 0.65 * np.abs(MEDIAN - true)[once].mean()
    assert (error < std)[once].mean() > 0.65
    # What neither rose nor fell by a threshold is known to have that much at least.
    silent = counts.sum(0) == 0
    assert error[:, silent].mean() < np.abs(MEDIAN - true)[:, silent].mean()


def test_after_other_motion_the_first_frame_is_not_what_is_remembered() -> None:
    evidence, true, counts = recorded(lead=2.0)
    assert chance_of_start(evidence).mean() < 0.5
    theta, std = pixel_posterior(evidence, KNOWN)
    once = (counts == 1) & (counts.sum(0) == 1)
    assert np.abs(theta - true)[once].mean() < 1.02 * np.abs(MEDIAN - true)[once].mean()
    assert (np.abs(theta - true) < std).mean() > 0.6


def test_evidence_of_a_start_is_kept_when_stretches_add() -> None:
    evidence, *_ = recorded(lead=0.0)
    later = PixelEvidence.nothing(SHAPE)
    np.testing.assert_array_equal((evidence + later).start, evidence.start)
    assert (later.start[4:] == NOTHING).all()
    assert (chance_of_start(later) == 0).all()


@pytest.mark.parametrize(("fired", "span"), [(True, 0.2), (False, 0.2), (False, 0.0)])
def test_thresholds_between_which_memory_may_lie_anywhere(fired: bool, span: float) -> None:
    """Against the integral over a fine grid: all that fire are likelier to be narrow, by one over
    their sum; silence is likelier of wide ones; without any change it tells nothing."""
    covariance = np.array([[0.01, 0.002], [0.002, 0.02]])
    mean = np.array([0.3, 0.25])
    (on, off), after = with_running_start(
        mean[:, None, None], covariance[..., None, None], np.full((1, 1), span),
        np.full((1, 1), fired))
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(mean, covariance, 400_000)
    draws = draws[draws.sum(1) > 0.05]
    width = draws.sum(1)
    if span == 0:
        likely = np.ones_like(width)
    else:
        soft = 0.01 * np.log1p(np.exp((width - span) / 0.01))
        silent = soft / width
        likely = 0.8 * (width > span) / width + 0.2 * silent if fired else silent
    expected = np.average(draws, axis=0, weights=likely)
    np.testing.assert_allclose([on[0, 0], off[0, 0]], expected, atol=0.006)
    spread = np.cov(draws.T, aweights=likely)
    np.testing.assert_allclose(after[..., 0, 0], spread, atol=1.5e-3)
    assert (on[0, 0] < 0.3 - 1e-3) == fired
    assert (on[0, 0] > 0.3 + 1e-3) == (span > 0 and not fired)


def test_the_memorys_error_is_found() -> None:
    """First events around the brightness that fresh_probability thresholds foretell, .07 off."""
    rng = np.random.default_rng(0)
    n = 3000
    theta = MEDIAN + SIGMA * rng.standard_normal(n)
    start = np.stack([np.ones(n), np.ones(n), np.zeros(n), theta + 0.07 * rng.standard_normal(n),
                      np.zeros(n), np.zeros(n)])[..., None]
    known = Belief(np.stack([theta, np.full(n, MEDIAN)])[..., None],
                   1e-6 * np.einsum("ij,nk->ijnk", np.eye(2), np.ones((n, 1))),
                   np.full((n, 1), 1e-6))
    error, chance = fresh_probability(start, known, np.full(2, MEDIAN))
    assert error == MEMORY_ERRORS[2]
    assert chance.mean() > 0.9
