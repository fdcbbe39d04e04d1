"""The forward flow for inference: actnorm and shuffle folded into the coupling weights.

Between its couplings a level only scales, offsets and reorders channels. If channels g are kept as
they enter the level, a step's own channels are h[j] = scale[c] (g[c] + offset[c]) with
c = channel[j]. So every coupling becomes g + f'(g, u) with weights as wide as the level, zero for
channels that are not in A (inputs) or not in B (outputs), and one affine map ends the level: the
same function up to rounding, with no pass over the activations except the products.

Pixels are columns, as in dense.py, except in the arguments and results of `forward_folded`. A
step's input is [g, u] in one array, of which only g changes, so that its first layer is one
product.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from evflow.network.flow import actnorm, injector, shuffle
from evflow.network.flow.config import Array, FlowConfig, Params
from evflow.network.flow.dense import dense
from evflow.process import chunks


def fold(params: Params, config: FlowConfig) -> Params:
    """Params of the same flow for `forward_folded`: fold once, then use for many pixels."""
    folded: Params = {}
    for index, order in enumerate(shuffle.orders(config)):
        level = params[f"level_{index}"]
        before, after = _channel_at(order)
        position = np.argsort(before, axis=1)  # where a step's actnorm finds each channel
        log_scale = actnorm.log_scale(level["actnorm"])
        scale = jnp.exp(jnp.cumsum(jnp.take_along_axis(log_scale, position, axis=1), axis=0))
        bias = jnp.take_along_axis(level["actnorm"]["bias"], position, axis=1)
        offset = jnp.cumsum(bias / scale, axis=0)
        folded[f"level_{index}"] = {
            **level,
            "actnorm": {"scale": scale[-1], "bias": scale[-1] * offset[-1]},
            "coupling": jax.vmap(_fold_step)(level["coupling"], scale, offset, jnp.asarray(after)),
        }
    return folded


def settle(folded: Params, values: Array, at: int) -> Params:
    """Folded params for pixels that share the condition's channels at, at + 1, ...: their `values`
    (k,) move into the biases, and u is passed without them."""
    def settled(layers: Params, first: int) -> Params:
        w = layers["w_1"]
        before, same, after = jnp.split(w, [first, first + len(values)], axis=-2)
        return {**layers, "w_1": jnp.concatenate([before, after], -2),
                "b_1": layers["b_1"] + jnp.matmul(values, same, precision="highest")}

    ready: Params = {}
    for name, level in folded.items():
        channels = level["coupling"]["offset"].shape[-1]
        ready[name] = {**level, "coupling": settled(level["coupling"], channels + at)}
        if "injector" in level:
            ready[name]["injector"] = settled(level["injector"], at)
    return ready


def forward_folded(
    folded: Params, x: Array, u: Array, config: FlowConfig, *, chunk: int | None = None
) -> tuple[Array, Array]:
    """`forward` without the log-det: x (..., channels), u (..., condition) -> y, z.

    chunk: pixels processed at a time, 2 kB each; None chooses by the platform (chunks.py).
    """
    pixels = x.shape[:-1]
    rows = (x.reshape(-1, x.shape[-1]), u.reshape(-1, u.shape[-1]))

    def run(rows: tuple[Array, Array]) -> tuple[Array, Array]:
        y, z = forward_columns(folded, rows[0].T, rows[1].T, config)
        return y.T, z.T

    if chunk is None:
        y, z = chunks.by_platform(run, rows, alone=True)
    else:
        y, z = chunks.in_chunks(run, rows, chunk)
    return y.reshape(*pixels, y.shape[1]), z.reshape(*pixels, z.shape[1])


def forward_columns(
    folded: Params, x: Array, u: Array, config: FlowConfig
) -> tuple[Array, Array]:
    """x (channels, n), u (condition, n) -> y (width of the last level, n), z (the rest, n)."""
    h = jnp.arcsinh(x) if config.asinh else x
    z = h[:0]
    for index, order in enumerate(shuffle.orders(config)):
        if index:
            h, left = jnp.split(h, 2)
            z = jnp.concatenate([z, left])
        level = folded[f"level_{index}"]
        if config.injector:
            h, _ = injector.forward(level["injector"], h, u)
        gu, _ = jax.lax.scan(
            lambda gu, w: (_step(w, gu), None), jnp.concatenate([h, u]), level["coupling"])
        h = actnorm.forward(**level["actnorm"], h=gu[:len(h)])
        h = shuffle.apply(h, _channel_at(order)[1][-1])
    return h, z


def _channel_at(order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(steps, C): which of the level's channels is at position j before, after each shuffle."""
    held = [np.arange(order.shape[1], dtype=order.dtype)]
    for shuffled in order:
        held.append(held[-1][shuffled])
    return np.stack(held[:-1]), np.stack(held[1:])


def _fold_step(params: Params, scale: Array, offset: Array, channel: Array) -> Params:
    """One coupling's weights on the level's own channels; scale, offset, channel (C,)."""
    a, b = jnp.split(channel, 2)
    w_h = params["w_h"] * scale[a][:, None]
    last = jnp.concatenate([params["w_3"], params["b_3"][None]])  # (hidden + 1, C/2)
    nothing = jnp.zeros((len(last), len(channel)), last.dtype)
    last = nothing.at[:, b].set(last / scale[b][None])
    w_g = jnp.zeros((len(channel), w_h.shape[1]), w_h.dtype).at[a].set(w_h)
    return {
        "w_1": jnp.concatenate([w_g, params["w_u"]]),
        "b_1": params["b_1"] + jnp.matmul(offset[a], w_h, precision="highest"),
        "w_2": params["w_2"],
        "b_2": params["b_2"],
        "w_3": last[:-1],
        "b_3": last[-1],
        "offset": offset,
    }


def _step(params: Params, gu: Array) -> Array:
    """[g, u] -> [g + f'(g, u), u]: zeros in the weights let a coupling read A and change B only."""
    hidden = jax.nn.relu(dense(params["w_1"], params["b_1"], gu))
    hidden = jax.nn.relu(dense(params["w_2"], params["b_2"], hidden))
    out = dense(params["w_3"], params["b_3"], hidden)
    return gu.at[:len(out)].add(out)
