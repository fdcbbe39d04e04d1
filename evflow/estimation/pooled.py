"""Sums over windows: the statistics from which the network makes the summary, and quiet time."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.estimation.intervals import QuietWaits, Waits
from evflow.estimation.pixel_noise import calm, quiet_time
from evflow.estimation.refine.stretches import BAND, LARGE
from evflow.estimation.rested import Drift, Rested
from evflow.estimation.shot import LIGHTS, by_light
from evflow.light.log_maps import (
    lin_log_inverse,
    log_dn,
    mean_and_change,
    noise_factor,
    normalised_intensity,
)
from evflow.network import api
from evflow.network.weighted import summarize_weighted
from evflow.recordings.glitches import exposed
from evflow.recordings.region import bands, rows_of
from evflow.recordings.windows import iter_windows
from evflow.simulator.photoreceptor import IDEAL, Photoreceptor
from evflow.types import Recording, Window
from evflow.voxel import fired_voxels, voxelize

_mean_and_change = jax.jit(mean_and_change)


def window_inputs(
    window: Window, seen_by: Photoreceptor = IDEAL
) -> tuple[ArrayLike, ArrayLike, dict[str, ArrayLike]]:
    """voxels (H, W, 32), dlogI (H, W) and conditions of one window of a recording."""
    voxels = voxelize(window.events, window.t0_us, window.t1_us - window.t0_us)
    intensity, dlogI = _mean_and_change(*(_light(f, seen_by) for f in (
        window.frame0, window.frame1)))
    return voxels, dlogI, {"window_s": window.window_s, "intensity": intensity}


def _light(frame: np.ndarray, seen_by: Photoreceptor) -> np.ndarray:
    """A frame (H, W) in DN, with the light that its pixels see beside it. The network knows lin-log
    alone: if the pixels' logarithm is another, in the DN that have it as their lin-log."""
    if seen_by.offset_dn:
        frame = np.maximum(
            frame.astype(np.float32) + np.float32(seen_by.offset_dn), np.float32(0.0))
    return np.asarray(_of_log(frame)) if seen_by.logarithmic else frame


@jax.jit
def _of_log(frame: ArrayLike) -> jax.Array:
    return lin_log_inverse(log_dn(jnp.asarray(frame, jnp.float32)))


def pool_recording(
    params: api.Params, recording: Recording, min_window_us: int = 40_000
) -> tuple[api.Stats, np.ndarray]:
    """Summed Stats of all windows, and the events (H, W) in them."""
    total: api.Stats | None = None
    n_events = n_shown = np.zeros(())
    for window in iter_windows(recording, min_window_us):
        stats = window_stats(params, window)
        counts, shown = window_counts(window)
        total = stats if total is None else total + stats
        n_events, n_shown = n_events + counts.sum(0), n_shown + shown
    assert total is not None  # iter_windows raises EV017 rather than yield nothing
    need_shown(n_events, n_shown)
    return total, n_events.astype(np.uint32)


def need_shown(n_events: np.ndarray, n_shown: np.ndarray) -> None:
    """EV017 where there are events (H, W) and the frames show none of them."""
    if n_events.any() and not n_shown.any():
        raise EvflowDataError(
            "EV017", "no event happens where the frames are neither saturated nor black.",
            "Expose the frames so that they show what moves.")


def window_counts(window: Window) -> tuple[np.ndarray, np.ndarray]:
    """All events (2, H, W) of a window, ON and OFF, and those (H, W) that its frames show."""
    counts = window.events.count_map().astype(np.uint32)
    return counts, counts.sum(0, dtype=np.uint32) * exposed(window.frame0, window.frame1)


def window_stats(
    params: api.Params, window: Window, seen_by: Photoreceptor = IDEAL,
    counted: np.ndarray | None = None,
) -> api.Stats:
    """Stats of the pixels counted (H, W), by default `pooled_pixels`. Large sensors go band by
    band, whose sums add."""
    shape = window.frame0.shape
    counted = pooled_pixels(window) if counted is None else counted
    if shape[0] * shape[1] <= LARGE:
        return _stats(params, window, seen_by, counted)
    return functools.reduce(operator.add, (
        _stats(params, rows_of(window, rows), seen_by, counted[rows])
        for rows in bands(shape, BAND)))


def pooled_pixels(window: Window, faulty: np.ndarray | None = None) -> np.ndarray:
    """(H, W) bool: pixels that a window's frames show, or all of them if they show none (of a large
    sensor: of a band), without faulty ones (H, W)."""
    shown = exposed(window.frame0, window.frame1)
    large = shown.size > LARGE
    for rows in bands(shown.shape, BAND) if large else [slice(None)]:
        if not shown[rows].any():
            shown[rows] = True
    return shown if faulty is None else shown & ~faulty


