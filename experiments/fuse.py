"""Fit the fusion network of the refinement on simulated recordings, everything else frozen.

    python -m experiments.fuse runs/default/weights.safetensors --out final.safetensors

Each recording passes through the network and the Gauss-Newton steps of `refine`; what they
leave is regressed on the features. Five-fold cross-validation gives the figures of the model card
and the factor that makes the std cover 70 % of the held-out folds; the network that ships is
fitted to all recordings.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from evflow.commands.writing import need_absent, need_suffix
from evflow.estimation.refine import fused, refine_summary
from evflow.estimation.refine.fit import FusionNet
from evflow.network.coordinates import squash, unsquash_summary
from evflow.network.weights import model_card, save_weights, weights_hash
from experiments.shared.cameras import Hidden, Protocol, draw_protocol
from experiments.shared.common import at_least, estimator, run_script
from experiments.shared.many import Setup
from experiments.shared.refinement import COVERED, before_refinement
from experiments.shared.rows import Rows, collected

Array = jax.Array

FOLDS = 5
JITTER, DEGREES = 0.5, 30.0  # in standard deviations; of Student's t


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


def fit(rows: Rows, options: Options) -> dict[str, Any]:
    """The fusion's parameters from rows."""
    x = rows["features"]
    edges = np.quantile(x, [0.003, 0.997], 0)
    fusion: dict[str, Any] = {
        "mean": x.mean(0), "scale": x.std(0) + 0.05, "low": edges[0], "high": edges[1],
        "widen": np.ones(6)}
    fusion = {k: jnp.asarray(v, jnp.float32) for k, v in fusion.items()}
    data = {k: jnp.asarray(rows[k], jnp.float32) for k in ("features", "y", "true")}

    def loss(net: Any, key: Array) -> Array:
        # Jitter: some thousand recordings support little more than a linear map of the features.
        noise = JITTER * jax.random.normal(key, data["features"].shape)
        features = data["features"] + fusion["scale"][None] * noise
        y, std = predict({**fusion, "net": net}, features, data["y"])
        error = (data["true"] - y) / std
        # Student's t: a few recordings say nothing and must not decide alone.
        heavy = 0.5 * (DEGREES + 1) * jnp.log1p(error**2 / DEGREES)
        return (jnp.log(std) + heavy).mean()

    tx = optax.adamw(optax.cosine_decay_schedule(3e-3, options.steps), weight_decay=1.0)

    def step(carry: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], None]:
        net, state = carry
        updates, state = tx.update(jax.grad(loss)(net, key), state, net)
        return (optax.apply_updates(net, updates), state), None

    k_init, k_steps = jax.random.split(jax.random.key(options.seed))
    net = FusionNet().init(k_init, data["features"][0])["params"]
    keys = jax.random.split(k_steps, options.steps)
    (net, _), _ = jax.jit(lambda c: jax.lax.scan(step, c, keys))((net, tx.init(net)))
    return {**fusion, "net": net}


def predict(fusion: dict[str, Any], features: Array, y: Array) -> tuple[Array, Array]:
    return jax.vmap(partial(fused, fusion))(features, y)


def cross_validated(rows: Rows, options: Options) -> tuple[np.ndarray, np.ndarray]:
    """y and std (N, 6) of every recording by a fusion that has not seen it."""
    y, std = np.zeros_like(rows["y"]), np.zeros_like(rows["y"])
    fold = np.arange(len(y)) % FOLDS
    for f in range(FOLDS):
        fusion = fit({k: v[fold != f] for k, v in rows.items()}, options)
        y[fold == f], std[fold == f] = predict(
            fusion, jnp.asarray(rows["features"][fold == f]), jnp.asarray(rows["y"][fold == f]))
    return y, std


def figures_of(rows: Rows, y: np.ndarray, std: np.ndarray) -> dict[str, Any]:
    """Mean |theta| and |eta| errors of network, steps and fusion over recordings with 200 signal
    events of the polarity; coverage of 68 and 95 % over all recordings."""
    figures: dict[str, Any] = {"recordings": len(y)}
    for i, name in enumerate(("theta_on", "theta_off", "eta_on", "eta_off")):
        used = rows["signal"][:, i % 2] >= 200

        def value(y: np.ndarray, name: str = name) -> np.ndarray:
            return np.asarray(getattr(squash(jnp.asarray(y[:, :4])), name))

        for label, guess in (("network", rows["network"]), ("steps", rows["y"]), ("fused", y)):
            error = np.abs(value(guess) - value(rows["true"]))[used]
            figures[f"{label}/{name}"] = float(error.mean())
            figures[f"{label}_median/{name}"] = float(np.median(error))
        miss = np.abs(y - rows["true"])[:, i] / std[:, i]
        figures[f"inside_68/{name}"] = float((miss < 1).mean())
        figures[f"inside_95/{name}"] = float((miss < 1.96).mean())
    return figures


def main(options: Options) -> dict[str, Any]:
    at_least(1, recordings=options.recordings, workers=options.workers)
    need_suffix(options.out, ".safetensors")
    need_absent(options.out, options.overwrite)
    name, net = estimator(options.weights, "summary")
    protocols = [draw_protocol(np.random.default_rng((options.seed, i)))
                 for i in range(options.recordings)]
    setup = Setup(str(options.weights), options.seed, photos=True)
    origin = f"{options.seed} {weights_hash(options.weights)}"
    rows = collected(row, setup, protocols, options.workers, options.rows, origin)
    y, std = cross_validated(rows, options)
    widen = np.quantile(np.abs(y - rows["true"]) / std, COVERED, axis=0)
    figures = figures_of(rows, y, std * widen)
    fusion = {**fit(rows, options), "widen": jnp.asarray(widen, jnp.float32)}
    print("\n".join(f"{k:24s} {v:.4f}" for k, v in figures.items()))
    card = model_card(options.weights) | {"fusion": {
        "recordings": options.recordings, "seed": options.seed, "figures": figures}}
    save_weights(options.out, {name: {**net, "fusion": fusion}}, card,
                 overwrite=options.overwrite)
    return figures


if __name__ == "__main__":
    run_script(main, Options, __doc__)
