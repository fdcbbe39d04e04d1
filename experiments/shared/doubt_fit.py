"""The fit of refine/doubt.py, and how well it does on recordings that it has not seen."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from evflow.estimation.refine.doubt import MOST_DEVIATIONS, relative_error
from experiments.shared.rows import Rows

FOLDS, STEPS = 5, 2000
RIDGE = 20.0  # precision of the prior of a sign's weight, about 0
DEGREES = 8.0  # of Student's t, which bounds the influence of a few uninformative recordings


def fit(x: np.ndarray, left: np.ndarray, before: np.ndarray) -> dict[str, np.ndarray]:
    """The map from signs (N, F), errors of log theta (N,) and their std before (N,)."""
    net: dict[str, Any] = {"mean": x.mean(0), "scale": x.std(0) + 0.05}
    z = np.clip((x - net["mean"]) / net["scale"], -MOST_DEVIATIONS, MOST_DEVIATIONS)
    z = jnp.asarray(np.concatenate([z, np.ones((len(z), 1))], -1))
    y, start = jnp.asarray(left), float(np.log(before.mean()))

    def loss(spread: jax.Array) -> jax.Array:
        log_std = start + z @ spread
        likely = log_std + 0.5 * (DEGREES + 1) * jnp.log1p((y / jnp.exp(log_std)) ** 2 / DEGREES)
        return likely.sum() + 0.5 * RIDGE * (spread[:-1] ** 2).sum()

    tx = optax.adam(optax.cosine_decay_schedule(0.02, STEPS))
    spread = jnp.zeros(z.shape[1])

    def step(carry: Any, _: None) -> tuple[Any, None]:
        spread, state = carry
        updates, state = tx.update(jax.grad(loss)(spread), state)
        return (optax.apply_updates(spread, updates), state), None

    (spread, _), _ = jax.jit(lambda c: jax.lax.scan(step, c, None, STEPS))(
        (spread, tx.init(spread)))
    net["map"] = np.array(spread)
    net["map"][-1] += start
    return net


def flat(rows: Rows) -> Rows:
    """Both polarities of every recording, one after the other."""
    return {k: v.reshape(-1, *v.shape[2:]) for k, v in rows.items()}


def cross_validated(rows: Rows) -> np.ndarray:
    """Std of log theta (2 N,), by a fit that has not seen the recording."""
    fold = np.repeat(np.arange(len(rows["left"])) % FOLDS, 2)
    both = flat(rows)
    std = np.zeros(len(fold))
    for f in range(FOLDS):
        net = fit(*(both[k][fold != f] for k in ("signs", "left", "before")))
        std[fold == f] = relative_error(net, both["signs"][fold == f])
    return std


def figures_of(left: np.ndarray, std: np.ndarray, label: str) -> dict[str, float]:
    """Coverage of errors of log theta (N,) by their std, under a label."""
    z = np.abs(left) / std
    return {f"{label}/median_std": float(np.median(std)),
            f"{label}/inside_68": float((z < 1).mean()),
            f"{label}/inside_95": float((z < 1.96).mean())}
