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
from experiments.shared.curves_pages import draw, point, table
from experiments.shared.many import Setup, study

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


def alike(found: dict[Protocol, list[dict[str, np.ndarray]]]) -> list[dict[str, np.ndarray]]:
    """Rows that tell lengths of windows apart: of recordings whose frames divide each length, and
    that are long enough for all."""
    return [row for protocol, rows in found.items()
            if not any(us % (1000 * protocol.frame_ms) for us in WINDOWS_US) for row in rows
            if all(f"network {us // 1000}" in row for us in WINDOWS_US)]


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
    found: dict[Protocol, list[dict[str, np.ndarray]]] = {}  # two settings have one in common
    for name, points in settings.items():
        result[name] = {}
        for value, protocol in points.items():
            if protocol not in found:
                found[protocol] = study(score, Setup(options.weights, options.seed),
                                        [protocol] * count, options.workers, f"{name} {value}")
            rows = found[protocol]
            result[name][value] = {"refined": point(rows, "refined"),
                                   "network": point(rows, "network 50")}
    base = [row for rows in found.values() for row in rows]
    result["signal events"] = {
        high: {k: point(base, f, low, high) for k, f in (("refined", "refined"),
                                                         ("network", "network 50"))}
        for low, high in itertools.pairwise(EVENTS)}
    result["window [ms]"] = {us // 1000: {"network": point(alike(found), f"network {us // 1000}")}
                             for us in WINDOWS_US}
    conclude(options, "curves", result, table(result))
    draw(result, options.out / "curves.png")
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)
