"""The optical flow of recordings by a trained network, window by window, and its scores."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.released import Trained
from evflow.downstream.tensor import reconstructions
from evflow.errors import EvflowDataError, naming
from evflow.files.archives import load_npz
from evflow.metrics.flow_scores import score_flow
from evflow.types import Events

SAMPLED = 8  # windows by which the colours' scale is chosen
FULL_PERCENTILE = 99.0
SHARED = ("convention", "outlier_px")  # entries of a result that are no means


def flow_of(trained: Trained) -> Trained:
    """The network; raises EV020 if it gives images instead of flow."""
    if not isinstance(trained.network, EVFlowNet):
        raise EvflowDataError("EV020", f"these weights are of {type(trained.network).__name__}, "
                              "which gives images.", "Choose weights of EV-FlowNet.")
    return trained


def window_flows(trained: Trained, events: Events, edges_us: np.ndarray) -> Iterator[np.ndarray]:
    """Flow (2, H, W), px over the window, of each of the windows between edges_us (T + 1,).

    An event on an edge belongs to the window that begins there, as where the flow is scored and
    shown; the windows of `reconstructions` end with it, so they are cut a microsecond before."""
    inside = events.slice(int(edges_us[0]), int(edges_us[-1]))
    return reconstructions(
        trained.network, trained.params, inside, edges_us[1:] - 1, **trained.how)


def full_motion(trained: Trained, events: Events, edges_us: np.ndarray) -> float:
    """Motion in px per window that 1 % of the pixels with events exceed, over a few windows; at
    least 1, so that noise at rest is not shown in full colour."""
    some = np.unique(np.linspace(0, len(edges_us) - 2, SAMPLED).astype(int))
    speeds = []
    for i in some:
        flow = next(window_flows(trained, events, edges_us[i:i + 2]))
        part = events.slice(int(edges_us[i]), int(edges_us[i + 1]))
        speeds.append(np.hypot(*flow[:, part.y, part.x]))
    seen = np.concatenate(speeds)
    return max(1.0, float(np.percentile(seen, FULL_PERCENTILE))) if seen.size else 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class FlowTruth:
    """flow (T, 2, H, W), px over the windows between edges_us (T + 1,); valid (T, H, W) bool."""

    flow: np.ndarray
    edges_us: np.ndarray
    valid: np.ndarray


def load_truth(path: str | os.PathLike, size: tuple[int, int]) -> FlowTruth:
    """Read the true flow from an .npz with flow, edges_us and, if not all is known, valid, for a
    sensor of `size`. Raises EV016 (no such file), EV008 (arrays missing), EV015 (another size),
    EV004 (edges fall)."""
    if not Path(path).is_file():
        raise EvflowDataError("EV016", f"no file with the true flow at {path}.")
    data = load_npz(Path(path))
    with naming(Path(path)):
        if missing := [name for name in ("flow", "edges_us") if name not in data]:
            raise EvflowDataError("EV008", f"it holds {sorted(data)} but not {missing}.",
                                  "Expected flow (T, 2, H, W) and edges_us (T + 1,).")
        flow, edges = data["flow"], data["edges_us"]
        if edges.dtype.kind not in "iu" or edges.ndim != 1 or len(edges) < 2 or np.any(
                np.diff(edges := edges.astype(np.int64)) <= 0):
            raise EvflowDataError("EV004", "edges_us are no rising integers.",
                                  "Give T + 1 instants in microseconds.")
        shape = (len(edges) - 1, 2, size[1], size[0])
        if flow.dtype.kind not in "fiu" or flow.shape != shape:
            raise EvflowDataError("EV015", f"flow is {flow.dtype} {flow.shape}, with {len(edges)} "
                                  "edges.", f"Expected numbers {shape}.")
        flow = flow.astype(np.float32)
        valid = np.asarray(data.get("valid", np.isfinite(flow).all(1)), bool)
        if valid.shape != (shape[0], *shape[2:]):
            raise EvflowDataError("EV015", f"valid is {valid.shape}.",
                                  f"Expected {(shape[0], *shape[2:])}.")
    return FlowTruth(flow, edges, valid)


class FlowScores:
    """Scores of flows as they come, one window after the other; see `score_flow`."""

    def __init__(
        self, events: Events, edges_us: np.ndarray, truth: FlowTruth | None = None
    ) -> None:
        self._events, self._edges, self._truth = events, edges_us, truth
        self._rows: list[dict[str, Any]] = []

    def add(self, flow: np.ndarray) -> None:
        """The flow (2, H, W) of the next window."""
        i = len(self._rows)
        truth, valid = None, None
        if self._truth is not None:
            truth, valid = self._truth.flow[i:i + 1], self._truth.valid[i:i + 1]
        self._rows.append(score_flow(
            self._events, self._edges[i:i + 2], flow[None], truth=truth, valid=valid))

    def result(self) -> dict[str, Any]:
        """Means over the windows where a score is defined, None without any; "windows": number with
        events."""
        names = dict.fromkeys(name for row in self._rows for name in row)
        means: dict[str, Any] = {name: self._rows[0][name] for name in SHARED}
        for name in (n for n in names if n not in SHARED):
            values = [row[name] for row in self._rows if row.get(name) is not None]
            means[name] = float(np.mean(values)) if values else None
        return means | {"windows": sum(row["windows"] for row in self._rows)}
