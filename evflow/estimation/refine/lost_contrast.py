"""Contrast that pixels lose in their dead time, by which thresholds come out too high.

Three kinds of pixel have a dead time. v2e's keeps what changes meanwhile, and fires for it
afterwards. ESIM's drops the events that fall into it, but its memory follows; if that is taken out
of the path, the pooled regression (receptor_regression.py) explains more. One whose amplifier is
held in reset (Lichtsteiner et al. 2008; Deblur e-NeRF) begins anew at its end (held_in_reset.py).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from evflow.camera.sensors import DeadContrast
from evflow.estimation.refine.fine_steps import later
from evflow.estimation.refine.held_in_reset import Anew, held_in_reset
from evflow.estimation.refine.receptor_data import Sample, one_stretch
from evflow.estimation.refine.receptor_noise import path_of
from evflow.estimation.refine.receptor_regression import Regression
from evflow.estimation.refine.receptor_result import Found
from evflow.estimation.refine.receptor_search import BELIEVED, find
from evflow.simulator.photoreceptor import FAST, Photoreceptor

Array = np.ndarray

# Log odds required against a pixel that keeps its contrast, and of changes from event to event by
# themselves: of 89 simulated cameras that keep theirs one has more than the first, 10.
CLEARLY, SURELY = 6.0, 12.0
# A pixel that begins anew needs a threshold's worth of change after its dead time, which is
# therefore a part of its shortest intervals: these parts are tried, and then those about the best.
COARSE, FINE = np.array([0.25, 0.5, 0.75, 1.0]), np.arange(-0.2, 0.21, 0.05)
# An offset or a delay of the frames may explain as much as a loss. It is a loss if more than this
# share of the path changes by a threshold in this part of the shortest intervals: of 128 simulated
# cameras that lose nothing .001 (.012 where little happens), of 13 that do .006 and more.
MISSING, FASTER = 0.005, 0.7
OPAQUE = 0.3  # unexplained share from which the path is too wrong for that, or for a reset
LACKING = 0.75  # contrast that the path of a pixel held in reset loses, by what stays unexplained
# Intervals are longer than this where a pixel hardly has two events. They say nothing of a dead
# time, but some loss may well seem to explain so few:
TOO_LONG_S = 1e-2
# Relative error of the dead time: of 36 cameras that are held in reset for 1 to 4 ms, the root of
# the mean square.
DEAD_ERROR = {"resets": 0.16, "drops": 0.02, "keeps": 0.02}
NEGLIGIBLE = 0.02  # log units of a threshold, less than what is known of it
LEAST = 1e-3  # log units, of a threshold
ROUNDS = 3  # of thresholds and whole events lost, each from the other
# Of 49 simulated cameras, in logarithms: error of the correction by its size; of the regression
# itself, whose path is smoother than the light; and of either by the share that its path leaves
# unexplained. Each is far off in other scenes than the other.
SHARE_ERROR, OWN_ERROR, PATH_ERROR = 0.4, 0.06, 0.7


@dataclasses.dataclass(frozen=True, eq=False)
class Lost:
    """law: how the contrast is lost, "keeps" if it is sent later, some of it never; dead_s: the
    dead time in seconds; excess: (2,) factors by which theta_on and theta_off
    come out too high if it is taken as sent; theta: (2,) of the regression without that
    contrast; unexplained: the share that this leaves unexplained."""

    law: DeadContrast
    dead_s: float
    excess: Array
    theta: Array
    unexplained: float

    @property
    def std_s(self) -> float:
        """Error of the dead time."""
        return DEAD_ERROR[self.law] * self.dead_s

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
        path = (PATH_ERROR * self.unexplained) ** 2
        variance = stated**2 + (SHARE_ERROR * np.log(excess)) ** 2 + path
        own_variance = OWN_ERROR**2 + path
        both = variance + own_variance
        value = float(np.exp((own_variance * divided + variance * own) / both))
        apart = max(1.0, float(divided - own) ** 2 / both)
        error = value * float(np.sqrt(apart * variance * own_variance / both))
        return value, error if np.isfinite(std) else std


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
        lost; if it is kept, `found` with the errors of thresholds that may lose it after all, and
        None.
    """
    if shortest_s > TOO_LONG_S:
        return found, None
    again, lost = (_dropped(data, found, edge_s) if edge_s else _reset(data, found, shortest_s))
    if lost is not None and np.abs(np.log(lost.excess)).max() < NEGLIGIBLE:
        return found, None
    return again, lost


def _reset(data: Sample, found: Found, shortest_s: float) -> tuple[Found, Lost | None]:
    """`lost_contrast` of pixels that begin anew. The dead time is that of the changes from event to
    event, unless the path is too wrong for them; the thresholds are those of sums over a pixel's
    events, as far as these tell of a loss."""
    ways = _receptors(found)
    clear = found.unexplained < OPAQUE
    anew = held_in_reset(data, ways, shortest_s) if clear else None
    odds = _size(found) * anew.gain if anew else 0.0
    near = _best(way for seen_by in ways
                 for way in _resets(data, seen_by, shortest_s * COARSE))
    if not clear or odds >= CLEARLY:
        again, lost = _reset_by_sums(data, found, near, shortest_s)
        if lost is not None:
            return again, dataclasses.replace(lost, dead_s=anew.dead_s) if anew else lost
    if anew is not None and odds >= SURELY and np.min([anew.theta, anew.kept]) > LEAST:
        if anew.seen_by != found.used:
            found = dataclasses.replace(found, chance=1.0 - found.chance)
        theta = anew.theta / (1.0 - LACKING * found.unexplained)
        return found, Lost(
            "resets", anew.dead_s, anew.kept / anew.theta, theta, found.unexplained)
    return _open(data, found, near, anew), None


