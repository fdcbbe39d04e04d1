"""Statistics of windows: pixels that show the same are counted once."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from helpers.networks import small_params

from evflow import Events, Window, summarize
from evflow.estimation.pooled import window_inputs, window_stats
from evflow.network import weighted
from evflow.recordings.glitches import exposed
from evflow.simulator.photoreceptor import Photoreceptor

SHAPE = (6, 9)


def watched(low: int, high: int) -> Window:
    """A window of two noisy frames of few levels and events at a third of the pixels."""
    rng = np.random.default_rng(3)
    frames = 8 * rng.integers(low, high, (2, *SHAPE)).astype(np.float32)
    x, y = rng.integers(0, 4, 40), rng.integers(0, SHAPE[0], 40)
    events = Events(x, y, np.sort(rng.integers(1_000, 41_000, 40)), rng.random(40) < 0.6,
                    SHAPE[::-1])
    return Window(events, *frames, 1_000, 41_000, 0)


@pytest.mark.parametrize(("low", "high", "offset"), [(0, 4, 0.0), (12, 15, 20.0), (0, 1, 0.0)],
                         ids=["some are black", "light is added", "all are black"])
def test_the_pixels_shown_are_summed(
    low: int, high: int, offset: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weighted, "LARGE", 16)  # several chunks, the last not full
    window, params, seen_by = watched(low, high), small_params(), Photoreceptor(offset_dn=offset)
    found = window_stats(params, window, seen_by)
    shown = exposed(window.frame0, window.frame1)
    kept = shown if shown.any() else ~shown
    voxels, change, given = window_inputs(window, seen_by)
    expected = summarize(
        params, voxels[kept][None], np.asarray(change)[kept][None], window_s=window.window_s,
        intensity=np.asarray(given["intensity"])[kept][None])
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=1e-5)
