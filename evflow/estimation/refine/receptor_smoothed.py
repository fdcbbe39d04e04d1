"""The path of noisy frames, smoothed in time before the search for a photoreceptor.

A path is less noisy behind a low-pass, whose lag a negative delay takes back: on noisy frames this
pair explains the events better than an ideal pixel does, though no pixel sees ahead. Once the path
is smoothed to both sides, nothing is left for it to explain.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from evflow.estimation.refine.receptor_data import Sample
from evflow.estimation.refine.receptor_descent import TAUS
from evflow.estimation.refine.receptor_regression import Regression
from evflow.simulator.photoreceptor import TYPICAL

WIDTHS = (1e-3, 2e-3, 4e-3)  # s


def smoothed(data: Sample) -> Sample:
    """The sample with the path smoothed by that of WIDTHS, or none, by which an ideal pixel or one
    with a low-pass explains the events best."""
    return min((data, *(_over(data, width) for width in WIDTHS)), key=_unexplained)


def _unexplained(data: Sample) -> float:
    """Least log unexplained share over TAUS and both laws of the low-pass."""
    by_light = Regression(data)
    even = dataclasses.replace(by_light, by_light=False)
    return min(model.unexplained(np.array([0.0, tau * scale, 0.0])) for tau in TAUS
               for model, scale in ((by_light, TYPICAL), (even, 1.0)))


def _over(data: Sample, width: float) -> Sample:
    """The sample with the path averaged with weights exp(-|t| / width)."""
    paths = []
    for dn, dt_s in zip(np.asarray(data.dn), np.asarray(data.dt_s), strict=True):
        at = np.concatenate([[0.0], np.cumsum(dt_s)])
        weights = np.exp(-np.abs(at[:, None] - at) / width) * np.gradient(at)
        paths.append((weights / weights.sum(1, keepdims=True)).astype(np.float32) @ dn)
    return data._replace(dn=jax.device_put(np.stack(paths)))
