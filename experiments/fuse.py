"""Fit the fusion network of the refinement on simulated recordings, everything else frozen.

    python -m experiments.fuse runs/default/weights.safetensors --out final.safetensors

Each recording passes through the network and the Gauss-Newton steps of `refine`; what they
leave is regressed on the features. Five-fold cross-validation gives the figures of the model card
and the factor that makes the std cover 70 % of the held-out folds; the network that ships is
fitted to all recordings.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro

from evflow.estimation.refine import refine_summary
from evflow.network.coordinates import unsquash_summary
from evflow.network.weights import weights_hash
from experiments.shared.cameras import Hidden, Protocol, draw_protocols
from experiments.shared.common import at_least, run_script
from experiments.shared.fusion_fit import cross_validated, figures_of, fit
from experiments.shared.many import Setup
from experiments.shared.refinement import COVERED, before_refinement
from experiments.shared.rows import collected
from experiments.shared.weight_parts import begin_fit, save_part


@dataclasses.dataclass(frozen=True)
class Options:
    """Fit the fusion of the refinement."""

    weights: tyro.conf.Positional[Path]
    out: Path
    recordings: int = 2000
    steps: int = 500
    workers: int = 1
    """Processes that simulate side by side."""
    seed: int = 3_000_017
    """Apart from training's, so that the cameras are held out."""
    rows: Path | None = None
    """Where to keep the features, to resume an interrupted run from."""
    overwrite: bool = False


def row(params: Any, hidden: Hidden, _protocol: Protocol) -> dict[str, np.ndarray] | None:
    """Features, y of the stepped estimate and y of the truth; None where nothing fired."""
    start = before_refinement(params, hidden.recording)
    if start is None:
        return None
    refined = refine_summary(*start)
    return {"features": refined.features,
            "y": np.asarray(unsquash_summary(refined.summary)),
            "network": np.asarray(unsquash_summary(start[1])),
            "true": np.asarray(unsquash_summary(hidden.nominal)),
            "signal": hidden.signal_events()}


def main(options: Options) -> dict[str, Any]:
    at_least(1, recordings=options.recordings, workers=options.workers)
    name, net = begin_fit(options, "summary")
    protocols = draw_protocols(options.seed, options.recordings)
    setup = Setup(str(options.weights), options.seed, photos=True)
    origin = f"{options.seed} {weights_hash(options.weights)}"
    rows = collected(row, setup, protocols, options.workers, options.rows, origin)
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
