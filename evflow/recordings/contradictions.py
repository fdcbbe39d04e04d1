"""Frames that the events contradict: between frames, log brightness changes by the sum of a pixel's
events, one threshold each.

The change of log brightness is regressed on the ON and OFF events of the same interval, over the
whole recording. In a sound recording the residual is alike in all intervals. If it is much larger
on both sides of a frame and hardly correlated with events, that frame shows something else; if all
pixels change together without events, the exposure changed.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.types import Recording, release

Array = np.ndarray

PIXELS = 4096  # examined, evenly spread
DARK_DN, BRIGHT_DN = 15.0, 252.0  # outside, changes of log brightness are unreliable
FRAMES = 64  # read before their memory is released: they may be memory-mapped
LEAST_PIXELS, LEAST_INTERVALS = 100, 6
FOLLOWS = 0.4  # median correlation of change and net events, below which events cannot judge frames
LITTLE, MUCH = 0.5, 2.0  # times the median correlation, times the median residual
STEP, STEP_SPREAD = 0.08, 9.0  # log units; median deviations of an interval's mean residual


@dataclasses.dataclass(frozen=True, eq=False)
class Residuals:
    """For each interval that the events cover, arrays (K,): its number, the correlation of change
    and net events, and the rms and mean of the residual in log units."""

    interval: Array
    correlation: Array
    rms: Array
    mean: Array


def contradicted(recording: Recording, start_us: int, stop_us: int) -> tuple[list[int], list[int]]:
    """Frames that the events contradict, and intervals i (frame i to i + 1) in which the whole
    frame changes without events; start_us, stop_us: the time that the events cover."""
    found = _residuals(recording, start_us, stop_us)
    if found is None or np.median(found.correlation) < FOLLOWS:
        return [], []
    strange = ((found.correlation < LITTLE * np.median(found.correlation))
               & (found.rms > MUCH * np.median(found.rms)))
    at = found.interval
    frames = [int(i) for i in at[1:][strange[1:] & strange[:-1] & (np.diff(at) == 1)]]
    away = np.abs(found.mean - np.median(found.mean))
    steps = at[(away > max(STEP, STEP_SPREAD * float(np.median(away)))) & ~strange]
    return frames, [int(i) for i in steps]


def _residuals(recording: Recording, start_us: int, stop_us: int) -> Residuals | None:
    times = recording.frame_times
    covered = np.flatnonzero((times[:-1] >= start_us) & (times[1:] <= stop_us))
    if len(covered) < LEAST_INTERVALS:
        return None
    moments = np.array([_moments(recording, int(i)) for i in covered])
    shown = moments[:, 0] > max(LEAST_PIXELS, LITTLE * np.median(moments[:, 0]))
    if shown.sum() < LEAST_INTERVALS:
        return None
    mean, second = moments[:, 1:4], moments[:, 4:].reshape(-1, 3, 3)
    covariance = second - mean[:, :, None] * mean[:, None, :]  # of change, ON and minus OFF events
    net = covariance @ np.array([0.0, 1.0, 1.0])
    power = covariance[:, 0, 0] * (net[:, 1] + net[:, 2])
    correlation = np.where(power > 0, net[:, 0] / np.sqrt(np.where(power > 0, power, 1.0)), 0.0)
    correlation = np.where(shown, correlation, 0.0)
    usual = covariance[correlation >= np.median(correlation)].sum(0)
    if np.linalg.matrix_rank(usual[1:, 1:]) < 2:
        return None
    away = np.array([1.0, *-np.linalg.solve(usual[1:, 1:], usual[1:, 0])])
    rms = np.sqrt(np.maximum(np.einsum("i,kij,j->k", away, covariance, away), 0.0))
    # A frame that hides what the others show is as suspect as one that shows something else.
    return Residuals(covered, correlation, np.where(shown, rms, np.inf),
                 np.where(shown, mean @ away, np.median(mean @ away)))


def _moments(recording: Recording, i: int) -> Array:
    """(13,): number of pixels visible in frames i and i + 1, then mean and second moments of their
    change of log brightness, ON events and minus OFF events."""
    height, width = recording.frames.shape[1:]
    stride = max(1, int(np.sqrt(height * width / PIXELS)))
    before, after = (recording.frame_dn(j)[::stride, ::stride] for j in (i, i + 1))
    t0, t1 = (int(t) for t in recording.frame_times[i:i + 2])
    if i % FRAMES == 0:
        release(recording)
    on, off = recording.events.slice(t0, t1).count_map()[:, ::stride, ::stride]
    shown = (np.minimum(before, after) > DARK_DN) & (np.maximum(before, after) < BRIGHT_DN)
    if not shown.any():
        return np.zeros(13)
    change = np.log(after[shown]) - np.log(before[shown])
    values = np.stack([change, on[shown].astype(np.float64), -off[shown].astype(np.float64)])
    second = (values[:, None] * values[None]).mean(-1)
    return np.concatenate([[shown.sum()], values.mean(1), second.ravel()])
