"""Maps of each estimator separately: flow, set network, whole estimate.

Footnote 1 of the paper averages |map - value of the sequence| over the pixels of every window, and
so do the rows "one window". Even the true map does not make that small: at a mismatch of .15 it
scores .114, the mean distance of its pixels from the sequence's value.
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow import CameraEstimate, Recording, estimate, estimate_camera, finish, load_weights
from evflow.baselines import Fitted
from evflow.camera import PARAMETERS, Camera, Summary
from evflow.errors import EvflowDataError
from evflow.estimation.pooled import pool_recording, window_inputs
from evflow.estimation.unpooled import WINDOW_US
from evflow.light.logarithm import LIN_LOG, Logarithm
from evflow.network.architecture import config_of
from evflow.recordings.windows import iter_windows

Maps = list[np.ndarray]  # (4, H, W) by PARAMETERS each: one, or one per window

WINDOW, FLOW = "flow, one window", "flow, all windows"
PAPER_WINDOW, PAPER_FLOW = "paper's flow, one window", "paper's flow, all windows"
NETWORK, SUMMARY, WHOLE = "set network alone", "summary everywhere", "whole estimate"
ESTIMATORS = (PAPER_WINDOW, PAPER_FLOW, WINDOW, FLOW, NETWORK, SUMMARY, WHOLE)
RATES = (PAPER_WINDOW, WINDOW, NETWORK)  # estimators that estimate noise rates themselves
SAID = ("One window in one call is the paper's estimator (our flow is given the summary of all "
        "windows, the paper's nothing), and `mae_sequence` its footnote 1: |map "
        "− θ| over pixels and windows. A map that is right about its pixels cannot have it small: "
        "the truth's own is the mean |pixel − θ|, .024 at a mismatch of .03 and .114 at .15. "
        "Noise rates of all windows together are those of the quiet time, but for the paper's "
        "flow.")


@functools.cache
def paper_weights() -> Any:
    """The released weights of the paper's network."""
    return load_weights("paper")


def pools(params: Any) -> bool:
    """Whether the network estimates a summary of the camera and errors."""
    return config_of(params).pool


def stacked(camera: Camera) -> np.ndarray:
    """(4, H, W)."""
    return np.stack([np.asarray(getattr(camera, name)) for name in PARAMETERS])


def everywhere(summary: Summary, shape: tuple[int, ...]) -> np.ndarray:
    """A constant map (4, H, W) of the summary."""
    values = np.array([float(getattr(summary, name)) for name in PARAMETERS])
    return np.broadcast_to(values[:, None, None], (4, *shape))


def windows(
    params: Any, recording: Recording, min_window_us: int, summary: Summary | None
) -> Maps:
    """The flow's maps of each window, given the camera's summary if there is one."""
    found = []
    for window in iter_windows(recording, min_window_us):
        voxels, dlogI, given = window_inputs(window)
        found.append(stacked(estimate(params, voxels, dlogI, summary=summary, **given)))
    return found


def estimated_maps(
    params: Any, recording: Recording, found: CameraEstimate, min_window_us: int = 40_000
) -> dict[str, Maps]:
    """Maps by ESTIMATORS; arguments and names as of `estimators`."""
    return {name: make() for name, make in estimators(
        params, recording, found, min_window_us).items()}


def estimators(
    params: Any, recording: Recording, found: CameraEstimate, min_window_us: int
) -> dict[str, Callable[[], Maps]]:
    """What makes the maps of each of ESTIMATORS; empty for a scene at rest, whose thresholds are
    undetermined. params: weights; the paper's are used too, with windows as short as in its
    training. found: the recording's whole estimate; min_window_us: of the windows."""
    if not found.windows:
        return {}

    @functools.cache
    def known() -> Summary:
        return finish(params, pool_recording(params, recording, min_window_us)[0])[0]

    def flow(weights: Any) -> np.ndarray:
        return stacked(estimate_camera(recording, weights, refine="off",
                                       min_window_us=min_window_us).camera)

    paper = paper_weights() if pools(params) else params
    short = min(min_window_us, WINDOW_US)
    by_paper: dict[str, Callable[[], Maps]] = {
        PAPER_WINDOW: lambda: windows(paper, recording, short, None),
        PAPER_FLOW: lambda: [flow(paper)]}
    if not pools(params):
        return by_paper
    shape = recording.events.size[::-1]
    return by_paper | {
        WINDOW: lambda: windows(params, recording, min_window_us, known()),
        FLOW: lambda: [flow(params)], NETWORK: lambda: [everywhere(known(), shape)],
        SUMMARY: lambda: [everywhere(found.summary, shape)],
        WHOLE: lambda: [stacked(found.camera)]}


def fitted(
    params: Any, recording: Recording, found: CameraEstimate, seconds: float,
    min_window_us: int = 40_000,
) -> dict[str, Fitted]:
    """The estimators with one map (without the whole estimate) as compared systems; their
    thresholds are the medians of the maps. seconds: what the whole estimate took, and with it its
    summary."""
    rows = {}
    made = estimators(params, recording, found, min_window_us)
    for name in (name for name in made if name in (PAPER_FLOW, FLOW, NETWORK, SUMMARY)):
        start = time.perf_counter()
        maps = made[name]()[0]
        took = seconds if name == SUMMARY else time.perf_counter() - start
        rows[name] = Fitted(Camera(*(jnp.asarray(m, jnp.float32) for m in maps)),
                            np.stack([found.valid] * 2), np.median(maps[:2], (1, 2)), took,
                            logarithm=logarithm_of(found) if name == SUMMARY else LIN_LOG)
    return rows


def logarithm_of(found: CameraEstimate) -> Logarithm:
    """That of an estimate's thresholds: of the light that its frames lack, too."""
    return Logarithm(found.optics.offset_dn,
                     "log_eps" if found.sensor.log_map == "log_eps" else "linlog")


def rates(params: Any, recording: Recording) -> dict[str, np.ndarray]:
    """Noise rates (2,) of the estimators in RATES, means over pixels and windows; NaN without
    windows with events, or without a set network."""
    found = dict.fromkeys(RATES, np.full(2, np.nan))

    def mean(maps: Maps) -> np.ndarray:
        return np.stack(maps)[:, 2:].mean((0, 2, 3))

    with contextlib.suppress(EvflowDataError):
        found[PAPER_WINDOW] = mean(windows(
            paper_weights() if pools(params) else params, recording, WINDOW_US, None))
        if pools(params):
            known, _ = finish(params, pool_recording(params, recording)[0])
            found[NETWORK] = np.array([float(known.eta_on), float(known.eta_off)])
            found[WINDOW] = mean(windows(params, recording, 40_000, known))
    return found


def errors(
    maps: Maps, truth: np.ndarray, nominal: np.ndarray, fired: np.ndarray
) -> dict[str, np.ndarray]:
    """Mean errors (4,) of a recording's maps. truth (4, H, W) of the pixels; nominal (4,) of the
    sequence; fired (4, H, W) bool, pixels that sent events of the parameter's polarity."""
    seen = np.stack(maps)
    off = np.abs(seen - truth)
    counts = fired.sum((1, 2))
    return {"mae_sequence": np.abs(seen - nominal[:, None, None]).mean((0, 2, 3)),
            "mae_pixel": off.mean((0, 2, 3)),
            "mae_fired": np.where(counts > 0, (off.mean(0) * fired).sum((1, 2))
                                  / np.maximum(counts, 1), np.nan),
            "median": np.abs(np.median(seen, (2, 3)) - nominal).mean(0)}
