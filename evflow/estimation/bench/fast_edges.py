"""Contrast that pixels lose in their dead time while the light's edge passes.

Pixels that are held in reset for a dead time d after each event miss the change of light meanwhile.
On an edge of C log units in T seconds, n events lose n d C / T of it:

    C = n theta + n C d / T,

so that C / n, the threshold by counts, grows with the size of the step. Pixels that keep what
changes in their dead time, and edges that are slow beside it, have one threshold for all sizes. A
dead time in which events are dropped acts alike where it exceeds the time between them.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from evflow.estimation.result import THRESHOLDS, CameraEstimate
from evflow.notes import Note

SURE = 3.0  # standard deviations
LEAST = 0.03  # relative change of theta that matters
SMALLEST = 0.5  # of theta by all steps: mostly more, as pixels lose contrast, less by wrong levels
LEVEL_ERROR = 0.01  # log units, of a step's size
PASSES = 3
PARTS = 3  # unknowns: two thresholds and d / T
FREE = 3  # steps beyond the unknowns
RESTED = 0.2  # share of the pixels that must be without noise at a rest


def kept_by_small_steps(
    changes: np.ndarray, sent: np.ndarray, theta: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Thresholds (2,) of vanishing steps, on which no contrast is lost, and their std; None where
    those of all sizes agree.

    Args:
        changes: (K,) log units.
        sent: (K, 2) ON and OFF events per pixel minus the noise, NaN where unknown.
        theta: (2,) thresholds by all steps.
        known: (K,) bool, steps whose size and events are known.
    """
    up = changes > 0
    n = np.where(up, sent[:, 0], sent[:, 1])
    turned = np.diff(up, prepend=up[0])
    used = known & (np.nan_to_num(n) > 1.0)
    used[0] = False  # what came before the first is not known
    design = np.stack([n * up, n * ~up, n * np.abs(changes)], 1)[used]
    if used.sum() < PARTS + FREE or np.linalg.matrix_rank(design) < PARTS:
        return None
    found = np.array([*theta, 0.0])
    for _ in range(PASSES):
        # After a step in the other direction the memory must first return.
        way = (np.abs(changes) - 0.5 * turned * found[:2].sum())[used]
        found = np.linalg.lstsq(design, way, rcond=None)[0]
    rest = way - design @ found
    error = max(float(np.sqrt(rest @ rest / (used.sum() - PARTS))), LEVEL_ERROR)
    std = error * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    lost = found[2] * np.median(np.abs(changes[used]))
    if found[2] < SURE * std[2] or lost < LEAST * theta.mean() or (found[:2] > theta).any():
        return None
    return np.maximum(found[:2], 0.0), std[:2]


def by_rested(clean: np.ndarray, rests: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(K, 2) mean events of the steps over pixels without noise at the rest before, which may have
    reset their memory; NaN where fewer than RESTED are. clean: (K, 2, H, W) events minus the noise;
    rests: (K + 1, 2, H, W) events at rest; used: (H, W) bool."""
    rested = (rests[:-1].sum(1) == 0) & used
    share = rested.sum((1, 2)) / max(int(used.sum()), 1)
    mean = (clean * rested[:, None]).sum((2, 3)) / np.maximum(rested.sum((1, 2)), 1)[:, None]
    return np.where((share >= RESTED)[:, None], mean, np.nan)


def with_fast_edges(
    found: CameraEstimate, changes: np.ndarray, sent: np.ndarray, known: np.ndarray
) -> CameraEstimate:
    """The estimate, where large steps send too few events with the mean of the thresholds by all
    steps and by vanishing ones, half their difference in the errors, and a note. Of pixels held in
    reset for 5 to 13 % of an edge, on which those by all steps were 3 to 36 % too high, the mean
    came out up to 17 % from the truth, and within its error. By vanishing steps of less than
    SMALLEST it is not taken, as the light is rather wrong then. Arguments as of
    `kept_by_small_steps`."""
    theta = np.array([float(getattr(found.summary, name)) for name in THRESHOLDS])
    kept = None if found.undetermined else kept_by_small_steps(changes, sent, theta, known)
    if kept is None:
        return found
    small = kept[0]
    likely = bool((small >= SMALLEST * theta).all())
    camera, std, summary, summary_std = found.camera, found.std, found.summary, found.summary_std
    for name, value, other, error in zip(THRESHOLDS, theta, *kept, strict=True):
        mean = 0.5 * (value + other) if likely else value
        away = 0.5 * np.hypot(value - other, error)
        by, maps = jnp.float32(mean / value), getattr(camera, name)
        std = dataclasses.replace(std, **{
            name: jnp.hypot(getattr(std, name) * by, maps * jnp.float32(away / value))})
        camera = dataclasses.replace(camera, **{name: maps * by})
        summary = dataclasses.replace(summary, **{name: jnp.float32(mean)})
        summary_std = dataclasses.replace(summary_std, **{
            name: jnp.hypot(getattr(summary_std, name) * by, jnp.float32(away))})
    note = Note(
        "steps.fast", "large steps send fewer events than small ones foretell: thresholds by all "
        f"are {theta[0]:.3f} / {theta[1]:.3f}, by vanishing steps {small[0]:.3f} / "
        f"{small[1]:.3f}. Pixels lose contrast in their dead time where edges are fast, or the "
        f"light of some levels is wrong. {'The mean of the two' if likely else 'The former'} is "
        "given; take slower edges, and check the levels.")
    return dataclasses.replace(found, camera=camera, std=std, summary=summary,
                               summary_std=summary_std, notes=(*found.notes, note))
