"""The asynchronous Kalman filter: log intensity x and its variance P, tracked per pixel.

Wang, Ng, Scheerlinck, Mahony, "An Asynchronous Kalman Filter for Hybrid Event Cameras" (ICCV
2021). Between updates, dt apart, with reference brightness y and its precision 1/R, exactly:
x <- y + (x - y) / (1 + P dt/R) and P <- P / (1 + P dt/R); then P += sigma_p dt, and an event adds
+-theta to x and Q to P. A frame updates every pixel without an event. The reference is the latest
frame plus the events since: "between" blends it with the next frame minus the events until then, as
published, which uses the future; "latest" does not. With "latest" events change y and x alike, so
the filter is direct integration from the latest frame plus a decaying remainder.
Exposure deblurring is left out, as recordings seldom state the exposure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from evflow.baselines.reconstruction import (
    Reconstructor,
    Segment,
    checked,
    segments,
    steps_of,
)
from evflow.camera import Camera
from evflow.light.logarithm import Logarithm
from evflow.types import Events

Array = jax.Array
Values = jax.Array | np.ndarray

PRECISION = 7e5  # 1/R per second of a frame at mid-range, of brightness on 0..1
LEAST_CERTAINTY = 0.09  # of a black or saturated pixel
# Certainty 1 - |2 DN/255 - 1|^6, above .9 from 41 to 214 DN: the shape of the published table,
# which was measured on one camera.
SHARPNESS = 6
BORDER_VARIANCE = 10.0  # Q of a pixel without eight neighbours
SCALE_RANGE = (0.6, 100.0)  # of the contrast of an interval's events over its frame difference;
# outside of it the two are unrelated, and events are not rescaled
LANES, GROWTH = 4096, 4  # pixels at a time; events padded to powers of 4, for few programs


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pixel:
    """State of pixels (...): x, P, and the signed contrast of events since the frame."""

    x: Values
    variance: Values
    since: Values


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Reference:
    """Frames around the present of pixels (...). before, after: their log intensity; trust_before,
    trust_after: precision 1/R per second; total: signed contrast of the events between them; gain:
    factor from that contrast to the frames' difference; blend: 1 where the next frame is known,
    else 0."""

    before: Values
    after: Values
    trust_before: Values
    trust_after: Values
    total: Values
    gain: Values
    blend: Values


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Step:
    """An event. dt_s: since the pixel's last update; share: elapsed share of the frame interval;
    contrast, variance: that it adds. All 0 is no event."""

    dt_s: Values
    share: Values
    contrast: Values
    variance: Values


def relax(
    pixel: Pixel, reference: Reference, dt_s: Values, share: Values, process: float,
    logarithm: Logarithm,
) -> Pixel:
    """A pixel dt_s after its last update; reference as at the end of that time."""
    share = share * reference.blend
    forward = reference.before + reference.gain * pixel.since
    backward = reference.after - reference.gain * (reference.total - pixel.since)
    blended = (1.0 - share) * logarithm.dn(forward) + share * logarithm.dn(backward)
    y = jnp.where(share > 0, logarithm.of(blended), forward)
    trust = (1.0 - share) * reference.trust_before + share * reference.trust_after
    kept = 1.0 / (1.0 + pixel.variance * trust * dt_s)
    return dataclasses.replace(pixel, x=y + (pixel.x - y) * kept,
                               variance=pixel.variance * kept + process * dt_s)


@partial(jax.jit, static_argnames=("process", "logarithm"))
def _follow(
    pixel: Pixel, reference: Reference, steps: Step, process: float, logarithm: Logarithm
) -> Pixel:
    """Pixels (N,) through their events, steps (N, L)."""
    def event(pixel: Pixel, reference: Reference, step: Step) -> Pixel:
        moved = relax(pixel, reference, step.dt_s, step.share, process, logarithm)
        return Pixel(moved.x + step.contrast, moved.variance + step.variance,
                     moved.since + step.contrast)

    def one(pixel: Pixel, reference: Reference, steps: Step) -> Pixel:
        return jax.lax.scan(lambda p, s: (event(p, reference, s), None), pixel, steps)[0]

    return jax.vmap(one)(pixel, reference, steps)


_relax = jax.jit(relax, static_argnames=("process", "logarithm"))


@dataclasses.dataclass(frozen=True)
class Akf(Reconstructor):
    """Asynchronous Kalman filter, with published parameters but for the logarithm (theirs is
    Logarithm(255, "log"), in which steps are a third of ours in mid-grey) and the trust between two
    frames: the mean of both precisions instead of blended variances.

    reference: "between" (published) or "latest", which uses no later frame.
    process, isolated, refractory: variance per second since a pixel's last update, since the last
    event in its 3x3 pixels, and since its own last event where that is at most refractory_us ago.
    variance: of the first frame. trust: factor on 1/R.
    """

    reference: Literal["between", "latest"] = "between"
    process: float = 0.005
    isolated: float = 0.03
    refractory: float = 0.05
    refractory_us: int = 10_000
    variance: float = 0.09
    trust: float = 1.0

    def log_images(
        self, events: Events, frames: np.ndarray, frame_times: np.ndarray, camera: Camera,
        times: np.ndarray,
    ) -> np.ndarray:
        frames, frame_times, theta, times = checked(events, frames, frame_times, camera, times)
        width, height = events.size
        noise = self._event_variance(events)
        start = np.full(height * width, float(self.logarithm.of(self.start_dn)), np.float32)
        pixel = Pixel(start, np.full_like(start, self.variance), np.zeros_like(start))
        reference, frame = self._blind(start), -1
        images = np.zeros((len(times), height, width), np.float32)
        updated: np.ndarray | None = None
        for part in segments(events, frame_times, times):
            span = _span(frame_times, frame)
            updated = np.full(start.size, part.begin_us) if updated is None else updated
            if part.frame >= 0:
                pixel = self._relaxed(pixel, reference, part.begin_us, updated, span)
                frame, updated = part.frame, np.full(start.size, part.begin_us)
                span = _span(frame_times, frame)
                reference = self._reference(events, frames, frame_times, theta, frame)
                known = Pixel(reference.before, np.full_like(start, self.variance), start)
                pixel = dataclasses.replace(
                    known if frame == 0 else pixel, since=np.zeros_like(start))
            pixel = self._through(pixel, reference, events, part, theta, noise, updated, span)
            if part.images:
                seen = self._relaxed(pixel, reference, part.end_us, updated, span)
                images[part.images] = seen.x.reshape(height, width)
        return images

    def _event_variance(self, events: Events) -> np.ndarray:
        """Q of every event (N,) float32."""
        near, own = since_last(events)
        width, height = events.size
        fast = own <= 1e-6 * self.refractory_us
        q = self.isolated * near + np.where(fast, self.refractory * np.where(fast, own, 0.0), 0.0)
        inside = ((events.x > 0) & (events.x < width - 1)
                  & (events.y > 0) & (events.y < height - 1))
        return np.where(inside, q, BORDER_VARIANCE).astype(np.float32)

    def _blind(self, start: np.ndarray) -> Reference:
        """The reference before the first frame, of no precision."""
        zero = np.zeros_like(start)
        return Reference(start, start, zero, zero, zero, zero + 1, zero)

    def _reference(
        self, events: Events, frames: np.ndarray, frame_times: np.ndarray, theta: np.ndarray,
        frame: int,
    ) -> Reference:
        """The reference for the interval after `frame`."""
        before, trust = self._shown(frames[frame])
        zero = np.zeros_like(before)
        if self.reference == "latest" or frame + 1 == len(frames):
            return Reference(before, before, trust, trust, zero, zero + 1, zero)
        after, trust_after = self._shown(frames[frame + 1])
        first, last = np.searchsorted(events.t, frame_times[frame:frame + 2], side="right")
        pixel, contrast = steps_of(events, slice(int(first), int(last)), theta)
        total = np.bincount(pixel, contrast, before.size).astype(np.float32)
        change = after - before
        ratio = total / np.where(change == 0, 1, change)
        low, high = SCALE_RANGE
        scale = np.where((change != 0) & (ratio > low) & (ratio < high), ratio, 1.0)
        return Reference(before, after, trust, trust_after, total,
                         (1.0 / scale).astype(np.float32), zero + 1)

    def _shown(self, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log intensity and precision per second (H*W,) of a frame."""
        dn = frame.ravel().astype(np.float32)
        certainty = np.maximum(1.0 - np.abs(2.0 * dn / 255.0 - 1.0) ** SHARPNESS, LEAST_CERTAINTY)
        per_log = 255.0 * np.asarray(self.logarithm.slope(dn))
        return np.asarray(self.logarithm.of(dn)), self.trust * PRECISION * certainty / (
            per_log * per_log)

    def _relaxed(
        self, pixel: Pixel, reference: Reference, now_us: int, updated: np.ndarray,
        span: tuple[int, int],
    ) -> Pixel:
        """State of all pixels at now_us; the filter itself is not advanced."""
        dt_s = ((now_us - updated) * 1e-6).astype(np.float32)
        share = np.full_like(dt_s, (now_us - span[0]) / (span[1] - span[0]))
        return jax.device_get(
            _relax(pixel, reference, dt_s, share, self.process, self.logarithm))

    def _through(
        self, pixel: Pixel, reference: Reference, events: Events, part: Segment,
        theta: np.ndarray, noise: np.ndarray, updated: np.ndarray, span: tuple[int, int],
    ) -> Pixel:
        """State after the events of a segment; `updated` (H*W,) us is brought up to date."""
        where, contrast = steps_of(events, part.events, theta)
        order = np.argsort(where, kind="stable")
        where, t = where[order], events.t[part.events][order]
        share = ((t - span[0]) / (span[1] - span[0])).astype(np.float32)
        first = np.diff(where, prepend=-1) != 0
        dt_us = np.where(first, t - updated[where], np.diff(t, prepend=0))
        columns = Step((dt_us * 1e-6).astype(np.float32), share,
                       contrast[order].astype(np.float32), noise[part.events][order])
        updated[where] = t  # the last of equal pixels is kept
        state = jax.tree.map(np.array, pixel)
        for pixels, rows, inside in _batches(where):
            steps = jax.tree.map(
                lambda c, rows=rows, inside=inside: np.where(inside, c[rows], 0), columns)
            mine = jax.tree.map(lambda a, pixels=pixels: a[pixels], (state, reference))
            moved = _follow(*mine, steps, self.process, self.logarithm)
            real = inside[:, 0]
            for into, new in zip(jax.tree.leaves(state), jax.tree.leaves(moved), strict=True):
                into[pixels[real]] = np.asarray(new)[real]
        return state


