"""Train the network that separates noise from signal, everything else frozen.

    python -m experiments.tell_apart fused.safetensors --out default.safetensors

Signal events of simulated recordings, which the simulator labels, against random points: the log
odds of a logistic regression are those of the rate of signal events at a point, whatever the
noise. A fifth of the recordings is held out first, for the figures of the model card and the
factor that makes the std cover 70 %; the network that ships has seen all of them.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro

from evflow.camera import Summary
from evflow.estimation.refine import fused
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.points import Points, chunk_points
from evflow.estimation.refine.signal import joined
from evflow.network.coordinates import squash_summary, summary_std, unsquash_summary
from experiments.shared.cameras import Hidden, Protocol, draw_protocols
from experiments.shared.common import at_least, run_script
from experiments.shared.many import Setup, enough, study
from experiments.shared.refinement import Begun, begun
from experiments.shared.signal_fit import Row, judged, train
from experiments.shared.weight_parts import begin_fit, save_part

HELD_OUT = 5  # every n-th recording
LEAST = 2  # one to fit to, and one that is held out


@dataclasses.dataclass(frozen=True)
class Options:
    """Train the network that separates noise from signal."""

    weights: tyro.conf.Positional[Path]
    out: Path
    recordings: int = 640
    steps: int = 8000
    workers: int = 1
    """Processes that simulate side by side."""
    seed: int = 7_000_003
    """Apart from training's and the fusion's."""
    overwrite: bool = False


def row(params: Any, hidden: Hidden, _protocol: Protocol) -> list[Row] | None:
    """ON and OFF: points, which of them are noise, the true rate and the events of signal; None
    where nothing fired."""
    start = begun(params, hidden.recording)
    if start is None:
        return None
    chunks = start.chunks
    found, std = fused_summary(params, start)
    theta = np.array([float(found.theta_on), float(found.theta_off)])
    sides: list[list[Points]] = [[], []]
    noise: list[list[np.ndarray]] = [[], []]
    for i, chunk in enumerate(chunks):
        labels = hidden.noise[chunk.sightings.number]
        for side, points in enumerate(chunk_points(chunk, theta, STEPS, i)):
            sides[side].append(points)
            noise[side].append((points.event >= 0) & np.append(labels, False)[points.event])
    signal = hidden.signal_events()
    made = []
    for k, name in enumerate(("eta_on", "eta_off")):
        true, eta, error = (float(getattr(s, name)) for s in (hidden.nominal, found, std))
        made.append({"points": joined(sides[k]), "noise": np.concatenate(noise[k]), "true": true,
                     "before": (np.log(eta), error / eta), "signal": signal[k]})
    return made


def fused_summary(params: Any, start: Begun) -> tuple[Summary, Summary]:
    """What is known of the camera and its std before noise is distinguished from signal."""
    (net,) = params.values()
    steps = start.stepped()
    y, y_std = fused(net["fusion"], jnp.asarray(steps.features), unsquash_summary(steps.summary))
    return squash_summary(y), summary_std(squash_summary(y), y_std)


def main(options: Options) -> dict[str, float]:
    at_least(1, steps=options.steps, workers=options.workers)
    at_least(LEAST, recordings=options.recordings)
    name, net = begin_fit(options, "summary", "fusion")
    setup = Setup(str(options.weights), options.seed, photos=True)
    protocols = draw_protocols(options.seed, options.recordings)
    made = enough(study(row, setup, protocols, options.workers, "recordings"), LEAST)
    part = partial(_some, made)
    fit = partial(train, steps=options.steps, seed=options.seed)
    widen, figures = judged(part(True), fit(part(False)))
    signal = {**fit(part(True) + part(False)), "widen": jnp.float32(widen)}
    print("\n".join(f"{k:24s} {v:.4f}" for k, v in figures.items()))
    save_part(options, name, net, {"signal": signal}, {"signal": {
        "recordings": options.recordings, "seed": options.seed, "figures": figures}})
    return figures


def _some(made: list[list[Row]], held_out: bool) -> list[Row]:
    return [side for i, r in enumerate(made) if (i % HELD_OUT == 0) == held_out for side in r]


if __name__ == "__main__":
    run_script(main, Options, __doc__)
