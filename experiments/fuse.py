"""Fit the fusion networks of the refinement on simulated recordings, everything else frozen.

    python -m experiments.fuse runs/default/weights.safetensors --out final.safetensors

Each recording of a hidden camera (of seventeen, five of the training's distribution, five as
cameras may be: ideal, slow, blind for a while after an event, noisy, with exposed, offset and noisy
frames; five with one of these faults or none; two DVS-Voltmeter's, or seen for 5 s; of every
fifteenth the exposure is known) passes through the network, the search for the photoreceptor and
the Gauss-Newton steps of `refine`; what they leave is regressed on the features, by the mean of
several networks. Five-fold cross-validation gives the figures of the model card and the factor that
makes the std cover 70 % of the held-out folds; the network that ships is fitted to all recordings.
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
from experiments.shared.real_cameras import draw_exposed, draw_other, draw_real, draw_single
from experiments.shared.refinement import COVERED, begun
from experiments.shared.rows import collected
from experiments.shared.weight_parts import begin_fit, save_part, seeds_before

KINDS = (draw_protocol,) * 5 + (draw_real,) * 5 + (draw_single,) * 5 + (draw_other,) * 2
# Of so many one has another shape and scene, which would tell the kind of camera: those of 64x64
# pixels were ideal.
AS_DRAWN, OTHER_SHAPES = 5, ((180, 240), (64, 64), (64, 64), (64, 64))
EXPOSURE_TOLD = 15  # of so many one tells its exposure


@dataclasses.dataclass(frozen=True)
class Options:
    """Fit the fusion of the refinement."""

    weights: tyro.conf.Positional[Path]
    out: Path
    recordings: int = 6000
    steps: int = 1000
    """Of each network; 600 are enough with --continued."""
    continued: bool = False
    """Begin from the fusion that the weights have, at a lower rate, not anew."""
    workers: int = 1
    """Processes that simulate side by side."""
    seed: int = 3_000_029
    """Apart from training's, so that the cameras are held out."""
    rows: Path | None = None
    """Where to keep the features, to resume an interrupted run from."""
    overwrite: bool = False


def drawn(seed: int, number: int) -> Protocol:
    """What the recording of that number is like."""
    rng = np.random.default_rng((seed, number))
    if told(number):
        return draw_exposed(rng)
    protocol = KINDS[number % len(KINDS)](rng)
    if number % AS_DRAWN:
        return protocol
    shape = OTHER_SHAPES[number // AS_DRAWN % len(OTHER_SHAPES)]
    return dataclasses.replace(protocol, shape=shape, scene=PRESETS["default"].scene)


def told(number: int) -> bool:
    """Whether it has frames whose exposure the recording tells."""
    return number % EXPOSURE_TOLD == 7


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
    name, net = begin_fit(options, "summary", *(["fusion"] if options.continued else []))
    start = net["fusion"] if options.continued else None
    before = seeds_before(options, "fusion") if options.continued else []
    protocols = [drawn(options.seed, i) for i in range(options.recordings)]
    setup = Setup(str(options.weights), options.seed, photos=True)
    origin = f"{options.seed} {weights_hash(options.weights)}"
    rows = collected(row, setup, protocols, options.workers, options.rows, origin,
                     least=FOLDS)
    y, std = cross_validated(rows, options.steps, options.seed, start)
    widen = np.quantile(np.abs(y - rows["true"]) / std, COVERED, axis=0)
    figures = figures_of(rows, y, std * widen)
    fusion = {**fit(rows, options.steps, options.seed, start),
              "widen": jnp.asarray(widen, jnp.float32)}
    print("\n".join(f"{k:24s} {v:.4f}" for k, v in figures.items()))
    save_part(options, name, net, {"fusion": fusion}, {"fusion": {
        "recordings": options.recordings, "seeds": [*before, options.seed], "figures": figures}})
    return figures


if __name__ == "__main__":
    run_script(main, Options, __doc__)