def _span(frame_times: np.ndarray, frame: int) -> tuple[int, int]:
    """Begin and end of the interval after a frame; after the last one, any nonempty interval."""
    inside = 0 <= frame < len(frame_times) - 1
    return (int(frame_times[frame]), int(frame_times[frame + 1])) if inside else (0, 1)


def _batches(where: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Pixels with similar numbers of events, LANES at a time: pixels (LANES,), indices (LANES, L)
    of their events in `where` (N,) sorted pixels, and (LANES, L) bool: which indices are valid."""
    pixels, start, count = np.unique(where, return_index=True, return_counts=True)
    length = 1
    while len(pixels):
        now = count <= length
        for at in range(0, int(now.sum()), LANES):
            chosen = np.flatnonzero(now)[at:at + LANES]
            missing = (0, LANES - len(chosen))
            row = np.pad(start[chosen], missing)[:, None] + np.arange(length)
            inside = np.arange(length) < np.pad(count[chosen], missing)[:, None]
            yield np.pad(pixels[chosen], missing), np.where(inside, row, 0), inside
        pixels, start, count = (a[~now] for a in (pixels, start, count))
        length *= GROWTH


def since_last(events: Events) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (N,) since the last event before each in its 3x3 pixels, and of its own pixel; since
    the first event of all where there was none, and inf for its own."""
    n, (width, height) = len(events), events.size
    if n == 0:
        return np.zeros(0), np.zeros(0)
    x, y = events.x.astype(np.int64), events.y.astype(np.int64)
    number = np.arange(n)
    place = y * width + x
    order = np.argsort(place, kind="stable")
    keys = place[order] * n + order  # a pixel's events, in order of time
    latest = np.full(n, -1)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            there = (y + dy) * width + x + dx
            found = np.searchsorted(keys, there * n + number) - 1
            inside = (x + dx >= 0) & (x + dx < width) & (y + dy >= 0) & (y + dy < height)
            inside &= (found >= 0) & (place[order[found]] == there)
            seen = np.where(inside, order[found], -1)
            latest = np.maximum(latest, seen)
            if dx == dy == 0:
                own = np.where(inside, (events.t - events.t[seen]) * 1e-6, np.inf)
    return (events.t - events.t[np.maximum(latest, 0)]) * 1e-6, own
