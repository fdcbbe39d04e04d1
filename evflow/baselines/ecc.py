"""ECC: thresholds by least squares of frame differences on event counts.

Wang, Ng, van Goor, Mahony, "Event Camera Calibration of Per-pixel Biased Contrast Threshold"
(ACRA 2019). An event of sign s changes log intensity by s c + b, so theta_ON = c + b and
theta_OFF = c - b, and a frame difference over `span` frames is c dP + b dE with P = n_ON - n_OFF
and E = n_ON + n_OFF. The same equations read dL = theta_ON n_ON - theta_OFF n_OFF. They are solved
in that form, in which events of one polarity suffice to determine its threshold.
"""

from __future__ import annotations

import collections
import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from evflow.baselines.base import UNKNOWN, Solution, System, constant, intervals, usable
from evflow.camera import THETA_MIN
from evflow.errors import EvflowDataError
from evflow.estimation.refine.trace import trace_of_events
from evflow.light.logarithm import LIN_LOG, Logarithm
from evflow.types import Recording

Array = jax.Array

SPAN = 40  # frames between the ends of a difference, as published
DEFAULT = 0.1  # log units: the published value of an undetermined pixel
THETA_TOP = 1.0  # log units: thresholds are clipped to [.01, 1]
STILL = 0.93  # share of frame differences of exactly 0, from which a pixel is not used
SINGULAR = 1e-6  # ratio of eigenvalues, the precision of float32 sums of products
ENOUGH = 3.0  # events of a polarity over all differences, for the fair reading


