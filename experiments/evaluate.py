"""Accuracy on held-out recordings of simulated cameras, beside the constant prior.

    python -m experiments.evaluate --preset debug
    python -m experiments.evaluate --preset full
    python -m experiments.evaluate --preset full --cameras other --images photographs/

Protocol: 64x64 pixels, 200 ms rendered at 1000 fps, procedural textures never trained on, 8-bit
frames every 25 ms, θ ~ U(.1, .5) per polarity. `estimate_camera` sees events and frames. Scored
is the camera's summary (|summary - θ|) over recordings with at least 200 signal events of the
polarity, by the network alone and refined by simulation; `mae_sequence` is the paper's footnote 1
(map against the sequence's value), `mae_pixel` the map against each pixel's own value, also on
pixels with events of the polarity alone. A second table has the same of each estimator by itself:
the paper's network, the flow, the set network, the summary in every pixel, the whole estimate. The
paper reports .023 / .022 (θ) and .045 / .027 (η, Table VIII).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evflow import CameraEstimate, estimate_camera, finish
from evflow.estimation.pooled import pool_recording
from experiments.shared import alone
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.common import StudyOptions, begin, conclude, run_script
from experiments.shared.evaluated import PAPER, averages, inside, table
from experiments.shared.many import Setup, enough, study
from experiments.shared.protocols import ENOUGH, other_protocols, protocols

CONSTANT = {"theta_on": 0.3, "theta_off": 0.3, "eta_on": 0.114, "eta_off": 0.114}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Evaluate weights on held-out simulated cameras."""

    out: Path = Path("out/evaluate")
    seed: int = 1_000_003
    """Far from any training seed: other textures, scenes and cameras."""
    sequences: int | None = None
    """Recordings per row (default: the preset's)."""
    cameras: Literal["known", "other"] = "known"
    """The table's; or such as were never trained on: of another prior, of another simulator."""
    images: str | None = None
    """Scenes of one's own pictures: a folder, or a COCO json of objects."""


def by_whom(params: Any, hidden: Hidden, found: CameraEstimate) -> dict[str, float]:
    """Errors of each estimator by itself, by ESTIMATOR: METRIC/PARAMETER."""
    names = tuple(PAPER)
    truth = alone.stacked(hidden.camera)
    nominal = np.array([float(getattr(hidden.nominal, name)) for name in names])
    fired = np.tile(hidden.recording.events.count_map() > 0, (2, 1, 1))
    return {f"{who}: {metric}/{name}": float(value)
            for who, maps in alone.estimated_maps(params, hidden.recording, found).items()
            for metric, values in alone.errors(maps, truth, nominal, fired).items()
            for name, value in zip(names, values, strict=True)}


def score(params: Any, hidden: Hidden, _protocol: Protocol) -> dict[str, float] | None:
    """Errors of one recording; None where next to nothing fired."""
    recording, nominal = hidden.recording, hidden.nominal
    if len(recording.events) <= ENOUGH:
        return None
    network = finish(params, pool_recording(params, recording)[0])[0] if alone.pools(
        params) else None
    found = estimate_camera(recording, params)
    counts, signal = recording.events.count_map(), hidden.signal_events()
    errors = by_whom(params, hidden, found)
    for i, name in enumerate(PAPER):
        true, pixels = float(getattr(nominal, name)), np.asarray(getattr(hidden.camera, name))
        guess, std = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
        seen = np.asarray(getattr(found.camera, name))
        fired = counts[i % 2] > 0
        off = np.abs(seen - pixels)
        errors |= {
            f"true/{name}": true,
            f"signal/{name}": float(signal[i % 2]),
            f"network/{name}": abs(float(getattr(network, name)) - true) if network else np.nan,
            f"summary/{name}": abs(guess - true),
            f"inside_68/{name}": inside(guess - true, std),
            f"inside_95/{name}": inside(guess - true, 1.96 * std),
            f"constant/{name}": abs(CONSTANT[name] - true),
            f"mae_sequence/{name}": float(np.abs(seen - true).mean()),
            f"mae_pixel/{name}": float(off.mean()),
            f"mae_fired/{name}": float(off[fired].mean()) if fired.any() else np.nan,
            f"constant_truth/{name}": float(np.abs(true - pixels).mean()),
            f"map_gain/{name}": float(np.abs(guess - pixels).mean() - off.mean()),
        }
    return errors


def main(options: Options) -> dict[str, dict[str, Any]]:
    begin(options, "evaluate")
    setup = Setup(options.weights, options.seed, images=options.images)
    rows = protocols() if options.cameras == "known" else other_protocols()
    count = options.count(options.sequences, debug=6, full=320)
    results = {name: averages(enough(study(
        score, setup, [protocol] * count, options.workers, f"mismatch {name}")))
        for name, protocol in rows.items()}
    conclude(options, "evaluate", results, table(results))
    return results


if __name__ == "__main__":
    run_script(main, Options, __doc__)
