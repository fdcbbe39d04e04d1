"""Which logarithm pixels have in dim light, and what is left open of it.

The maps differ below some 20 DN alone, where lin-log is linear. A step of light between two levels
of which one is darker is explained by either, with thresholds that differ twofold.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.camera.sensors import LogMap
from evflow.estimation.refine.receptor_data import Sample
from evflow.estimation.refine.receptor_descent import (
    BELIEVED,
    BY_OFFSET,
    OFFSET,
    PLAIN,
    descend,
    effective_size,
    minus_log,
    receptor,
    start,
    without_offset,
    worth,
)
from evflow.estimation.refine.receptor_noise import split_at_noise
from evflow.estimation.refine.receptor_prior import small_sample_odds
from evflow.estimation.refine.receptor_regression import Regression
from evflow.estimation.refine.receptor_result import OtherMap
from evflow.light.log_maps import LINLOG_KNEE
from evflow.simulator.photoreceptor import Photoreceptor

DARK = 0.01  # share of light that may lie below lin-log's knee, from which the maps are compared
BLACK = 16.0  # DN of black level that may hide such light
SHOWN = 0.01  # share of light that may be darker than a black level
# Log odds required for another map than lin-log, beside those of a small sample: where lin-log is
# right, the other gained .4 at most in 63 recordings of 1 s, 3 in 31 small ones of .2 s.
OTHER_MAP = 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class Begun:
    """A search with one log map: its regression, most probable constants (3,), and the effective
    number of events."""

    model: Regression
    phi: np.ndarray
    size: float


def with_map(data: Sample) -> tuple[Begun, Begun | None] | None:
    """The search with the more probable log map, and the other one where light is dim enough for
    them to differ; None where no threshold follows from the sample. An offset may not be a black
    level above what the frames show: log_eps less an offset is much like lin-log in dim light."""
    begun, light = _begin(data, "linlog"), _light(data)
    if begun is None or (light < LINLOG_KNEE + BLACK).mean() < DARK:
        return None if begun is None else (begun, None)
    other = _begin(data, "log_eps", np.where(OFFSET, 0.0, begun.phi))
    if other is None:
        return begun, None
    if other.phi[0] < -np.quantile(light, SHOWN):
        shown = np.where(OFFSET, 0.0, other.phi)
        other = dataclasses.replace(other, phi=descend(shown, other.model, other.size, ~OFFSET))
    size = worth(other.phi, other.model, min(begun.size, BELIEVED))
    gain = _gain(begun.model, begun.phi, other.model, other.phi, size)
    return (other, begun) if gain > OTHER_MAP + small_sample_odds(data) else (begun, other)


def left_open(
    model: Regression, at: np.ndarray, other: Begun | None, size: float
) -> OtherMap | None:
    """The log map that was not taken.

    Args:
        model, at: of what was taken: `PLAIN` for an ideal pixel.
        other: the search with the other map.
        size: effective number of events that count as evidence.

    Returns:
        Its probability, if the two are equally likely beforehand and, as elsewhere, an offset has
        to be BY_OFFSET more likely than none, and its thresholds beside those of the map that was
        taken, without an offset if it has none; None where there is no other map, or no thresholds
        by it.
    """
    if other is None:
        return None
    ideal = bool((at == PLAIN).all())
    there = PLAIN if ideal else without_offset(other.phi, other.model, size)
    alike = at
    if at[0] and not there[0]:  # what an offset changes is no matter of the map
        alike = descend(np.where(OFFSET, 0.0, at), model, size, ~OFFSET)
    theta, taken = other.model.solved(there)[0], model.solved(alike)[0]
    if min(theta.min(), taken.min()) <= 0:
        return None
    gain = _gain(model, at, other.model, there, worth(there, other.model, size))
    gain += BY_OFFSET * (float(at[0] != 0) - float(there[0] != 0))
    return OtherMap(1.0 / (1.0 + np.exp(np.clip(-gain, 0.0, 50.0))), theta / taken)


def _gain(
    model: Regression, at: np.ndarray, other: Regression, there: np.ndarray, size: float
) -> float:
    """Log odds of the other map's constants against these. Each divides the events at noise in its
    own way, and the other must be the better with both: what is divided more finely is explained
    better by any map."""
    return min(minus_log(at, dataclasses.replace(model, data=divided), size)
               - minus_log(there, dataclasses.replace(other, data=divided), size)
               for divided in (other.data, model.data))


def _light(data: Sample) -> np.ndarray:
    """The light (N,) in DN of the used pixels, over time."""
    stretches = zip(*map(np.asarray, (data.dn, data.pixel, data.weight)), strict=True)
    return np.concatenate([
        dn[:, np.unique(pixel[weight > 0])].ravel() for dn, pixel, weight in stretches])


def _begin(
    data: Sample, log_map: LogMap, *near: np.ndarray
) -> Begun | None:
    """The search with one map. near: places to search from, beside the best of the grid."""
    ideal = Photoreceptor(log_map=log_map)
    model = Regression(split_at_noise(data, ideal), log_map=log_map)
    if not model.determines():
        return None
    starts = [start(model), *near]
    for _ in range(2):
        size = effective_size(starts[0], model)
        phi = min((descend(start, model, size) for start in starts),
                  key=lambda at: minus_log(at, model, size))
        starts = [phi]
        theta = np.abs(model.solved(phi)[0])
        divided = dataclasses.replace(
            model, data=split_at_noise(data, receptor(phi, model), theta))
        model = divided if divided.determines() else model
    return Begun(model, phi, size)
