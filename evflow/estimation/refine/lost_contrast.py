"""Contrast that pixels lose in their dead time, by which thresholds come out too high.

Three kinds of pixel have a dead time. v2e's keeps what changes meanwhile, and fires for it
afterwards. ESIM's drops the events that fall into it, but its memory follows. One whose amplifier
is held in reset (Lichtsteiner et al. 2008; Deblur e-NeRF) begins anew at its end. If the path's
changes within the dead times are taken out as the right kind loses them, the pooled regression
(receptor_regression.py) explains most.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.camera.sensors import DeadContrast, SensorModel
from evflow.estimation.refine.receptor_data import Sample, one_stretch
from evflow.estimation.refine.receptor_noise import path_of
from evflow.estimation.refine.receptor_regression import Regression
from evflow.estimation.refine.receptor_result import Found
from evflow.estimation.refine.receptor_search import BELIEVED, find
from evflow.simulator.counts import simulate_counts
from evflow.simulator.photoreceptor import FAST, Photoreceptor

Array = np.ndarray

CLEARLY = 6.0  # log odds required against a pixel that keeps its contrast
# A pixel that begins anew needs a threshold's worth of change after its dead time, which is
# therefore a part of its shortest intervals: these parts are tried, and then those about the best.
COARSE, FINE = (0.25, 0.5, 0.75, 1.0), np.arange(-0.2, 0.21, 0.05)
# An offset or a delay of the frames may explain as much as a loss. It is a loss if more than this
# share of the path changes by a threshold in this part of the shortest intervals: of 128 simulated
# cameras that lose nothing .001 (.012 where little happens), of 13 that do .006 and more.
MISSING, FASTER = 0.005, 0.7
OPAQUE = 0.3  # unexplained share from which the path is too wrong for that
# Intervals are longer than this where a pixel hardly has two events. They say nothing of a dead
# time, but some loss may well seem to explain so few:
TOO_LONG_S = 1e-2
# Relative error of the dead time: of 32 cameras that are held in reset for 1 to 4 ms 69 % lie
# within it, and 97 % within twice as much.
DEAD_ERROR = {"resets": 0.21, "drops": 0.02, "keeps": 0.02}
NEGLIGIBLE = 0.02  # log units of a threshold, less than what is known of it
LEAST = 1e-3  # log units, of a threshold
WAITED, HARDLY = 1.05, 1e-4  # of the dead time; of a weight
DARKEST = -6.9  # log units below the brightest, that a simulation of the log map log_eps takes
ENOUGH = 100  # events of a polarity, that such a simulation must send
SOLVED = 6  # steps towards the thresholds of as many events
ROUNDS = 3  # of thresholds and whole events lost, each from the other
# Of 25 cameras, in logarithms: error of the correction by its size, and of the regression itself,
# whose path is smoother than the light. Each is far off in other scenes than the other.
SHARE_ERROR, OWN_ERROR = 0.4, 0.06


@dataclasses.dataclass(frozen=True, eq=False)
class Lost:
    """law: how the contrast is lost, "keeps" if it is sent later, some of it never; dead_s: the
    dead time in seconds, and std_s its error; excess: (2,) factors by which theta_on and theta_off
    come out too high if it is taken as sent; theta: (2,) of the regression without that
    contrast."""

    law: DeadContrast
    dead_s: float
    std_s: float
    excess: Array
    theta: Array

    def corrected(self, polarity: int, theta: float, std: float) -> tuple[float, float]:
        """A threshold that took contrast as kept, and its std, as they are: the mean, weighted by
        precision, of that divided by its excess, and of the regression's own. Where both disagree
        by more than their errors, these are taken as too small."""
        excess = float(self.excess[polarity])
        if self.law == "keeps":
            error = np.hypot(std, SHARE_ERROR * np.log(excess) * theta)
            return theta / excess, float(error) / excess
        divided, own = np.log(theta / excess), np.log(float(self.theta[polarity]))
        stated = std / theta if np.isfinite(std) else OWN_ERROR  # not all weights state one
        variance, own_variance = stated**2 + (SHARE_ERROR * np.log(excess)) ** 2, OWN_ERROR**2
        both = variance + own_variance
        value = float(np.exp((own_variance * divided + variance * own) / both))
        apart = max(1.0, float(divided - own) ** 2 / both)
        error = value * float(np.sqrt(apart * variance * own_variance / both))
        return value, error if np.isfinite(std) else std


def kept_contrast(data: Sample, found: Found, dead_s: float) -> Lost | None:
    """How many events fewer pixels send that keep the contrast of their dead time: ON and OFF of it
    may cancel, and what is owed at last is never sent. None if that is negligible, or unknown: too
    few events, or thresholds that are none."""
    if not np.min(found.theta) > LEAST:
        return None
    excess = np.ones(2)
    dead, free = (SensorModel(log_map="log_eps", refractory_s=s) for s in (dead_s, 0.0))
    paths = []
    for c in range(len(data.dn)):
        d = one_stretch(data, c)
        path = path_of(d, found.used)
        paths.append((np.maximum(path - path.max(), DARKEST), float(np.mean(d.dt_s))))
    sent = _counted(paths, found.theta, dead)
    if sent.min() < ENOUGH:
        return None
    for _ in range(SOLVED):
        more = _counted(paths, found.theta * excess, free) / sent
        excess = np.maximum(excess * more**0.7, 1.0)
    if np.abs(np.log(excess)).max() < NEGLIGIBLE:
        return None
    return Lost("keeps", dead_s, DEAD_ERROR["keeps"] * dead_s, excess, found.theta)


def _counted(paths: list[tuple[Array, float]], theta: Array, model: SensorModel) -> Array:
    """(2,) ON and OFF events of pixels with these thresholds, along paths (T, N), and their
    steps in seconds."""
    total, unused = np.zeros(2), jax.random.key(0)  # there is no noise
    for path, dt_s in paths:
        camera = Camera.constant((path.shape[1], 1), *map(float, theta))
        counts = simulate_counts(unused, path[:, :, None].astype(np.float32), camera,
                                 frame_dt_s=dt_s, model=model)
        total += np.asarray(counts).sum((0, 1))
    return total


def without_waiting(data: Sample, dead_s: float) -> Sample:
    """The sample with hardly any weight of events as soon after the pixel's last as its dead time
    allows: v2e's pixel sends them late, when its light has gone on. They still count as sent."""
    weight = np.array(data.weight)
    for c, dt_s in enumerate(np.asarray(data.dt_s)):
        used = np.flatnonzero(weight[c] > 0)
        pixel, at = (np.asarray(v)[c, used] for v in (data.pixel, data.at))
        after = np.diff(at, prepend=-np.inf) * dt_s.mean()
        waited = (np.diff(pixel, prepend=-1) == 0) & (after < WAITED * dead_s)
        weight[c, used[waited]] *= HARDLY
    return data._replace(weight=jnp.asarray(weight))


