"""The fit of refine/correction.py, and how well it does on what it has not seen."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from evflow.estimation.refine.correction import BEYOND, foretold
from experiments.shared.rows import Rows

FOLDS, STEPS = 5, 2000
RIDGE = 20.0  # recordings' worth of evidence that a sign says nothing
DEGREES = 8.0  # of Student's t: a few recordings say nothing and must not decide alone
USUAL = 0.04  # error of log theta that the fit weighs all others against


def fit(x: np.ndarray, left: np.ndarray, before: np.ndarray) -> dict[str, np.ndarray]:
    """The maps from signs (N, F), what is left of log theta (N,) and its std before (N,)."""
    net: dict[str, Any] = {"mean": x.mean(0), "scale": x.std(0) + 0.05,
                           "bias": np.zeros(x.shape[1] + 1), "bias_std": np.zeros(x.shape[1] + 1)}
    z = np.clip((x - net["mean"]) / net["scale"], -BEYOND, BEYOND)
    z = jnp.asarray(np.concatenate([z, np.ones((len(z), 1))], -1))
    y, start = jnp.asarray(left), jnp.log(jnp.asarray(before).mean())

    def loss(maps: tuple[jax.Array, jax.Array]) -> jax.Array:
        bias, spread = maps
        log_std = start + z @ spread
        error = (y - z @ bias) / jnp.exp(log_std)
        likely = log_std + 0.5 * (DEGREES + 1) * jnp.log1p(error**2 / DEGREES)
        held = (bias[:-1] / USUAL) ** 2, spread[:-1] ** 2
        return likely.sum() + 0.5 * RIDGE * (held[0].sum() + held[1].sum())

    tx = optax.adam(optax.cosine_decay_schedule(0.02, STEPS))
    maps = (jnp.zeros(z.shape[1]), jnp.zeros(z.shape[1]))

    def step(carry: Any, _: None) -> tuple[Any, None]:
        maps, state = carry
        updates, state = tx.update(jax.grad(loss)(maps), state)
        return (optax.apply_updates(maps, updates), state), None

    (bias, spread), _ = jax.jit(lambda c: jax.lax.scan(step, c, None, STEPS))(
        (maps, tx.init(maps)))[0]
    net["bias"] = np.asarray(bias)
    net["bias_std"] = np.asarray(spread).copy()
    net["bias_std"][-1] += float(start)
    return net


def flat(rows: Rows) -> Rows:
    """Both polarities of every recording, one after the other."""
    return {k: v.reshape(-1, *v.shape[2:]) for k, v in rows.items()}


def cross_validated(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Change of log theta and its std (2 N,), by a fit that has not seen the recording."""
    fold = np.repeat(np.arange(len(rows["left"])) % FOLDS, 2)
    both = flat(rows)
    change, std = np.zeros(len(fold)), np.zeros(len(fold))
    for f in range(FOLDS):
        net = fit(*(both[k][fold != f] for k in ("signs", "left", "before")))
        change[fold == f], std[fold == f] = foretold(net, both["signs"][fold == f])
    return change, std


def figures_of(left: np.ndarray, std: np.ndarray, label: str) -> dict[str, float]:
    """Of what is left of log theta (N,) and its std."""
    z = np.abs(left) / std
    return {f"{label}/median": float(np.median(np.abs(left))),
            f"{label}/mean": float(np.abs(left).mean()),
            f"{label}/inside_68": float((z < 1).mean()),
            f"{label}/inside_95": float((z < 1.96).mean())}
