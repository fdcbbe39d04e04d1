"""Whether a bench's pixels are logarithmic below 20 DN too, or linear there as v2e's.

Only levels of light below 20 DN differ. Under the right map the steps of a direction agree on one
threshold, whatever their sizes and levels.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from evflow.camera.sensors import LogMap
from evflow.light.log_maps import LINLOG_KNEE, lin_log, lin_log_inverse, log_dn
from evflow.notes import Note

CLEARLY = 0.5  # ratio of the scatters of two maps below which the smaller one is right
FLOOR = 0.01  # scatter that says nothing
NEGLIGIBLE = 0.03  # relative difference of thresholds
PASSES = 3
FEWEST = 2  # steps of a direction that have a scatter


@dataclasses.dataclass(frozen=True, eq=False)
class Other:
    """levels: (R, H, W) log intensity of the rests by the other map; log_map: that map."""

    levels: np.ndarray
    log_map: LogMap


def other_map(levels: np.ndarray, framed: np.ndarray, given: bool) -> Other | None:
    """The other map, if a level lies below 20 DN.

    Args:
        levels: (R, H, W) log intensity of the rests: `lin_log` of the frames, or, if given, the
            logarithm of a light meter's readings.
        framed: (R, H, W) `lin_log` of the frames.
        given: whether levels are those of a light meter.
    """
    dn = np.asarray(lin_log_inverse(jnp.asarray(framed)), np.float64)
    if np.median(dn, (1, 2)).min() >= LINLOG_KNEE:
        return None
    if not given:
        return Other(np.asarray(log_dn(dn), np.float64), "log_eps")
    gain = np.median(np.log(np.maximum(dn, 1.0)) - levels)
    return Other(np.asarray(lin_log(np.exp(levels + gain)), np.float64), "linlog")


def chosen_map(
    levels: np.ndarray, other: Other, sent: np.ndarray, sized: np.ndarray
) -> tuple[bool, list[Note]]:
    """Whether the other map is the right one, and a note if that is open.

    Args:
        levels: (R, H, W) log intensity.
        other: as of `other_map`.
        sent: (R - 1, 2) ON and OFF events per pixel of each step, minus the noise.
        sized: (R - 1,) bool, steps whose change is known.
    """
    (own, theta), (others, thetas) = (_scatter(v, sent, sized) for v in (levels, other.levels))
    own, others = own + FLOOR, others + FLOOR
    if others < CLEARLY * own:
        return True, []
    away = np.nan_to_num(thetas / theta - 1.0)
    if own < CLEARLY * others or np.abs(away).max() < NEGLIGIBLE:
        return False, []
    kinds = "logarithmic", "linear, as v2e's"
    this, that = kinds if other.log_map == "linlog" else kinds[::-1]
    return False, [Note(
        "levels.dark", "levels of light lie below 20 DN, where pixels are taken as "
        f"{this}: if they are {that}, θ ON is {away[0]:+.0%} and θ OFF {away[1]:+.0%} off. Steps "
        "of more sizes decide it, or levels above 20 DN.")]


def _scatter(
    levels: np.ndarray, sent: np.ndarray, sized: np.ndarray
) -> tuple[float, np.ndarray]:
    """How much the thresholds of single steps differ, relative std within a direction, and their
    medians (2,), NaN without steps."""
    changes = np.median(np.diff(levels, axis=0), (1, 2))
    up, medians = changes > 0, np.ones(2)
    turned = np.diff(up, prepend=not up[0])
    for _ in range(PASSES):
        away = [np.zeros(0)]
        back = 0.5 * (1.0 + medians[::-1] / medians)  # events less where the memory returns first
        for side, direction in enumerate((up, ~up)):
            used = direction & sized & (sent[:, side] > 0)
            used[0] &= len(used) <= FEWEST  # what the light did before is not known
            theta = np.abs(changes[used]) / (sent[used, side] + back[side] * turned[used])
            medians[side] = np.median(theta) if len(theta) else np.nan
            away += [np.log(theta / medians[side])] if len(theta) >= FEWEST else []
        medians, found = np.where(np.isnan(medians), 1.0, medians), medians.copy()
    joined = np.concatenate(away)
    return float(np.sqrt(np.mean(joined**2))) if len(joined) else 0.0, found
