"""Light that a bench's pixels see and its levels lack: dark light, less the frames' black level.

With a light o added to all levels, a step between l and m changes the logarithm by

    C(o) = ln((m + o) / (l + o)) = n theta + n loss C(0) / T + r,

for n events and the remainder r of a turn (steps.py). A wrong o makes steps between dark levels too
small or too large beside those between bright ones; contrast lost on fast edges, the other term
(fast_edges.py), depends on the sizes alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from evflow.camera.optics import Optics
from evflow.camera.sensors import LogMap
from evflow.estimation.bench.counting import Steps
from evflow.estimation.bench.fast_edges import LEVEL_ERROR
from evflow.estimation.bench.levels import Unit
from evflow.light.log_maps import lin_log, lin_log_inverse, log_dn, log_dn_inverse
from evflow.notes import Note

Array = np.ndarray

SURE = 3.0  # standard deviations
USUAL_DN = 8.0  # std of what frames lack, where the steps tell nothing
REACH = np.linspace(-0.9, 3.0, 157)  # candidates, in units of the darkest level
LEAST_EVENTS = 0.3  # per pixel: smaller steps do not count
PARTS = 4  # unknowns: two thresholds, loss and light
SPLIT = 1e-3  # of the darkest level, for derivatives
NOTED = 0.05  # relative error of the thresholds
DARKEST = 1e-9  # light, in any unit


@dataclasses.dataclass(frozen=True)
class AddedLight:
    """amount: in the unit of the levels, 0 where it is not clear; std: its error, NaN where nothing
    tells it; unsure: error of the levels that remains."""

    amount: float = 0.0
    std: float = float("nan")
    unsure: float = 0.0

    def optics(self, unit: Unit) -> Optics:
        """What frames lack, of levels by frames; of others nothing is known of the frames."""
        return Optics(self.amount, offset_dn_std=self.std) if unit == "DN" else Optics()


def seen(levels: Array, added: float, log_map: LogMap | None) -> Array:
    """Log intensity of `levels` (any shape, log intensity by log_map, or ln light where None) with
    this light added."""
    if not added:
        return levels
    there, back = _maps(log_map)
    return np.asarray(there(np.maximum(back(levels) + added, DARKEST)), np.float64)


def _maps(log_map: LogMap | None) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """From light to log intensity, and back."""
    if log_map is None:
        return np.log, np.exp
    return (log_dn, log_dn_inverse) if log_map == "log_eps" else (lin_log, lin_log_inverse)


def with_added_light(
    steps: Steps, log_map: LogMap, theta: Array, spread: Array, sent: Array, known: Array
) -> tuple[Steps, AddedLight, Array]:
    """The steps by levels with the light that pixels see beside theirs; that light, and the
    relative errors (2,) of thresholds by what of it is unsure. Arguments as of `measured_light`;
    log_map: of the levels, if they are of frames."""
    of = log_map if steps.unit == "DN" else None
    if of is None and log_map == "linlog" and steps.other is not None:
        return steps, AddedLight(), np.zeros(2)  # a light meter's levels, by v2e's map
    levels = np.median(steps.levels, (1, 2))
    added = measured_light(levels, of, sent, known, theta, spread)
    error = light_error(seen(levels, added.amount, of), of, added.unsure, known)
    return dataclasses.replace(
        steps, levels=seen(steps.levels, added.amount, of),
        notes=(*steps.notes, *light_notes(added, steps.unit, error))), added, error


def measured_light(
    levels: Array, log_map: LogMap | None, sent: Array, known: Array, theta: Array, spread: Array
) -> AddedLight:
    """The light that the steps show.

    Args:
        levels: (K + 1,) log intensity of the rests.
        log_map: of the levels in DN; None of those by a light meter.
        sent: (K, 2) ON and OFF events per pixel minus the noise, NaN where unknown.
        known: (K,) bool, steps whose size and events are known.
        theta: (2,) thresholds, without light added.
        spread: (2,) standard deviations of the pixels' thresholds.
    """
    usual = AddedLight(unsure=USUAL_DN if log_map else 0.0)
    change = np.diff(levels)
    up = change > 0
    n = np.nan_to_num(np.where(up, sent[:, 0], sent[:, 1]))
    turned = np.diff(up, prepend=up[0])
    used = known & (n > LEAST_EVENTS)
    used[0] = False  # what came before the first is not known
    sides = np.stack([n * up + 0.5 * turned, n * ~up + 0.5 * turned], 1)
    design = np.column_stack([sides, n * np.abs(change)])[used]
    kinds = len({(round(a, 2), round(b, 2))
                 for a, b in np.stack([levels[:-1], levels[1:]], 1)[used]})
    if kinds <= PARTS or np.linalg.matrix_rank(design) < PARTS - 1:
        return usual
    side = np.where(up, 0, 1)
    error = _step_error(np.abs(change), theta[side], spread[side])[used]
    darkest = float(_maps(log_map)[1](levels.min()))

    def sizes(added: float) -> Array:
        return np.abs(np.diff(seen(levels, added, log_map)))[used] / error

    scaled = design / error[:, None]
    project = np.eye(len(scaled)) - scaled @ np.linalg.pinv(scaled)

    def unlike(share: float) -> float:
        # In events: smaller steps would leave smaller remainders.
        size = sizes(share * darkest)
        return float(size @ project @ size / (size @ size))

    tried = np.array([unlike(share) for share in REACH])
    best = int(np.argmin(tried))
    if best in (0, len(REACH) - 1):
        return usual
    amount = _vertex(REACH[best - 1:best + 2], tried[best - 1:best + 2]) * darkest
    step = SPLIT * darkest
    slope = (sizes(amount + step) - sizes(amount - step)) / (2.0 * step)
    rest = project @ sizes(amount)
    # Steps alike leave the same remainders: they count once.
    scatter = max(float(rest @ rest) / max(len(rest) - PARTS, 1), 1.0) * len(rest) / kinds
    std = float(np.sqrt(scatter / max(float(slope @ project @ slope), 1e-12)))
    if abs(amount) > SURE * std:
        return AddedLight(amount, std, std)
    found = np.hypot(amount, std)
    return AddedLight(0.0, std, float(np.hypot(1.0 / found, 1.0 / usual.unsure) ** -1
                                      if usual.unsure else found))


def light_error(levels: Array, log_map: LogMap | None, unsure: float, known: Array) -> Array:
    """(2,) relative errors of the thresholds, ON and OFF, as the levels (K + 1,) are unsure by so
    much light. known: (K,) bool."""
    change = np.diff(levels)
    by = min(unsure, 0.5 * float(_maps(log_map)[1](levels.min())))
    if not by:
        return np.zeros(2)
    more, less = (np.abs(np.diff(seen(levels, sign * by, log_map))) for sign in (1.0, -1.0))
    sides = [known & side for side in (change > 0, change < 0)]
    return np.array([0.5 * abs(less[side].sum() - more[side].sum()) / np.abs(change[side]).sum()
                     * unsure / by if side.any() else 0.0 for side in sides])


def light_notes(added: AddedLight, unit: Unit, error: Array) -> list[Note]:
    """Notes on light that pixels see beyond the levels, or that steps do not tell. error: (2,) as
    of `light_error`."""
    of = f" {unit}" if unit != "light" else ""
    if added.amount:
        lacking = ("dark light, less the frames' black level" if unit == "DN" else
                   "dark light, or a light meter that is not on the screen")
        return [Note(
            "levels.added", "steps between dark and between bright levels agree if pixels see "
            f"{added.amount:+.3g} ± {added.std:.2g}{of} beside the levels: {lacking}. Thresholds "
            "are by levels with it.")]
    if error.max() < NOTED:
        return []
    why, or_else = ((", as by a black level of the frames",
                     ", or give the light of each, --lux") if unit == "DN" else ("", ""))
    return [Note(
        "levels.black", "these steps hardly tell whether pixels see more or less light than the "
        f"levels say{why}: ± {added.unsure:.1g}{of} make thresholds {error.max():.0%} wrong. Take "
        f"four or more levels in random order{or_else}.")]


def _step_error(size: Array, theta: Array, spread: Array) -> Array:
    """(K,) error in log units of what a step's mean events say: pixels alike, with remainders alike
    at its begin and its end, all round in one direction."""
    phase = size * spread / theta**2
    rounding = theta / np.sqrt(12.0) * np.exp(-2.0 * (np.pi * phase) ** 2)
    return np.sqrt(LEVEL_ERROR**2 + rounding**2 + np.roll(rounding, 1) ** 2)


def _vertex(x: Array, y: Array) -> float:
    """The minimum of the parabola through three points of equal distance."""
    bend = y[0] - 2.0 * y[1] + y[2]
    return float(x[1] + 0.5 * (x[1] - x[0]) * (y[0] - y[2]) / bend) if bend > 0 else float(x[1])
