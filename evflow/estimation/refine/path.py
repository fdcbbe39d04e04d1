"""The path of brightness between frames: interpolated frames, and what the pixels see of them.

The frames of a recording are 10-50 ms apart. Motion-compensated interpolation (OpenCV DIS flow)
fills the gaps, so that a moving edge crosses the pixels in between. Host side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from evflow.estimation.refine.denoise import denoised
from evflow.estimation.refine.stretches import BAND, LARGE
from evflow.light.log_maps import lin_log, log_dn
from evflow.recordings.glitches import exposed
from evflow.recordings.region import bands
from evflow.simulator.between import intervals
from evflow.simulator.exposure import unblurred
from evflow.simulator.motion import speed
from evflow.simulator.photoreceptor import FAST, Photoreceptor, seen_path
from evflow.types import Recording

STEPS = 16  # fine frames per interval: motion of 16 px per frame still moves 1 px a step

Place = tuple[Recording, Sequence[int]]  # a recording and a run of its frame intervals


@dataclasses.dataclass(frozen=True, eq=False)
class Film:
    """Frames of a run and interpolated frames. frames: (K + 1, H, W) DN; dn: (K * steps + 1, H, W)
    DN; times_us: (K + 1,); dt_s: (K,) interval lengths; motion_px: (K,) fast motion; shown:
    (K + 1, H, W) bool, neither saturated nor black."""

    frames: np.ndarray
    dn: np.ndarray
    times_us: np.ndarray
    dt_s: np.ndarray
    motion_px: np.ndarray
    shown: np.ndarray


Films = dict[tuple[int, ...], Film]  # by `of_place`


def of_place(recording: Recording, run: Sequence[int]) -> tuple[int, ...]:
    """Key of the film of these intervals; valid while the recording object exists."""
    return id(recording), *run


def interpolated(
    recording: Recording, run: Sequence[int], steps: int = STEPS, noise_dn: float = 0.0
) -> Film:
    """The frames of a run of intervals, denoised (std noise_dn) and without the blur of their
    exposure, with `steps` - 1 frames interpolated by optical flow in each interval."""
    frames = [recording.frame_dn(i) for i in [*run, run[-1] + 1]]
    times = recording.frame_times[run[0]:run[-1] + 2]
    clean = [denoised(frame, noise_dn) for frame in frames]
    dn, motion = np.empty((len(run) * steps + 1, *clean[0].shape), np.float32), []
    moving = intervals(zip(clean, times.tolist(), strict=True), jerk=False)
    for k, interval in enumerate(unblurred(moving, recording.exposure_us)):
        dn[k * steps], dn[(k + 1) * steps] = interval.a.dn, interval.b.dn
        # not sharp: the fusion network was trained on this contrast; sharp frames bias thresholds
        between = interval.at(np.arange(1, steps) / steps, sharp=False)
        for row, picture in zip(dn[k * steps + 1:], between, strict=False):
            row[:] = picture
        motion.append(speed(interval.motion.there))
    return Film(
        np.stack(frames), dn, times, np.diff(times).astype(np.float32) * 1e-6,
        np.array(motion, np.float32), np.stack([exposed(frame) for frame in frames]))


def as_seen(film: Film, seen_by: Photoreceptor, out: np.ndarray | None = None) -> np.ndarray:
    """The path (K * steps + 1, H, W) in log units behind a photoreceptor. out: array for the result
    of large sensors, which are processed in bands; film.dn if that may be overwritten."""
    steps = (len(film.dn) - 1) // len(film.dt_s)
    dt_s = np.repeat(film.dt_s / steps, steps).astype(np.float32)
    values = [np.float32(v) for v in (seen_by.offset_dn, max(seen_by.tau_s, FAST))]

    def seen(dn: np.ndarray) -> jax.Array:
        if not seen_by.offset_dn and not seen_by.tau_s:
            return (_log_dn if seen_by.logarithmic else _lin_log)(dn)
        return _seen(dn, dt_s, *values, seen_by.by_light, seen_by.logarithmic)

    if film.dn[0].size <= LARGE:
        return np.asarray(seen(film.dn))
    out = np.empty_like(film.dn) if out is None else out
    for rows in bands(film.dn.shape[1:], BAND):
        out[:, rows] = seen(np.ascontiguousarray(film.dn[:, rows]))
    return out


_seen, _lin_log, _log_dn = jax.jit(seen_path), jax.jit(lin_log), jax.jit(log_dn)