def _reset_by_sums(
    data: Sample, found: Found, near: Way, shortest_s: float
) -> tuple[Found, Lost | None]:
    """The same by the pooled regression alone. near: the best of COARSE."""
    if _size(found) * near.gain < CLEARLY:
        return found, None
    finer = near.dead_s + FINE * shortest_s
    return _without_loss(
        data, found, "resets", _best(_resets(data, near.seen_by, finer[finer > 0])), shortest_s)


def _dropped(data: Sample, found: Found, edge_s: float) -> tuple[Found, Lost | None]:
    """`lost_contrast` of pixels that drop events."""
    best = _best(_drops(data, seen_by, edge_s) for seen_by in _receptors(found))
    again, lost = found, None
    if _size(found) * best.gain >= CLEARLY:
        again, lost = _without_loss(data, found, "drops", best, edge_s)
    return (again, lost) if lost is not None else (_open(data, found, best), None)


def _open(data: Sample, found: Found, sums: Way, anew: Anew | None = None) -> Found:
    """`found`, with the errors of its thresholds by a loss that is not certain enough to be taken
    out: the larger of that by sums and of that from event to event."""
    kept, theta = (_solved(some, sums.seen_by)[0] for some in (data, sums.data))
    tried = [(sums.gain, kept, theta)]
    if anew is not None:
        tried.append((anew.gain, anew.kept, anew.theta))
    errors = np.zeros(2)
    for gain, kept, theta in tried:
        if np.min([kept, theta]) > LEAST:
            chance = 0.5 + 0.5 * np.tanh(0.5 * (_size(found) * gain - CLEARLY))
            errors = np.maximum(errors, np.sqrt(chance) * np.abs(np.log(kept / theta)))
    return dataclasses.replace(found, loss_open=errors)


def _without_loss(
    data: Sample, found: Found, law: DeadContrast, way: Way, shortest_s: float
) -> tuple[Found, Lost | None]:
    """The search without what is lost, if that explains more, or must be lost."""
    again = find(way.data)
    if again is None:
        return found, None
    before, after = found.unexplained, again.unexplained
    if _size(found) * np.log(before / after) < CLEARLY and not (
            before < OPAQUE and _too_fast(data, found, FASTER * shortest_s) > MISSING):
        return found, None
    taken_as_kept, theta = (_solved(some, again.used)[0] for some in (data, way.data))
    if not np.min([theta, taken_as_kept]) > LEAST:
        return found, None
    excess = taken_as_kept / theta
    return (dataclasses.replace(again, theta=again.theta * excess,
                                ideal_theta=again.ideal_theta * excess),
            Lost(law, way.dead_s, excess, theta, after))


def _receptors(found: Found) -> list[Photoreceptor]:
    """Those that are tried: what was found may only imitate the loss."""
    return list(dict.fromkeys((found.ideal, found.used)))


def _size(found: Found) -> float:
    """Of independent events, half of them, for log odds."""
    return 0.5 * min(found.size, BELIEVED)


class Way(NamedTuple):
    """A dead time, and a photoreceptor. gain: of the log of the share that is not explained; data:
    the sample with the contrast taken out that is lost."""

    gain: float
    dead_s: float
    seen_by: Photoreceptor
    data: Sample


def _best(ways: Iterable[Way]) -> Way:
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


def _drops(data: Sample, seen_by: Photoreceptor, dead_s: float) -> Way:
    theta, kept = _solved(data, seen_by)
    for _ in range(ROUNDS):
        taken_out = _without(data, seen_by, dead_s, np.maximum(np.abs(theta), LEAST))
        theta, left = _solved(taken_out, seen_by)
    return Way(kept - left, dead_s, seen_by, taken_out)


def _resets(data: Sample, seen_by: Photoreceptor, dead_s: Array) -> Iterator[Way]:
    _, kept = _solved(data, seen_by)
    for seconds in dead_s.tolist():
        taken_out = _without(data, seen_by, seconds)
        yield Way(kept - _solved(taken_out, seen_by)[1], seconds, seen_by, taken_out)


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
    dt_s, path = d.dt_s, path_of(d, seen_by)
    used = np.flatnonzero(d.weight > 0)
    pixel = np.asarray(d.pixel)[used]
    at = np.minimum(later(d.at[used], dt_s, -seen_by.delay_s), len(path) - 1 - 1e-3)

    def light(when: Array) -> Array:
        step = when.astype(np.int64)
        before, after = path[step, pixel], path[step + 1, pixel]
        return before + (when - step) * (after - before)

    first = np.diff(pixel, prepend=-1) != 0
    last = np.where(first, at, np.roll(at, 1))
    change = light(np.minimum(later(last, dt_s, dead_s), at)) - light(last)
    if theta is not None:
        each = np.where(change > 0, *theta)
        change = np.trunc(change / each) * each
    total = np.cumsum(change)
    lost = np.zeros(len(d.weight), np.float32)
    lost[used] = total - total[np.maximum.accumulate(np.where(first, np.arange(len(at)), 0))]
    return lost
