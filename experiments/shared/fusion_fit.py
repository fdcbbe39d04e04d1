"""The fit of the fusion network (refine/fusion.py), and its errors on recordings not seen."""

from __future__ import annotations

import operator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from evflow.estimation.refine import fused
from evflow.estimation.refine.fusion import FusionNet
from evflow.estimation.refine.path_signs import NAMES, NEEDED
from evflow.network.coordinates import squash
from experiments.shared.rows import Rows

Array = jax.Array

FOLDS = 5
JITTER, DEGREES = 0.5, 8.0  # in standard deviations; of Student's t
NETWORKS = 4  # of other initial values; single ones differ by .9 % in theta (median)
HIDDEN = 0.15  # share of cameras found ideal that count as not searched, as with pixel="ideal"
RATE, RATE_CONTINUED = 3e-3, 3e-4  # the latter in few steps: what was learnt is only adjusted


def fit(rows: Rows, steps: int, seed: int, start: dict[str, Any] | None = None) -> dict[str, Any]:
    """The fusion's parameters from rows, in so many steps, from `start` (a fusion) or anew."""
    scaling = scaling_of(rows["features"], start)
    fusion = {k: jnp.asarray(v, jnp.float32) for k, v in scaling.items()}
    x = rows["features"]
    data = {k: jnp.asarray(rows[k], jnp.float32) for k in ("features", "y", "true")}

    searched = x.shape[1] - len(NAMES)
    ideal = data["features"][:, searched + NEEDED, None] == 0

    def loss(net: Any, key: Array) -> Array:
        k_hidden, k_noise = jax.random.split(key)
        hidden = ideal & jax.random.bernoulli(k_hidden, HIDDEN, ideal.shape)
        features = data["features"].at[:, searched:].multiply(~hidden)
        # Jitter: some thousand recordings support little more than a linear map of the features.
        noise = JITTER * jax.random.normal(k_noise, features.shape)
        features = features + fusion["scale"][None] * noise
        alone = jax.tree.map(lambda leaf: leaf[None], net)
        y, std = predict({**fusion, "net": alone}, features, data["y"])
        error = (data["true"] - y) / std
        # Student's t bounds the influence of a few uninformative recordings.
        heavy = 0.5 * (DEGREES + 1) * jnp.log1p(error**2 / DEGREES)
        return (jnp.log(std) + heavy).mean()

    rate = RATE_CONTINUED if start else RATE
    tx = optax.adamw(optax.cosine_decay_schedule(rate, steps), weight_decay=1.0)

    def step(carry: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], None]:
        net, state = carry
        updates, state = tx.update(jax.grad(loss)(net, key), state, net)
        return (optax.apply_updates(net, updates), state), None

    @jax.jit
    def fitted(net: Any, key: Array) -> Any:
        (net, _), _ = jax.lax.scan(step, (net, tx.init(net)), jax.random.split(key, steps))
        return net

    nets = []
    for i, key in enumerate(jax.random.split(jax.random.key(seed), NETWORKS)):
        k_init, k_steps = jax.random.split(key)
        first = (jax.tree.map(operator.itemgetter(i), start["net"]) if start
                 else FusionNet().init(k_init, data["features"][0])["params"])
        nets.append(fitted(first, k_steps))
    return {**fusion, "net": jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets)}


def scaling_of(features: np.ndarray, start: dict[str, Any] | None) -> dict[str, Any]:
    """How a fusion scales and clips features (N, F): as `start` does, whose range is extended."""
    low, high = np.quantile(features, [0.003, 0.997], 0)
    if start is None:
        return {"mean": features.mean(0), "scale": features.std(0) + 0.05, "low": low,
                "high": high, "widen": np.ones(6)}
    return {"mean": start["mean"], "scale": start["scale"], "low": np.minimum(start["low"], low),
            "high": np.maximum(start["high"], high), "widen": np.ones(6)}


def predict(fusion: dict[str, Any], features: Array, y: Array) -> tuple[Array, Array]:
    """y and std (N, 6) of features (N, F) and the stepped estimates y (N, 6)."""
    return jax.vmap(partial(fused, fusion))(features, y)


def cross_validated(
    rows: Rows, steps: int, seed: int, start: dict[str, Any] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """y and std (N, 6) of every recording by a fusion that has not seen it."""
    y, std = np.zeros_like(rows["y"]), np.zeros_like(rows["y"])
    fold = folds_of(len(y), seed)
    for f in range(FOLDS):
        fusion = fit({k: v[fold != f] for k, v in rows.items()}, steps, seed, start)
        y[fold == f], std[fold == f] = predict(
            fusion, jnp.asarray(rows["features"][fold == f]), jnp.asarray(rows["y"][fold == f]))
    return y, std


def folds_of(count: int, seed: int) -> np.ndarray:
    """(N,) the fold of each recording, at random: kinds of cameras come at regular numbers."""
    return np.random.default_rng(seed).permutation(count) % FOLDS


def figures_of(rows: Rows, y: np.ndarray, std: np.ndarray) -> dict[str, Any]:
    """Mean |theta| and |eta| errors of network, steps and fusion over recordings with 200 signal
    events of the polarity; coverage of 68 and 95 % over all recordings, and `of_kinds`."""
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
    return figures | of_kinds(rows, y, std)


def of_kinds(rows: Rows, y: np.ndarray, std: np.ndarray) -> dict[str, Any]:
    """Median relative |theta| error, coverage and median relative std of both thresholds, of
    cameras found ideal and of others."""
    needed = rows["features"][:, NEEDED - len(NAMES)] > 0
    found, true, above = (np.asarray(jnp.stack([squash(jnp.asarray(v[:, :4])).theta_on,
                                                squash(jnp.asarray(v[:, :4])).theta_off], 1))
                          for v in (y, rows["true"], y + std))
    figures: dict[str, Any] = {}
    for kind, which in (("ideal", ~needed), ("other", needed)):
        miss = (np.abs(y - rows["true"]) / std)[which, :2]
        figures |= {f"{kind}/recordings": int(which.sum()),
                    f"{kind}/theta": float(np.median(np.abs(found / true - 1)[which])),
                    f"{kind}/inside_68": float((miss < 1).mean()),
                    f"{kind}/inside_95": float((miss < 1.96).mean()),
                    f"{kind}/std": float(np.median((above / found - 1)[which]))}
    return figures
