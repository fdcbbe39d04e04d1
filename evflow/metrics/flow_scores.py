"""Scores of optical flow over a recording: FWL and RSAT from its events, AEE from the true flow.

A result holds its conventions, the number of events per window, and, where the true flow is known,
its FWL as an upper bound.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.errors import EvflowDataError
from evflow.metrics.flow import FWL, FwlConvention, aee, fwl, rsat
from evflow.types import Events

Array = jax.Array

EventArrays = tuple[Array, Array, Array, Array, Array]  # x, y, t, p, weight; (N,) each

OUTLIER_PX = 3.0
NAMES, OF_TRUTH = ("fwl", "rsat"), ("aee", "outlier_percent", "fwl_truth")


def score_flow(
    events: Events, edges_us: np.ndarray, flows: np.ndarray, *,
    truth: np.ndarray | None = None, valid: np.ndarray | None = None,
    convention: FwlConvention = FWL,
) -> dict[str, Any]:
    """Scores of flows (T, 2, H, W), px over each of the windows between edges_us (T + 1,); JSON-
    ready means over the windows that have events (None where none has).

    "windows" is their number, "window_ms" and "events_per_window" their mean length and events.
    truth: the true flows, scored at pixels with events where valid (T, H, W) is True (default:
    where they are finite). Its FWL uses the events at pixels where it is known.
    Raises EV002 (shapes), EV004 (edges that do not rise), EV007 (flows that are not finite).
    """
    edges, flows = np.asarray(edges_us, np.int64), np.asarray(flows)
    shape = (len(edges) - 1, 2, events.size[1], events.size[0])
    for name, array in (("flows", flows), ("truth", truth)):
        if array is not None and array.shape != shape:
            raise EvflowDataError("EV002", f"{name} is {array.shape}.", f"Expected {shape}.")
    if not np.isfinite(flows).all():
        raise EvflowDataError("EV007", "flows hold NaN or infinite values.",
                              "Weights that diverged?")
    if valid is not None and valid.shape != (shape[0], *shape[2:]):
        raise EvflowDataError("EV002", f"valid is {valid.shape}.", "Expected (T, H, W).")
    if len(edges) < 2 or np.any(np.diff(edges) <= 0):
        raise EvflowDataError("EV004", "edges_us does not rise.", "Pass T + 1 rising instants.")
    windows = [events.slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]
    length = 1 << max(0, max(map(len, windows)) - 1).bit_length()  # one shape, one compilation
    rows = []
    seen = [i for i, part in enumerate(windows) if len(part)]
    for i in seen:
        arrays = _padded(windows[i], int(edges[i]), int(edges[i + 1]), length)
        rows.append(_window(arrays, flows[i], None if truth is None else truth[i],
                            None if valid is None else valid[i], convention))
    names = NAMES if truth is None else NAMES + OF_TRUTH  # a silent recording has them too
    means = {name: _mean([float(row[name]) for row in rows]) for name in names}
    return {"convention": convention.as_dict(), "outlier_px": OUTLIER_PX, "windows": len(rows),
            "window_ms": _mean([1e-3 * float(edges[i + 1] - edges[i]) for i in seen]),
            "events_per_window": _mean([float(len(windows[i])) for i in seen]), **means}


def _padded(events: Events, start: int, stop: int, length: int) -> EventArrays:
    """x, y, t (in windows), p, weight: (length,) float32."""
    time = (events.t - start) / (stop - start)
    columns = (events.x, events.y, time, np.where(events.p, 1, -1), np.ones(len(events)))
    spare = (0, length - len(events))
    x, y, t, p, weight = (jnp.asarray(np.pad(c.astype(np.float32), spare)) for c in columns)
    return x, y, t, p, weight


@functools.partial(jax.jit, static_argnames="convention")
def _window(
    events: EventArrays, flow: Array, truth: Array | None, valid: Array | None,
    convention: FwlConvention,
) -> dict[str, Array]:
    scores = {"fwl": fwl(*events, flow, convention), "rsat": rsat(*events, flow)}
    if truth is not None:
        x, y, _, _, weight = events
        height, width = flow.shape[-2:]
        index = jnp.where(weight > 0, y * width + x, height * width).astype(jnp.int32)
        seen = jnp.zeros(height * width, bool).at[index].set(True, mode="drop")
        mask = seen.reshape(height, width)
        mask = mask if valid is None else mask & valid
        scores["aee"], scores["outlier_percent"] = aee(flow, truth, mask, outlier_px=OUTLIER_PX)
        scores["fwl_truth"] = _fwl_truth(events, truth, valid, convention)
    return scores


def _fwl_truth(
    events: EventArrays, truth: Array, valid: Array | None, convention: FwlConvention
) -> Array:
    """FWL of the true flow, by the events at pixels where it is known."""
    known = jnp.isfinite(truth).all(0)
    known = known if valid is None else known & valid
    x, y, t, p, weight = events
    valid_at = known[y.astype(jnp.int32), x.astype(jnp.int32)]
    weight = jnp.where(valid_at, weight, 0.0)
    return fwl(x, y, t, p, weight, jnp.where(known[None], truth, 0.0), convention)


def _mean(values: list[float]) -> float | None:
    """Of the values that are defined."""
    finite = [v for v in values if math.isfinite(v)]
    return sum(finite) / len(finite) if finite else None
