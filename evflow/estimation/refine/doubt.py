"""The std of the thresholds for real cameras, whose pixels and frames are not ideal.

The fusion (fit.py) learned its errors on pixels without a low-pass and on frames that measure
light. Exposure, noise, an undetected offset and a slow photoreceptor add errors. They show in
disagreement between pooled regression, fusion and path, and above all in a low share of variance
that the path explains. Linear maps from such indicators ("signs") to the log of the std were fitted
on simulated cameras: one on those that were found ideal, one on the others.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.estimation.refine.receptor_result import Found

Array = np.ndarray

NAMES = (
    "regression", "other_regression", "ideal_regression", "unexplained", "explained_more",
    "smear_10", "smear_20", "theta_10", "theta_20", "frame_noise", "needed", "odds", "offset",
    "offset_unneeded", "offset_std", "tau", "tau_std", "even", "open", "open_unneeded",
    "fused_std", "theta", "other_theta", "size", "on", "unexplained_ideal", "poor_ideal",
    "with_missed")
MOST_DEVIATIONS = 2.0  # signs are clipped to so many standard deviations of those it was fitted to
NEEDED = NAMES.index("needed")
NARROWER = 0.5  # the new std is at least this share of the one before
MOST_ODDS = 10.0
LENIENT = 3.0  # log odds added to the search's for a camera that is not ideal
POOR = 0.3  # share of variance left unexplained by the path, above which an offset is often missed


def signs(found: Found, noise_dn: float, summary: Summary, std: Summary) -> Array:
    """Indicators of the error of theta_on and theta_off.

    Args:
        found: the search for the photoreceptor.
        noise_dn: std of the frames' noise, DN.
        summary, std: the estimate.

    Returns:
        (2, F) float64 in the order of NAMES. `with_missed` includes the threshold's change under a
        photoreceptor that was not detected, times its probability.
    """
    theta, error = (np.array([float(getattr(s, f"theta_{p}")) for p in ("on", "off")])
                    for s in (summary, std))
    needed = float(found.needed)
    unneeded = 1.0 - needed
    pooled = np.log((found.theta if found.needed else found.ideal_theta) / theta)
    ideally = np.log(found.ideal_theta / theta)
    ideal, seen = found.explained
    left = 1.0 - (seen if found.needed else ideal)
    offset_std, tau_std, _ = found.std
    shared = [np.log(left + 1e-3), np.log((1 - ideal + 1e-3) / (1 - seen + 1e-3)),
              *found.smear[:, 0]]
    chance = np.clip(found.chance, 1e-9, 1 - 1e-9)
    log_odds = np.log(chance / (1 - chance)) + found.few
    odds = np.clip(log_odds, -MOST_ODDS, MOST_ODDS) / MOST_ODDS
    missed = unneeded / (1.0 + np.exp(-log_odds - LENIENT))
    change = np.log(found.theta / found.ideal_theta)
    camera = [noise_dn / 3.0, needed, odds, needed * found.seen.offset_dn / 20.0,
              unneeded * found.seen.offset_dn / 20.0, np.log(offset_std),
              needed * found.seen.tau_s * 1e3, np.log(tau_std * 1e3),
              float(not found.seen.by_light)]
    rows = []
    for p in (0, 1):
        open_ = found.theta_error[p]
        own = [np.log(needed * open_ + 0.01), np.log(unneeded * open_ + 0.01),
               np.log(error[p] / theta[p]),
               np.log(theta[p]), np.log(theta[1 - p]), np.log(found.size), 1.0 - p,
               unneeded * left, unneeded * float(left > POOR),
               0.5 * np.log((error[p] / theta[p]) ** 2 + missed * (change[p] ** 2 + open_**2))]
        rows.append([pooled[p], pooled[1 - p], ideally[p], *shared, *found.smear[:, 1 + p],
                     *camera, *own])
    return np.array(rows, np.float64)


def doubted(nets: dict[str, Any], rows: Array, summary: Summary, std: Summary) -> Summary:
    """The std of a summary, with that of its thresholds replaced.

    Args:
        nets: of cameras found "ideal", and of the "other" ones: "mean", "scale" (F,) of the signs
            in the fit, "map" (F + 1,) to the log of the relative std, "widen" (), its calibration.
        rows: (2, F) of `signs`.
        summary, std: the estimate.

    Raises:
        EvflowDataError: EV018 for weights fitted to other signs.
    """
    net = nets.get("other" if rows[0, NEEDED] else "ideal", {"mean": ()})
    if np.shape(net["mean"]) != (len(NAMES),):
        raise EvflowDataError(
            "EV018", f"the weights' `doubt` part was fitted to {np.size(net['mean'])} signs, this "
            f"version computes {len(NAMES)}.",
            "They are of another version; refit: python -m experiments.doubt.")
    error = relative_error(net, rows) * float(net["widen"])
    return dataclasses.replace(std, **{
        name: jnp.float32(max(float(getattr(summary, name)) * error[p],
                              NARROWER * float(getattr(std, name))))
        for p, name in enumerate(("theta_on", "theta_off"))})


def relative_error(net: dict[str, Any], rows: Array) -> Array:
    """Std (N,) of log theta before the calibration "widen", for rows (N, F)."""
    x = (rows - np.asarray(net["mean"])) / np.asarray(net["scale"])
    x = np.concatenate([np.clip(x, -MOST_DEVIATIONS, MOST_DEVIATIONS), np.ones((len(x), 1))], -1)
    return np.asarray(np.exp(x @ np.asarray(net["map"])))