def lost_contrast(
    data: Sample, found: Found, shortest_s: float, edge_s: float = 0.0
) -> tuple[Found, Lost | None]:
    """Whether and how pixels lose contrast in their dead time.

    Args:
        data: the sample in which the photoreceptor was searched for.
        found: that search, for pixels that keep their contrast.
        shortest_s: a pixel's shortest usual intervals, in seconds.
        edge_s: where they abruptly become many, as where it is the dead time of pixels that drop
            events; else 0.

    Returns:
        The search for pixels as they are, with thresholds as if contrast were kept, and how it is
        lost; `found` and None if it is kept.
    """
    if shortest_s > TOO_LONG_S:
        return found, None
    size = 0.5 * min(found.size, BELIEVED)
    tried = [way for seen_by in dict.fromkeys((found.ideal, found.used))
             for way in _ways(data, seen_by, shortest_s, edge_s)]
    if size * _best(tried).gain < CLEARLY:
        return found, None
    drops, resets = ([way for way in tried if way.law == law] for law in ("drops", "resets"))
    near = _best(resets)
    finer = near.dead_s + FINE * shortest_s
    best = _best([*drops, *_resets(data, near.seen_by, finer[finer > 0])])
    again = find(best.data)
    if again is None:
        return found, None
    before, after = (1.0 - f.explained[int(f.needed)] for f in (found, again))
    if size * np.log(before / after) < CLEARLY and not (
            before < OPAQUE and _too_fast(data, found, FASTER * shortest_s) > MISSING):
        return found, None
    taken_as_kept, theta = (_solved(some, again.used)[0] for some in (data, best.data))
    if not np.min([theta, taken_as_kept]) > LEAST:
        return found, None
    excess = taken_as_kept / theta
    if np.abs(np.log(excess)).max() < NEGLIGIBLE:
        return found, None
    return (dataclasses.replace(again, theta=again.theta * excess,
                                ideal_theta=again.ideal_theta * excess),
            Lost(best.law, best.dead_s, DEAD_ERROR[best.law] * best.dead_s, excess, theta))