@dataclasses.dataclass(frozen=True)
class Ecc(System):
    """ECC of events and frames.

    reading: "pixel": each pixel by itself with the published rules (an undetermined one gets
        c = .1, b = 0); "median": the fair reading, for all pixels the median over those that
        determine a polarity; "global": one system of equations for all pixels.
    span: frames between the ends of a difference, at most half of the frames there are.
    offset_dn: log(DN + offset) in place of the lin-log map; published 40 to 100, with thresholds
        of a compressed brightness.
    """

    reading: Literal["pixel", "median", "global"] = "pixel"
    span: int = SPAN
    offset_dn: float = 0.0

    @property
    def logarithm(self) -> Logarithm:
        return Logarithm(self.offset_dn, "log") if self.offset_dn else LIN_LOG

    def solve(self, recording: Recording) -> Solution:
        span = max(1, min(self.span, len(usable(recording)) // 2))
        note = f"differences over {span} frames"
        width, height = recording.events.size
        sums = frame_sums(recording, span, self.logarithm)
        if self.reading == "global":
            theta, sound = _solve(sums.sum((1, 2), keepdims=True))
            return constant((height, width), np.asarray(theta)[:, 0, 0],
                            np.asarray(sound)[:, 0, 0], note)
        theta, determined = (np.asarray(a) for a in _solve(sums))
        if self.reading == "pixel":
            still = np.asarray(sums[5] >= STILL * sums[6])
            both = (determined.all(0) & ~still)[None]
            clipped = np.clip(theta, THETA_MIN, THETA_TOP)
            return Solution(np.where(both, clipped, DEFAULT),
                            both & (clipped == theta), notes=(note,))
        enough = np.asarray(sums[7:9]) >= ENOUGH
        valid = determined & enough & (theta > THETA_MIN) & (theta < THETA_TOP)
        found = np.asarray(valid.any((1, 2)))
        medians = [np.median(t[v]) if v.any() else UNKNOWN
                   for t, v in zip(theta, valid, strict=True)]
        medians_of = f"medians over {valid[0].sum()} and {valid[1].sum()} pixels"
        return constant((height, width), np.array(medians), found, note, medians_of)


@dataclasses.dataclass(frozen=True)
class EccEvents(System):
    """ECC of events alone: all pixels are assumed to see the same contrast, so that the width of a
    pixel's random walk of net counts is inverse to its threshold. Gives ratios; the median is .1.

    samples: number of times at which counts are read without frames.
    """

    samples: int = 40

    def solve(self, recording: Recording) -> Solution:
        events = recording.events
        if len(events) == 0:
            raise EvflowDataError("EV001", "the recording has no events.")
        times = recording.frame_times
        if len(times) < 3:
            times = np.linspace(events.t[0], events.t[-1] + 1, self.samples).round()
        c, b = _event_only(walk_sums(recording, np.asarray(times, np.int64)))
        bad = np.asarray(~(jnp.isfinite(c) & jnp.isfinite(b)) | (jnp.abs(c) > 1.0))
        theta = np.where(bad[None], DEFAULT, np.asarray(jnp.stack([c + b, c - b])))
        clipped = np.clip(theta, THETA_MIN, THETA_TOP)
        return Solution(clipped, ~bad[None] & (clipped == theta), notes=("ratios only",))


def frame_sums(recording: Recording, span: int, logarithm: Logarithm) -> Array:
    """Normal equations (9, H, W): sums of aa, ab, bb, ad, bd over differences of `span` frames
    (a, b: ON and OFF events, d: dL), number of d that are exactly 0, number of all, and largest
    numbers of ON and OFF events in one."""
    width, height = recording.events.size
    sums = jnp.zeros((9, height, width))
    past: collections.deque[tuple[np.ndarray, np.ndarray]] = collections.deque(maxlen=span + 1)
    counts = np.zeros((2, height, width), np.float32)
    for interval in intervals(recording, logarithm.of):
        if not interval.continues:
            past.clear()
            counts = np.zeros_like(counts)
            past.append((counts, interval.before))
        counts = counts + interval.counts
        past.append((counts, interval.after))
        if len(past) > span:
            (n0, l0), (n1, l1) = past[0], past[-1]
            sums = _add(sums, n1 - n0, l1 - l0)
    return sums


@jax.jit
def _add(sums: Array, n: Array, d: Array) -> Array:
    a, b = n
    terms = [a * a, a * b, b * b, a * d, b * d, (d == 0).astype(d.dtype), jnp.ones_like(d)]
    return jnp.concatenate([sums[:7] + jnp.stack(terms), jnp.maximum(sums[7:], n)])


@jax.jit
def _solve(sums: Array) -> tuple[Array, Array]:
    """theta (2, ...) and whether it is determined (2, ...): both polarities at full rank, one where
    only that one fired."""
    aa, ab, bb, ad, bd = sums[:5]
    root = jnp.sqrt((aa - bb) ** 2 + 4.0 * ab**2)
    full = (aa + bb - root) > SINGULAR * (aa + bb + root)
    det = jnp.where(full, aa * bb - ab**2, 1.0)
    both = jnp.stack([bb * ad - ab * bd, ab * ad - aa * bd]) / det[None]
    alone = jnp.stack([ad / jnp.where(aa > 0, aa, 1.0), -bd / jnp.where(bb > 0, bb, 1.0)])
    only = jnp.stack([(aa > 0) & (bb == 0), (bb > 0) & (aa == 0)])
    return jnp.where(full[None], both, alone), full[None] | only


def walk_sums(recording: Recording, times_us: np.ndarray) -> Array:
    """Sums (6, H, W) of 1, E, P, EE, EP, PP over the instants (T,): cumulative counts."""
    width, height = recording.events.size
    counts, sums = np.zeros((2, height, width), np.float32), jnp.zeros((6, height, width))
    sums = _walk(sums, jnp.asarray(counts))
    for i in range(len(times_us) - 1):
        counts = counts + np.asarray(
            trace_of_events(recording.events, times_us[i:i + 2], 1).counts)[0]
        sums = _walk(sums, jnp.asarray(counts))
    return sums


@jax.jit
def _walk(sums: Array, n: Array) -> Array:
    e, p = n[0] + n[1], n[0] - n[1]
    return sums + jnp.stack([jnp.ones_like(e), e, p, e * e, e * p, p * p])


@jax.jit
def _event_only(sums: Array) -> tuple[Array, Array]:
    """c and b (H, W): P = m E + d with residual r gives c = .1 median(r) / r and b = -c m; NaN
    where E never changes or r vanishes."""
    one, e, p, ee, ep, pp = sums
    see, sep, spp = ee - e * e / one, ep - e * p / one, pp - p * p / one
    m = sep / see
    r = jnp.sqrt(jnp.maximum(spp - m * sep, 0.0) / one)
    c = DEFAULT * jnp.nanmedian(jnp.where(r > 0, r, jnp.nan)) / r
    return c, -c * m
