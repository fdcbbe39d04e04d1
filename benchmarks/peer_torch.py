"""The network's peer: the same functions of the same weights in plain eager PyTorch.

Rows are pixels; every flow step is scale, index, concatenate, three linear layers, as it is
usually written. `weights(params)` turns evflow's dict into tensors, so outputs can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
import torch
import torch.nn.functional as F

from evflow.network.config import ModelConfig
from evflow.network.coordinates import CENTRE, SCALE
from evflow.network.encoder import LOG_RANGE
from evflow.network.flow import FlowConfig, actnorm, injector, shuffle

Tensor = torch.Tensor
Weights = dict[str, Any]
THETA_SCALE, THETA_CENTRE = (torch.tensor(np.asarray(a[:2])) for a in (SCALE, CENTRE))


def weights(params: Any) -> Weights:
    """A nested dict of JAX arrays as float32 tensors; a coupling's first layer in one piece."""
    net = jax.tree.map(lambda a: torch.tensor(np.asarray(a)), params)
    for level in net.get("flow", net).values():
        if "coupling" in level:
            w = level["coupling"]
            w["w_1"] = torch.cat([w.pop("w_h"), w.pop("w_u")], 1)
    return net


def flow(net: Weights, x: Tensor, u: Tensor, config: FlowConfig) -> tuple[Tensor, Tensor, Tensor]:
    """x (N, channels), u (N, condition) -> y (N, 4), z (N, 28), log-det (N,); as `forward`."""
    log_det = x.new_zeros(len(x))
    if config.asinh:
        x = torch.asinh(x)
        log_det = log_det - (x.abs() + torch.log1p(torch.exp(-2 * x.abs())) - math.log(2)).sum(1)
    left: list[Tensor] = []
    for index, order in enumerate(shuffle.orders(config)):
        if index:
            x, z = x.chunk(2, 1)
            left.append(z)
        level = net[f"level_{index}"]
        if config.injector:
            part = level["injector"]
            hidden = F.relu(linear(part["w_1"], part["b_1"], u))
            raw, shift = linear(part["w_2"], part["b_2"], hidden).chunk(2, 1)
            s = injector.LOG_SCALE_BOUND * torch.tanh(raw)
            x, log_det = x * torch.exp(s) + shift, log_det + s.sum(1)
        norm = level["actnorm"]
        s = norm["base"] + actnorm.LOG_SCALE_BOUND * torch.tanh(norm["raw"])
        log_det = log_det + s.sum()
        for k in range(config.steps):
            x = x * torch.exp(s[k]) + norm["bias"][k]
            x = x.index_select(1, torch.from_numpy(order[k]))
            x = _couple({name: w[k] for name, w in level["coupling"].items()}, x, u)
    return x, torch.cat(left, 1), log_det


def linear(w: Tensor, b: Tensor, x: Tensor) -> Tensor:
    """x (..., i), w (i, o), b (o,) -> (..., o), in one call."""
    return F.linear(x, w.mT, b)


def _couple(w: Weights, x: Tensor, u: Tensor) -> Tensor:
    a, b = x.chunk(2, 1)
    first = linear(w["w_1"], w["b_1"], torch.cat([a, u], 1))
    second = linear(w["w_2"], w["b_2"], F.relu(first))
    return torch.cat([a, b + linear(w["w_3"], w["b_3"], F.relu(second))], 1)