def _stats(
    params: api.Params, window: Window, seen_by: Photoreceptor, counted: np.ndarray
) -> api.Stats:
    """Of the pixels counted (H, W); quiet ones of the same brightness go through the network once,
    with their number."""
    counted = counted.ravel()
    frames = np.stack([_light(f, seen_by).ravel() for f in (window.frame0, window.frame1)], 1)
    pixels, voxels = fired_voxels(window.events, window.t0_us, window.t1_us - window.t0_us)
    quiet = counted.copy()
    quiet[pixels] = False
    pairs, numbers = np.unique(frames[quiet].view(np.uint64), return_counts=True)
    kept = counted[pixels]
    return summarize_weighted(
        params, voxels[kept],
        np.concatenate([frames[pixels[kept]], pairs.view(np.float32).reshape(-1, 2)]),
        np.concatenate([np.ones(kept.sum()), numbers]), window.window_s)


@dataclasses.dataclass(frozen=True, eq=False)
class Quiet:
    """Events and time of quiet pixels.

    maps: (2, 2, H, W), ON and OFF, events and seconds; light: the same by the pixels' light, of
    `by_light`; waits: for an event; falling: (2, H, W) seconds, each weighted by `noise_factor` of
    the pixel's light then; factor: the mean of `noise_factor` over pixels and time; share: (2,) of
    pixel_s, the seconds of all pixels but hot ones; drift: (2,) log units per second by which the
    light of the scene rises and falls."""

    maps: np.ndarray
    light: np.ndarray
    waits: Waits
    falling: np.ndarray
    factor: float
    share: np.ndarray
    pixel_s: float
    drift: np.ndarray

    def at_mean_light(self) -> np.ndarray:
        """The maps for noise that falls with light: seconds are replaced by those in which as much
        noise would come at the mean light."""
        return np.stack([self.maps[:, 0], self.falling / self.factor], 1)

    def replaced(self, other: Quiet, which: np.ndarray) -> Quiet:
        """This, with events and seconds of the other for the polarities `which` (2,) bool."""
        of_which = which[:, None, None]
        return dataclasses.replace(
            self, maps=np.where(of_which[..., None], other.maps, self.maps),
            light=np.where(of_which, other.light, self.light),
            falling=np.where(of_which, other.falling, self.falling))


def quiet_times(
    windows: Iterable[Window], summary: Summary, hot: np.ndarray, seen_by: Photoreceptor,
    rested: Rested | None = None,
) -> Quiet:
    """The `quiet_time` of all windows; of pixels that have rested, if `rested` is given."""
    noise = np.array([summary.eta_on, summary.eta_off])
    total = np.zeros((2, 2, *hot.shape))
    light, waits = np.zeros((2, 3, LIGHTS)), QuietWaits(hot.shape)
    falling, factor, seconds = np.zeros((2, *hot.shape)), 0.0, 1e-9
    drift = Drift()
    for window in windows:
        frames = window.frame0, window.frame1
        seen = [_light(f, seen_by) for f in frames]
        mean, change = map(np.asarray, _mean_and_change(*seen))
        counts, visible = window.events.count_map(), exposed(*frames)
        common = drift.add(change, visible & ~hot, window.window_s)
        own = change - common if rested else change
        place = (counts, own, visible, hot, window.window_s, noise)
        found = quiet_time(*place)
        if rested:
            light_at = np.stack([mean - 0.5 * change, mean + 0.5 * change])
            found *= rested.add((window.t0_us, window.t1_us), light_at, counts)[:, None]
        total += found
        # As `seen_frames`: darker by one factor where light is added.
        shown = 255.0 / (255.0 + max(seen_by.offset_dn, 0.0))
        dn = 0.5 * shown * (seen[0].astype(np.float32) + seen[1])
        light += by_light(found, dn, hot)
        of_light = np.asarray(noise_factor(normalised_intensity(np.clip(dn, 0.0, 255.0))))
        falling += found[:, 1] * of_light
        factor += window.window_s * float(of_light.mean())
        seconds += window.window_s
        waits.add(window.events, (window.t0_us, window.t1_us), calm(*place))
    pixel_s = seconds * max(1, int((~hot).sum()))
    share = total[:, 1][:, ~hot].sum(1) / pixel_s
    return Quiet(total, light, waits.table(), falling, factor / seconds, share, pixel_s,
                 drift.per_second)
