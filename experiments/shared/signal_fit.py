"""The fit of the network that separates signal from noise (refine/signal.py), and its errors."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from evflow.estimation.refine.signal import log_intensity, rate_at
from experiments.shared.refinement import COVERED

Array = jax.Array
Row = dict[str, Any]  # of a recording and polarity: points, noise, true, before, signal

WIDTHS = (32, 16)
BATCH = 4096


def train(rows: list[Row], steps: int, seed: int) -> dict[str, Any]:
    """The network's parameters: logistic regression of signal events against random points."""
    features, event, density = (np.concatenate([getattr(r["points"], name) for r in rows])
                                for name in ("features", "event", "density"))
    kept = ~np.concatenate([r["noise"] for r in rows])
    x, offset = features[kept], np.log(density[kept]).astype(np.float32)
    y = (event >= 0)[kept].astype(np.float32)
    fixed = {"mean": jnp.asarray(x.mean(0)), "scale": jnp.asarray(x.std(0) + 1e-3)}
    rng = np.random.default_rng(seed)
    layers = initial_layers(rng, (x.shape[1], *WIDTHS, 1))

    def loss(layers: Any, x: Array, y: Array, offset: Array) -> Array:
        odds = log_intensity({**fixed, "layers": layers}, x) - offset
        return (jax.nn.softplus(odds) - y * odds).mean()

    tx = optax.adamw(optax.cosine_decay_schedule(3e-3, steps), weight_decay=1e-3)

    @jax.jit
    def step(layers: Any, state: Any, batch: tuple[Array, ...]) -> tuple[Any, Any]:
        updates, state = tx.update(jax.grad(loss)(layers, *batch), state, layers)
        return optax.apply_updates(layers, updates), state

    state = tx.init(layers)
    for _ in range(steps):
        used = rng.integers(0, len(x), BATCH)
        layers, state = step(layers, state, (x[used], y[used], offset[used]))
    return {**fixed, "layers": layers}


def initial_layers(rng: np.random.Generator, sizes: tuple[int, ...]) -> dict[str, Any]:
    """Dense layers of these widths, with He's initial weights."""
    return {str(i): {"kernel": jnp.asarray(rng.normal(0, np.sqrt(2 / a), (a, b)), jnp.float32),
                     "bias": jnp.zeros(b)}
            for i, (a, b) in enumerate(itertools.pairwise(sizes))}


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