class Way(NamedTuple):
    """A way to lose contrast. gain: of the log of the share that is not explained; seen_by: the
    photoreceptor; data: the sample with that contrast taken out."""

    gain: float
    law: DeadContrast
    dead_s: float
    seen_by: Photoreceptor
    data: Sample


def _best(ways: Sequence[Way]) -> Way:
    return max(ways, key=lambda way: way.gain)


def _too_fast(data: Sample, found: Found, seconds: float) -> float:
    """Share of the path's change, in thresholds, that takes less than so long for each."""
    theta = np.maximum(found.theta if found.needed else found.ideal_theta, LEAST)
    sums = np.zeros(2)
    for c in range(len(data.dn)):
        d = one_stretch(data, c)
        path = path_of(d, found.used)[:, np.unique(d.pixel[d.weight > 0])]
        change = np.diff(path, axis=0)
        events = np.abs(change) / np.where(change > 0, *theta)
        fast = events * seconds > d.dt_s[:, None]
        sums += [events[fast].sum(), events.sum()]
    return float(sums[0] / max(sums[1], LEAST))


def _ways(
    data: Sample, seen_by: Photoreceptor, shortest_s: float, edge_s: float
) -> Iterator[Way]:
    if edge_s:
        yield _drops(data, seen_by, edge_s)
    yield from _resets(data, seen_by, np.array(COARSE) * shortest_s)


def _drops(data: Sample, seen_by: Photoreceptor, dead_s: float) -> Way:
    theta, kept = _solved(data, seen_by)
    for _ in range(ROUNDS):
        taken_out = _without(data, seen_by, dead_s, np.maximum(np.abs(theta), LEAST))
        theta, left = _solved(taken_out, seen_by)
    return Way(kept - left, "drops", dead_s, seen_by, taken_out)


def _resets(data: Sample, seen_by: Photoreceptor, dead_s: Array) -> Iterator[Way]:
    _, kept = _solved(data, seen_by)
    for seconds in dead_s.tolist():
        taken_out = _without(data, seen_by, seconds)
        yield Way(kept - _solved(taken_out, seen_by)[1], "resets", seconds, seen_by, taken_out)


def _solved(data: Sample, seen_by: Photoreceptor) -> tuple[Array, float]:
    """theta (2,) of the regression, and the log of the share that it does not explain."""
    model = Regression(data, seen_by.by_light, seen_by.log_map)
    phi = np.array([seen_by.offset_dn, max(seen_by.tau_s, FAST), seen_by.delay_s])
    return model.solved(phi)[0], model.unexplained(phi)


def _without(
    data: Sample, seen_by: Photoreceptor, dead_s: float, theta: Array | None = None
) -> Sample:
    """The sample whose `lost` is the path's change within dead_s after each event so far; theta:
    (2,) where whole events are dropped, so that it is a multiple of the thresholds."""
    rows = [_lost(one_stretch(data, c), seen_by, dead_s, theta) for c in range(len(data.dn))]
    return data._replace(lost=jnp.asarray(np.stack(rows)))


def _lost(d: Sample, seen_by: Photoreceptor, dead_s: float, theta: Array | None) -> Array:
    """(N,) of one stretch."""
    step_s, path = float(np.mean(d.dt_s)), path_of(d, seen_by)
    used = np.flatnonzero(d.weight > 0)
    pixel = np.asarray(d.pixel)[used]
    at = np.clip(np.asarray(d.at, np.float64)[used] - seen_by.delay_s / step_s,
                 0.0, len(path) - 1 - 1e-3)

    def light(when: Array) -> Array:
        step = when.astype(np.int64)
        before, after = path[step, pixel], path[step + 1, pixel]
        return before + (when - step) * (after - before)

    first = np.diff(pixel, prepend=-1) != 0
    last = np.where(first, at, np.roll(at, 1))
    change = light(np.minimum(last + dead_s / step_s, at)) - light(last)
    if theta is not None:
        each = np.where(change > 0, *theta)
        change = np.trunc(change / each) * each
    total = np.cumsum(change)
    lost = np.zeros(len(d.weight), np.float32)
    lost[used] = total - total[np.maximum.accumulate(np.where(first, np.arange(len(at)), 0))]
    return lost
