"""Train the network that tells noise from signal, everything else frozen.

    python -m experiments.tell_apart fused.safetensors --out default.safetensors

Signal events of simulated recordings, which the simulator labels, against random points: the log
odds of a logistic regression are those of the rate of signal events at a point, whatever the
noise. A fifth of the recordings is held out first, for the figures of the model card and the
factor that makes the std cover 70 %; the network that ships has seen all of them.
"""

from __future__ import annotations

import dataclasses
import itertools
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from evflow.camera import Summary
from evflow.commands.writing import need_absent, need_suffix
from evflow.estimation.refine import Chunk, fused, refine_summary
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.points import Points, chunk_points
from evflow.estimation.refine.signal import joined, log_intensity, rate_at
from evflow.network.coordinates import squash_summary, summary_std, unsquash_summary
from evflow.network.weights import model_card, save_weights
from experiments.shared.cameras import Hidden, Protocol, draw_protocol
from experiments.shared.common import at_least, estimator, run_script
from experiments.shared.many import Setup, study
from experiments.shared.refinement import COVERED, before_refinement

Array = jax.Array
Row = dict[str, Any]

WIDTHS = (32, 16)
BATCH = 4096
HELD_OUT = 5  # every n-th recording


@dataclasses.dataclass(frozen=True)
class Options:
    """Train the network that tells noise from signal."""

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
    start = before_refinement(params, hidden.recording)
    if start is None:
        return None
    chunks = start[0]
    found, std = fused_summary(params, *start)
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


def fused_summary(
    params: Any, chunks: list[Chunk], summary: Summary, std: Summary
) -> tuple[Summary, Summary]:
    """What is known of the camera and its std before noise is told from signal."""
    (net,) = params.values()
    steps = refine_summary(chunks, summary, std)
    y, y_std = fused(net["fusion"], jnp.asarray(steps.features), unsquash_summary(steps.summary))
    return squash_summary(y), summary_std(squash_summary(y), y_std)


def train(rows: list[Row], options: Options) -> dict[str, Any]:
    """The network's parameters: logistic regression of signal events against random points."""
    features, event, density = (np.concatenate([getattr(r["points"], name) for r in rows])
                                for name in ("features", "event", "density"))
    kept = ~np.concatenate([r["noise"] for r in rows])
    x, offset = features[kept], np.log(density[kept]).astype(np.float32)
    y = (event >= 0)[kept].astype(np.float32)
    fixed = {"mean": jnp.asarray(x.mean(0)), "scale": jnp.asarray(x.std(0) + 1e-3)}
    sizes = (x.shape[1], *WIDTHS, 1)
    rng = np.random.default_rng(options.seed)
    layers = {str(i): {"kernel": jnp.asarray(rng.normal(0, np.sqrt(2 / a), (a, b)), jnp.float32),
                       "bias": jnp.zeros(b)}
              for i, (a, b) in enumerate(itertools.pairwise(sizes))}

    def loss(layers: Any, x: Array, y: Array, offset: Array) -> Array:
        odds = log_intensity({**fixed, "layers": layers}, x) - offset
        return (jax.nn.softplus(odds) - y * odds).mean()

    tx = optax.adamw(optax.cosine_decay_schedule(3e-3, options.steps), weight_decay=1e-3)

    @jax.jit
    def step(layers: Any, state: Any, batch: tuple[Array, ...]) -> tuple[Any, Any]:
        updates, state = tx.update(jax.grad(loss)(layers, *batch), state, layers)
        return optax.apply_updates(layers, updates), state

    state = tx.init(layers)
    for _ in range(options.steps):
        used = rng.integers(0, len(x), BATCH)
        layers, state = step(layers, state, (x[used], y[used], offset[used]))
    return {**fixed, "layers": layers}


def judged(rows: list[Row], net: dict[str, Any]) -> tuple[float, dict[str, float]]:
    """The factor that widens the std, and figures of recordings that the network has not seen."""
    plain = jax.tree.map(np.asarray, net)
    found = np.array([rate_at(plain, r["points"], *r["before"]) for r in rows])
    true = np.array([r["true"] for r in rows])
    away = np.abs(found[:, 0] - np.log(np.maximum(true, 1e-3))) / found[:, 1]
    widen = float(np.quantile(away, COVERED))
    used = np.array([r["signal"] >= 200 for r in rows])
    error = np.abs(np.exp(found[:, 0]) - true)[used]
    return widen, {"recordings": len(rows) // 2, "mean": float(error.mean()),
                   "median": float(np.median(error)), "widen": widen,
                   "inside_95": float((away < 1.96 * widen).mean())}


def main(options: Options) -> dict[str, float]:
    at_least(1, recordings=options.recordings, workers=options.workers)
    need_suffix(options.out, ".safetensors")
    need_absent(options.out, options.overwrite)
    name, net = estimator(options.weights, "summary")
    setup = Setup(str(options.weights), options.seed, photos=True)
    protocols = [draw_protocol(np.random.default_rng((options.seed, i)))
                 for i in range(options.recordings)]
    made = study(row, setup, protocols, options.workers, "recordings")
    part = partial(_some, made)
    widen, figures = judged(part(True), train(part(False), options))
    signal = {**train(part(True) + part(False), options), "widen": jnp.float32(widen)}
    print("\n".join(f"{k:24s} {v:.4f}" for k, v in figures.items()))
    card = model_card(options.weights) | {"signal": {
        "recordings": options.recordings, "seed": options.seed, "figures": figures}}
    save_weights(options.out, {name: {**net, "signal": signal}}, card,
                 overwrite=options.overwrite)
    return figures


def _some(made: list[list[Row]], held_out: bool) -> list[Row]:
    return [side for i, r in enumerate(made) if (i % HELD_OUT == 0) == held_out for side in r]


if __name__ == "__main__":
    run_script(main, Options, __doc__)
