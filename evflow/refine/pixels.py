"""Each pixel's thresholds, by regression of the path on the pixel's own events.

At the instant of an event the memory equals the brightness, so over the events i of a pixel the
path at t_i is theta_on a_i - theta_off b_i plus a constant, a and b counting its events: a linear
regression without quantisation noise, whose only error is the path's. Its normal equations add
over chunks; the camera's summary and mismatch are the prior.
"""

from __future__ import annotations

import numpy as np

from evflow.camera import THETA_MIN, Summary
from evflow.types import Events

PATH_ERROR = 0.04  # log units: error of the path at a frame, from the frame's noise
RANGE_ERROR = 0.2  # of the path's range in an interval: its error half-way between two frames
PRIOR_COUNT = 3.0  # events' worth of belief in PATH_ERROR, against the residuals seen
SHARED_ERROR = 4.0  # errors of neighbouring events go together: variance is this much larger
PASSES = 3
HIDDEN = 1e-9  # weight of an event whose brightness no frame shows: nothing, yet no 0 / 0


def pixel_equations(
    events: Events, times_us: np.ndarray, path: np.ndarray, steps: int,
    shown: np.ndarray | None = None,
) -> np.ndarray:
    """Normal equations (7, H, W): sums of weighted aa, ab, bb, ay, by, yy about their means, and
    the number of events; path (K*steps + 1, H, W) between the frames at times_us (K+1,). Events
    of intervals that are not shown (K, H, W) count on, but are not regressed."""
    width, height = events.size
    used = events.slice(int(times_us[0]) + 1, int(times_us[-1]) + 1)
    n_pixels, k = height * width, len(times_us) - 1
    out = np.zeros((7, n_pixels))
    if len(used) == 0:
        return out.reshape(7, height, width)
    pixel = used.y.astype(np.int64) * width + used.x
    order = np.argsort(pixel, kind="stable")
    pixel, t, on = pixel[order], used.t[order], used.p[order].astype(np.float64)
    interval = np.searchsorted(times_us, t, side="left") - 1
    fraction = (t - times_us[interval]) / np.diff(times_us)[interval]
    position = np.minimum((interval + fraction) * steps, k * steps - 1e-9)
    step = position.astype(np.int64)
    flat = path.reshape(len(path), -1)
    y = flat[step, pixel] + (position - step) * (flat[step + 1, pixel] - flat[step, pixel])
    inner = path[1:].reshape(k, steps, -1)
    span = (inner.max(1) - inner.min(1))[interval, pixel]
    weight = 1.0 / (1.0 + (RANGE_ERROR / PATH_ERROR * span) ** 2 * 4 * fraction * (1 - fraction))
    if shown is not None:
        weight *= np.where(shown.reshape(k, -1)[interval, pixel], 1.0, HIDDEN)
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    group = np.cumsum(np.diff(pixel, prepend=-1) != 0) - 1

    def total(v: np.ndarray) -> np.ndarray:
        return np.bincount(group, v)

    def centred(v: np.ndarray) -> np.ndarray:
        return v - (total(weight * v) / total(weight))[group]

    a, b = np.cumsum(on), np.cumsum(1.0 - on)
    a, b, y = (centred(v) for v in (a - a[first][group], b[first][group] - b, y))
    sums = [total(weight * u * v) for u, v in ((a, a), (a, b), (b, b), (a, y), (b, y), (y, y))]
    used_events = np.ones_like(y) if shown is None else shown.reshape(k, -1)[interval, pixel]
    out[:, pixel[first]] = [*sums, total(used_events)]
    return out.reshape(7, height, width)


def pixel_posterior(equations: np.ndarray, summary: Summary) -> tuple[np.ndarray, np.ndarray]:
    """theta (2, H, W) and its std, given the camera: N(median, sigma²) per pixel times the
    regression, whose error variance each pixel learns from its own residuals."""
    aa, ab, bb, ay, by, yy, count = equations
    mean = np.array([float(summary.theta_on), float(summary.theta_off)])
    prior = np.array([float(summary.sigma_on), float(summary.sigma_off)])
    p_on, p_off = 1.0 / np.maximum(prior, 0.01) ** 2
    variance = np.full(aa.shape, PATH_ERROR**2)
    for _ in range(PASSES):
        s = SHARED_ERROR * variance
        m11, m12, m22 = aa / s + p_on, ab / s, bb / s + p_off
        r1, r2 = ay / s + p_on * mean[0], by / s + p_off * mean[1]
        det = m11 * m22 - m12**2
        on, off = (m22 * r1 - m12 * r2) / det, (m11 * r2 - m12 * r1) / det
        residual = (yy - 2 * on * ay - 2 * off * by + on**2 * aa + off**2 * bb
                    + 2 * on * off * ab)
        variance = ((PRIOR_COUNT * PATH_ERROR**2 + np.maximum(residual, 0.0))
                    / (PRIOR_COUNT + np.maximum(count - 1.0, 0.0)))
    theta = np.maximum(np.stack([on, off]), THETA_MIN)
    return theta.astype(np.float32), np.sqrt(np.stack([m22, m11]) / det).astype(np.float32)
