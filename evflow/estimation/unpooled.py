"""A camera from weights that see every pixel separately, like the paper's network: the mean of the
flow's maps over all windows.

There is no set network to pool windows, no starting point for a refinement, and no estimate of
errors: standard deviations are NaN, and the summary is computed from the maps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax.numpy as jnp
import numpy as np

from evflow.camera import PARAMETERS, THETA_MIN, Camera, Summary
from evflow.estimation.pooled import need_shown, window_counts, window_inputs
from evflow.estimation.result import CameraEstimate
from evflow.network import api
from evflow.network.architecture import config_of
from evflow.network.coordinates import squash
from evflow.notes import Note
from evflow.recordings.check.contents import VALID_EVENTS
from evflow.recordings.faulty_pixels import dead_pixels
from evflow.recordings.glitches import exposed
from evflow.types import Recording, Window

Array = np.ndarray

WINDOW_US = 25_000  # minimum: the paper's network was trained only on windows of 32 ms


def window_map(params: api.Params, window: Window) -> tuple[Array, Array]:
    """The flow's maps for one window, (4, H, W) by PARAMETERS, and where its frames show the light,
    (H, W) bool."""
    voxels, dlogI, given = window_inputs(window)
    y, _ = api.estimate_y(params, voxels, dlogI, summary=None, **given)
    camera = squash(y, config_of(params).output)
    return (np.stack([np.asarray(getattr(camera, name)) for name in PARAMETERS]),
            exposed(window.frame0, window.frame1))


def estimate_unpooled(
    recording: Recording, windows: Iterator[Window], params: api.Params, *,
    before: tuple[Note, ...] = (), advance: Callable[[], None] = lambda: None,
) -> CameraEstimate:
    """The mean of the windows' maps; `before` are notes on reading. Raises EV017 if no event
    happens where the frames show light."""
    shape = recording.events.size[::-1]
    total, times = np.zeros((4, *shape)), np.zeros(shape)
    n_events, n_shown, count = np.zeros(shape, np.uint32), np.zeros(shape, np.uint32), 0
    for window in windows:
        values, shown = window_map(params, window)
        total += np.where(shown, values, 0.0)
        times += shown
        counts, seen = window_counts(window)
        n_events, n_shown, count = n_events + counts.sum(0, np.uint32), n_shown + seen, count + 1
        advance()
    need_shown(n_events, n_shown)
    maps, below = _within(total, times)
    valid = n_shown >= VALID_EVENTS
    summary = _summary(maps, valid if valid.any() else times > 0)
    return CameraEstimate(
        Camera(*(jnp.asarray(m, jnp.float32) for m in maps)),
        Camera(*[jnp.full(shape, jnp.nan)] * 4), summary,
        Summary(*[jnp.float32(jnp.nan)] * 6), valid, n_events, np.zeros(shape, bool),
        dead_pixels(n_events), count, (*before, *_notes(below)), ())


def _within(total: Array, times: Array) -> tuple[Array, float]:
    """Mean maps (4, H, W) from their sums, raised to possible values, with the median of the others
    where nothing was shown; and the share of impossible values."""
    known = times > 0
    maps = total / np.maximum(times, 1)
    middle = np.median(maps[:, known], 1)[:, None, None]
    maps = np.where(known, maps, middle)
    least = np.array([THETA_MIN, THETA_MIN, 0.0, 0.0])[:, None, None]
    return np.maximum(maps, least), float((maps < least).mean())


def _summary(maps: Array, used: Array) -> Summary:
    """Medians of thresholds, means of rates, and the spread of thresholds over pixels."""
    theta, eta = maps[:2, used], maps[2:, used]
    values = (*np.median(theta, 1), *eta.mean(1), *theta.std(1))
    return Summary(*(jnp.float32(v) for v in values))


def _notes(below: float) -> list[Note]:
    notes = [Note("std.none", "these weights see every pixel separately and estimate no errors: "
                  "standard deviations are NaN, the summary is the median of the maps, and nothing "
                  "was refined. The weights \"default\" estimate more.")]
    if below:
        notes.append(Note("maps.raised", f"{below:.1%} of the maps' values were impossible (below "
                          f"θ {THETA_MIN}, η 0) and were raised to that."))
    return notes

