"""Fit the fusion networks of the refinement on simulated recordings, everything else frozen.

    python -m experiments.fuse runs/default/weights.safetensors --out final.safetensors

Each recording of a hidden camera (of fifteen, six of the training's distribution, seven as cameras
may be: ideal, slow, blind for a while after an event, noisy, with exposed, offset and noisy frames;
two DVS-Voltmeter's, or seen for 5 s; of the last thousand the exposure is known) passes through the
network, the search for the photoreceptor and the Gauss-Newton steps of `refine`; what they leave is
regressed on the features, by the mean of several networks. Five-fold cross-validation gives the
figures of the model card and the factor that makes the std cover 70 % of the held-out folds; the
network that ships is fitted to all recordings.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro

from evflow.network.coordinates import unsquash_summary
from evflow.network.weights import weights_hash
from evflow.training.config import PRESETS
from experiments.shared.cameras import Hidden, Protocol, draw_protocol
from experiments.shared.common import at_least, run_script
from experiments.shared.fusion_fit import FOLDS, cross_validated, figures_of, fit
from experiments.shared.many import Setup
from experiments.shared.real_cameras import draw_exposed, draw_other, draw_real
from experiments.shared.refinement import COVERED, begun
from experiments.shared.rows import collected
from experiments.shared.weight_parts import begin_fit, save_part

KINDS = (draw_protocol,) * 6 + (draw_real,) * 7 + (draw_other,) * 2
AS_DRAWN, OTHER_SHAPES = 5000, ((180, 240), (64, 64), (64, 64), (64, 64))
EXPOSURE_TOLD = 6500  # beyond: frames whose exposure the recording tells


@dataclasses.dataclass(frozen=True)
class Options:
    """Fit the fusion of the refinement."""

    weights: tyro.conf.Positional[Path]
    out: Path
    recordings: int = 7500
    steps: int = 1000
    workers: int = 1
    """Processes that simulate side by side."""
    seed: int = 3_000_017
    """Apart from training's, so that the cameras are held out."""
    rows: Path | None = None
    """Where to keep the features, to resume an interrupted run from."""
    overwrite: bool = False


def drawn(seed: int, number: int) -> Protocol:
    """What the recording of that number is like. Beyond the first AS_DRAWN, size and scenes say
    nothing of the kind of camera: those of 64x64 pixels were ideal."""
    if number >= EXPOSURE_TOLD:
        return draw_exposed(np.random.default_rng((seed, number)))
    protocol = KINDS[number % len(KINDS)](np.random.default_rng((seed, number)))
    if number < AS_DRAWN:
        return protocol
    return dataclasses.replace(protocol, shape=OTHER_SHAPES[number % len(OTHER_SHAPES)],
                               scene=PRESETS["default"].scene)


def row(params: Any, hidden: Hidden, _protocol: Protocol) -> dict[str, np.ndarray] | None:
    """Features, y of the stepped estimate and y of the truth; None where nothing fired."""
    start = begun(params, hidden.recording)
    if start is None:
        return None
    refined = start.stepped()
    return {"features": refined.features,
            "y": np.asarray(unsquash_summary(refined.summary)),
            "network": np.asarray(unsquash_summary(start.summary)),
            "true": np.asarray(unsquash_summary(hidden.nominal)),
            "signal": hidden.signal_events()}


def main(options: Options) -> dict[str, Any]:
    at_least(1, steps=options.steps, workers=options.workers)
    at_least(FOLDS, recordings=options.recordings)
    name, net = begin_fit(options, "summary")
    protocols = [drawn(options.seed, i) for i in range(options.recordings)]
    setup = Setup(str(options.weights), options.seed, photos=True)
    origin = f"{options.seed} {weights_hash(options.weights)}"
    rows = collected(row, setup, protocols, options.workers, options.rows, origin,
                     least=FOLDS)
    y, std = cross_validated(rows, options.steps, options.seed)
    widen = np.quantile(np.abs(y - rows["true"]) / std, COVERED, axis=0)
    figures = figures_of(rows, y, std * widen)
    fusion = {**fit(rows, options.steps, options.seed),
              "widen": jnp.asarray(widen, jnp.float32)}
    print("\n".join(f"{k:24s} {v:.4f}" for k, v in figures.items()))
    save_part(options, name, net, {"fusion": fusion}, {"fusion": {
        "recordings": options.recordings, "seed": options.seed, "figures": figures}})
    return figures


if __name__ == "__main__":
    run_script(main, Options, __doc__)
