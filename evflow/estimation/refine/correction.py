"""The last correction of the thresholds and of their errors: for cameras as they are.

The fusion (fit.py) learned on pixels without a low-pass and on frames that show light. What an
exposure, noise, an offset or a slow photoreceptor leaves of the thresholds' error shows in how the
pooled regression, the fusion and the path disagree; a linear map of these signs, fitted on
simulated cameras of all these kinds beside ideal ones, foretells it, and how far it may be off.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow.camera import Summary
from evflow.estimation.refine.receptor_search import Found

Array = np.ndarray

NAMES = (
    "regression", "other_regression", "unexplained", "explained_more", "smear_10", "smear_20",
    "theta_10", "theta_20", "frame_noise", "needed", "offset", "offset_std", "tau", "tau_std",
    "open", "fused_std", "theta", "other_theta", "size", "on")
BEYOND = 2.0  # standard deviations outside of what it learned on, beyond which a sign is held


def signs(found: Found, noise_dn: float, summary: Summary, std: Summary) -> Array:
    """(2, F) float64: NAMES of theta_on and theta_off, before the correction."""
    theta, error = (np.array([float(getattr(s, f"theta_{p}")) for p in ("on", "off")])
                    for s in (summary, std))
    needed = float(found.needed)
    pooled = np.log((found.theta if found.needed else found.ideal_theta) / theta)
    ideal, seen = found.explained
    left = 1.0 - (seen if found.needed else ideal)
    offset_std, tau_std, _ = found.std
    shared = [np.log(left + 1e-3), np.log((1 - ideal + 1e-3) / (1 - seen + 1e-3)),
              *found.smear[:, 0]]
    camera = [noise_dn / 3.0, needed, needed * found.seen.offset_dn / 20.0, np.log(offset_std),
              needed * found.seen.tau_s * 1e3, np.log(tau_std * 1e3)]
    rows = []
    for p in (0, 1):
        own = [np.log(needed * found.theta_error[p] + 0.01), np.log(error[p] / theta[p]),
               np.log(theta[p]), np.log(theta[1 - p]), np.log(found.size), 1.0 - p]
        rows.append([pooled[p], pooled[1 - p], *shared, *found.smear[:, 1 + p], *camera, *own])
    return np.array(rows, np.float64)


def corrected(net: dict[str, Any], rows: Array, summary: Summary, std: Summary) -> tuple[
        Summary, Summary]:
    """The summary and its std with the thresholds corrected.

    net: "mean", "scale" (F,) of the signs it was fitted to, "bias", "bias_std" (F + 1,): linear
    maps to the correction of log theta and to the log of its standard deviation, and "widen" ().
    rows: of `signs`.
    """
    change, error = foretold(net, rows)
    result, errors = {}, {}
    for p, name in enumerate(("theta_on", "theta_off")):
        theta = float(getattr(summary, name)) * float(np.exp(change[p]))
        result[name] = jnp.float32(theta)
        errors[name] = jnp.float32(theta * error[p] * float(net["widen"]))
    return dataclasses.replace(summary, **result), dataclasses.replace(std, **errors)


def foretold(net: dict[str, Any], rows: Array) -> tuple[Array, Array]:
    """Change of log theta (N,) and its std, before "widen", of rows (N, F)."""
    x = (rows - np.asarray(net["mean"])) / np.asarray(net["scale"])
    x = np.concatenate([np.clip(x, -BEYOND, BEYOND), np.ones((len(x), 1))], -1)
    return x @ np.asarray(net["bias"]), np.exp(x @ np.asarray(net["bias_std"]))
