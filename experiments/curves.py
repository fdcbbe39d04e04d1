"""How the error falls with data: window length, duration, events, frame rate, speed.

    python -m experiments.curves --preset full --workers 2

Recordings of the paper's cameras (mismatch .03), one setting changed at a time. Mean |summary -
true| of the refined estimate and of the network alone, over polarities with at least 200 signal
events; draws a page of curves. The paper reports .023 / .022 (theta) and .045 / .027 Hz (eta).
"""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from evflow import estimate_camera, finish
from evflow.camera import CameraPrior
from evflow.estimation.pooled import pool_recording
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.common import StudyOptions, begin, conclude, estimator, run_script
from experiments.shared.curves_pages import draw, table
from experiments.shared.many import Setup, study
from experiments.shared.protocols import ENOUGH

BASE = Protocol(prior=CameraPrior(mismatch=(0.03, 0.03)))
# 200 ms at other frame rates, other durations at 25 ms, other speeds; (frame_ms, intervals).
RATES = ((5, 40), (10, 20), (20, 10), (25, 8), (40, 5), (50, 4), (100, 2))
DURATIONS = ((25, 2), (25, 4), (25, 8), (25, 16), (25, 32))
SPEEDS = ((5.0, 15.0), (15.0, 50.0), (50.0, 150.0), (150.0, 350.0))
WINDOWS_US = (25_000, 50_000, 100_000)
EVENTS = (0, 50, 200, 1000, 3000, 10_000, 1_000_000)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Measure the error against the amount and kind of data."""

    out: Path = Path("out/curves")
    seed: int = 6_000_011
    recordings: int | None = None
    """Recordings per point (default: the preset's)."""


def score(params: Any, hidden: Hidden, _protocol: Protocol) -> dict[str, np.ndarray] | None:
    """Errors (4,) of the refined summary and of the network alone with each window length."""
    if len(hidden.recording.events) < 10:
        return None
    names = ("theta_on", "theta_off", "eta_on", "eta_off")

    def errors(summary: Any) -> np.ndarray:
        return np.array([abs(float(getattr(summary, n)) - float(getattr(hidden.nominal, n)))
                         for n in names])

    row = {"refined": errors(estimate_camera(hidden.recording, params).summary),
           "signal": np.tile(hidden.signal_events(), 2)}
    for length in WINDOWS_US:
        if length <= hidden.recording.events.duration_us:
            stats, _ = pool_recording(params, hidden.recording, length)
            row[f"network {length // 1000}"] = errors(finish(params, stats)[0])
    return row


def point(rows: list[dict[str, np.ndarray]], key: str, low: float = ENOUGH,
          high: float = np.inf) -> dict[str, float]:
    """Mean error of theta and of eta over polarities with low <= signal events < high."""
    rows = [r for r in rows if key in r]
    errors, signal = (np.array([r[k] for r in rows]).reshape(-1, 4) for k in (key, "signal"))
    used = (np.maximum(signal, 0.0) >= low) & (signal < high)
    return {"recordings": len(rows), **{
        name: float(errors[:, part][used[:, part]].mean()) if used[:, part].any() else np.nan
        for name, part in (("theta", slice(0, 2)), ("eta", slice(2, 4)))}}


def main(options: Options) -> dict[str, Any]:
    begin(options, "curves")
    estimator(options.weights, "summary")
    count = options.count(options.recordings, debug=2, full=60)
    settings: dict[str, dict[Any, Protocol]] = {
        "frame interval [ms]": {ms: dataclasses.replace(BASE, frame_ms=ms, intervals=n)
                                for ms, n in RATES},
        "duration [ms]": {ms * n: dataclasses.replace(BASE, frame_ms=ms, intervals=n)
                          for ms, n in DURATIONS},
        "speed up to [px/s]": {s[1]: dataclasses.replace(
            BASE, scene=dataclasses.replace(BASE.scene, speed_px_s=s)) for s in SPEEDS}}
    if options.preset == "debug":
        settings = {name: dict(list(points.items())[-2:]) for name, points in settings.items()}
    result: dict[str, Any] = {}
    base: list[dict[str, np.ndarray]] = []
    for name, points in settings.items():
        result[name] = {}
        for value, protocol in points.items():
            rows = study(score, Setup(options.weights, options.seed), [protocol] * count,
                         options.workers, f"{name} {value}")
            result[name][value] = {"refined": point(rows, "refined"),
                                   "network": point(rows, "network 50")}
            base += rows
    result["signal events"] = {
        high: {k: point(base, f, low, high) for k, f in (("refined", "refined"),
                                                         ("network", "network 50"))}
        for low, high in itertools.pairwise(EVENTS)}
    result["window [ms]"] = {us // 1000: {"network": point(base, f"network {us // 1000}")}
                             for us in WINDOWS_US}
    conclude(options, "curves", result, table(result))
    draw(result, options.out / "curves.png")
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)
