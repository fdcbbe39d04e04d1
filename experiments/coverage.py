"""Are the intervals honest? Coverage over many simulated cameras, by events and duration.

    python -m experiments.coverage --preset full --workers 2
    python -m experiments.coverage --preset full --recordings 30 --intervals 200 --workers 2

Cameras, scenes and sensors of the whole training distribution, none of them seen in training; with
--photos also scenes of the photographs that training shows. Longer recordings than in training,
and pixels whose noise differs more, are options.
An interval of probability p should hold the truth in a share p of the cases: for the camera's
summary over recordings, and for the maps over pixels. Draws the calibration curve.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from evflow import estimate_camera
from evflow.camera import PARAMETERS
from evflow.errors import EvflowDataError
from experiments.shared.cameras import Hidden, Protocol, draw_protocol
from experiments.shared.common import (
    StudyOptions,
    at_least,
    begin,
    conclude,
    estimator,
    run_script,
)
from experiments.shared.coverage_pages import LEVELS, curves, deviations, draw, strata, table
from experiments.shared.many import Setup, enough, study


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Measure the coverage of the estimate's intervals."""

    out: Path = Path("out/coverage")
    seed: int = 5_000_077
    recordings: int | None = None
    """Number of cameras (default: the preset's)."""
    photos: bool = False
    """Whether scenes show the photographs of the training, too."""
    intervals: int | None = None
    """Frame intervals of every recording (default: 8 to 24, of 10 to 40 ms)."""
    seconds: float | None = None
    """Length of every recording, in place of a number of intervals."""
    eta_spread: float | None = None
    """Standard deviation of log noise rates over pixels (default: 0 or .1, as in training)."""


def drawn(rng: np.random.Generator, options: Options) -> Protocol:
    """A protocol of the training distribution, except where the options differ."""
    protocol = draw_protocol(rng)
    if options.intervals is not None:
        protocol = dataclasses.replace(protocol, intervals=options.intervals)
    if options.seconds is not None:
        count = max(1, round(1000 * options.seconds / protocol.frame_ms))
        protocol = dataclasses.replace(protocol, intervals=count)
    if options.eta_spread is not None:
        prior = dataclasses.replace(protocol.prior, eta_spread=options.eta_spread)
        protocol = dataclasses.replace(protocol, prior=prior)
    return protocol


def score(params: Any, hidden: Hidden, protocol: Protocol) -> dict[str, Any] | None:
    """Errors in units of their std: of the summary, and for each level the share of pixels whose
    interval holds the truth."""
    recording = hidden.recording
    if len(recording.events) < 10:
        return None
    try:
        found = estimate_camera(recording, params)
    except EvflowDataError:  # no usable interval
        return None
    signal = hidden.signal_events()
    row: dict[str, Any] = {"seconds": protocol.frame_ms * protocol.intervals * 1e-3}
    for i, name in enumerate(PARAMETERS):
        # Noise adds up: a camera's rate is the mean of its pixels'.
        true = float(getattr(hidden.nominal, name) if name.startswith("theta") else
                     getattr(hidden.camera, name).mean())
        guess, std = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
        error = np.abs(np.asarray(getattr(found.camera, name)) - getattr(hidden.camera, name))
        away = error / np.asarray(getattr(found.std, name))
        row |= {f"signal/{name}": float(signal[i % 2]), f"summary/{name}": abs(guess - true) / std,
                f"pixels/{name}": (away[..., None] < deviations()).mean((0, 1)),
                f"valid/{name}": (away[found.valid][:, None] < deviations()).mean(0)
                if found.valid.any() else np.full(len(LEVELS), np.nan)}
    return row


def main(options: Options) -> dict[str, Any]:
    begin(options, "coverage")
    if options.intervals is not None and options.seconds is not None:
        raise EvflowDataError("EV020", "--intervals with --seconds.", "Give one of them.")
    at_least(0.01, seconds=options.seconds)
    estimator(options.weights, "summary")
    count = options.count(options.recordings, debug=12, full=1000)
    protocols = [drawn(np.random.default_rng((options.seed, i)), options) for i in range(count)]
    setup = Setup(options.weights, options.seed, options.photos)
    rows = enough(study(score, setup, protocols, options.workers, "cameras"))
    found = curves(rows)
    result = {"levels": LEVELS.tolist(), "cameras": len(rows), "curves": found,
              "strata": strata(rows)}
    conclude(options, "coverage", result, table(result))
    draw(found, options.out / "coverage.png")
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)