def estimate(
    net: Weights, voxels: Tensor, dlogI: Tensor, context: Tensor, y: Tensor, config: ModelConfig
) -> tuple[Tensor, Tensor]:
    """Encoder, flow and spread of the default architecture: voxels (N, 32), dlogI (N,), context
    (N, 3), summary y (N, 6) -> y (N, 4) and its standard deviation (N, 4)."""
    theta = torch.exp(y[:, :2] * THETA_SCALE + THETA_CENTRE)
    seen = _pixel_features(voxels, dlogI, context)
    on, off = voxels.chunk(2, 1)
    on, off = on * theta[:, :1], off * theta[:, 1:]
    missing = dlogI - on.sum(1) + off.sum(1)
    features = torch.cat(
        [seen, torch.asinh(10 * on), torch.asinh(10 * off), 5 * missing[:, None], y], 1)
    up, down = (LOG_RANGE * torch.sigmoid(_encoder(net["encoder"], features, config))).unbind(-1)
    u = torch.cat([torch.asinh(up / theta[:, :1]), torch.asinh(down / theta[:, 1:]), y, context], 1)
    residual = flow(net["flow"], voxels, u, config.flow)[0]
    spread = torch.cat([seen, u], 1)
    for name in ("Dense_0", "Dense_1"):
        spread = F.relu(_dense(net["spread"][name], spread))
    spread = torch.exp(torch.clamp(_dense(net["spread"]["Dense_2"], spread) - 1, -5, 2))
    return residual + y[:, :4], spread


def in_chunks(
    estimate: Callable[..., tuple[Tensor, Tensor]], net: Weights, inputs: list[Tensor], rows: int
) -> tuple[Tensor, Tensor]:
    """`estimate` of [voxels, dlogI, context, y] a few rows at a time, so that activations stay
    in cache."""
    parts = [estimate(net, voxels, dlogI, context, y) for voxels, dlogI, context, y
             in zip(*(a.split(rows) for a in inputs), strict=True)]
    y, std = zip(*parts, strict=True)
    return torch.cat(y), torch.cat(std)


def on_each_core(
    estimate: Callable[..., tuple[Tensor, Tensor]], net: Weights, inputs: list[Tensor], rows: int,
    cores: int,
) -> tuple[Tensor, Tensor]:
    """`in_chunks` of equal shares of the inputs, each on a core of its own."""
    torch.set_num_threads(1)

    def share(*inputs: Tensor) -> tuple[Tensor, Tensor]:
        torch.set_num_threads(1)  # this and the next belong to a thread
        with torch.no_grad():
            return in_chunks(estimate, net, list(inputs), rows)

    size = -(-len(inputs[0]) // cores)
    with ThreadPoolExecutor(cores) as pool:
        y, std = zip(*pool.map(share, *(a.split(size) for a in inputs)), strict=True)
    return torch.cat(y), torch.cat(std)


def _pixel_features(voxels: Tensor, dlogI: Tensor, context: Tensor) -> Tensor:
    on, off = (half.sum(1) for half in voxels.chunk(2, 1))
    scalars = [5 * dlogI, torch.asinh(10 * dlogI), torch.asinh(10 * dlogI.abs()),
               torch.asinh(on), torch.asinh(off), torch.asinh(on - off)]
    return torch.cat([torch.asinh(voxels), torch.stack(scalars, 1), context], 1)


def _dense(layer: Weights, x: Tensor) -> Tensor:
    return linear(layer["kernel"], layer["bias"], x)


def _encoder(net: Weights, x: Tensor, config: ModelConfig) -> Tensor:
    """Logits (N, m, 2)."""
    def layer(x: Tensor, index: int) -> Tensor:
        x, norm = _dense(net[f"Dense_{index}"], x), net[f"LayerNorm_{index}"]
        return F.relu(F.layer_norm(x, x.shape[-1:], norm["scale"], norm["bias"], 1e-6))

    x = layer(layer(x, 0), 1).reshape(-1, config.changes, config.piece)
    return _dense(net["Dense_4"], layer(layer(x, 2), 3))


def nll(net: Weights, x: Tensor, u: Tensor, config: FlowConfig) -> Tensor:
    """Mean negative log-likelihood per pixel under N(0, 1) latents (Eq. 3)."""
    y, z, log_det = flow(net, x, u, config)
    latent = torch.cat([y, z], 1)
    prior = -0.5 * (latent**2).sum(1) - 0.5 * math.log(2 * math.pi) * latent.shape[1]
    return -(prior + log_det).mean()
