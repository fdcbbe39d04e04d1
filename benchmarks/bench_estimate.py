"""Camera maps from one 346x260 window: the whole `estimate`, its per-pixel part, the flow alone.

The peer is the same network in plain PyTorch on the CPU (peer_torch.py): whole frame at once, in
chunks, compiled, and in chunks on every core by itself, as evflow does. Both are given the camera
summary where the task says so. GFLOP counts the dense layers as the model defines them: 2 x inputs
x outputs each, nothing for what folding adds or saves.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType
from jax.sharding import PartitionSpec as P

from benchmarks.harness import Case, Setting, Workload, cores
from evflow.camera import Camera, Summary
from evflow.errors import EvflowDataError
from evflow.network import flow
from evflow.network.api import estimate, estimate_y, finish, summarize
from evflow.network.architecture import config_of, init
from evflow.network.config import MODELS, ModelConfig
from evflow.network.coordinates import unsquash_summary
from evflow.network.weights import load_weights
from evflow.training.config import PRESETS

Params = dict[str, Any]
# On one core 1024 rows are faster: 2.5 s of CPU a frame, 3.3 with 2048 (2.7 if compiled, in both).
WINDOW_S, TORCH_ROWS, CORE_ROWS = 0.05, 2048, 1024


fresh = jax.jit(init, static_argnums=1)


def network(setting: Setting) -> tuple[Params, str]:
    """Released weights, or fresh ones of the same sizes; and which."""
    if setting.quick:
        return fresh(jax.random.key(0), PRESETS["debug"].model), "debug sizes"
    try:
        return load_weights(), "released weights"
    except EvflowDataError:
        return fresh(jax.random.key(0), MODELS["default"]), "untrained weights"


def window(setting: Setting) -> tuple[jax.Array, jax.Array]:
    """voxels (H, W, 32) of which a third of the pixels are active, dlogI (H, W)."""
    shape = (24, 16) if setting.quick else (260, 346)
    rng = np.random.default_rng(0)
    active = rng.random((*shape, 1)) < 0.33
    voxels = rng.poisson(0.2, (*shape, 32)) * active
    dlogI = (voxels[..., :16].sum(-1) - voxels[..., 16:].sum(-1)) * 0.2
    return jnp.asarray(voxels, jnp.float32), jnp.asarray(dlogI, jnp.float32)


def known_summary() -> Summary:
    return Summary(*(jnp.float32(v) for v in (0.2, 0.25, 0.1, 0.1, 0.03, 0.03)))


def dense_flop(params: Params, *parts: str) -> int:
    """Floating-point operations per pixel of the dense layers in those parts of the network."""
    config, net = config_of(params), next(iter(params.values()))
    total = 0
    for path, leaf in jax.tree_util.tree_leaves_with_path({part: net[part] for part in parts}):
        name = "/".join(str(k.key) for k in path)
        # Not a matrix of a pixel: biases (also stacked over steps), actnorms, the camera-wide net.
        if not name.endswith(("kernel", "w_h", "w_u", "w_1", "w_2", "w_3")) or "/finish/" in name:
            continue
        second_stage = name in {f"encoder/Dense_{i}/kernel" for i in (2, 3, 4)}
        total += 2 * leaf.size * (config.changes if second_stage else 1)
    return total


PIXEL_PARTS = ("encoder", "flow", "spread")


def _work(params: Params, pixels: int, *parts: str) -> Any:
    gflop = 1e-9 * pixels * dense_flop(params, *parts)
    return lambda _: {"frames": 1, "GFLOP": gflop}


def whole(setting: Setting) -> Workload:
    """`estimate` as users call it; with more devices, rows of the image split over them."""
    (params, note), (voxels, dlogI) = network(setting), window(setting)
    call = partial(estimate, params, voxels, dlogI, window_s=WINDOW_S)
    if setting.devices > 1:
        call, note = partial(sharded(setting), params, voxels, dlogI), f"{note}, shard_map"
    return Workload(call, _work(params, dlogI.size, *PIXEL_PARTS, "summary"), note)


def sharded(setting: Setting) -> Any:
    """estimate over a mesh of devices: statistics of the parts add up to the whole's, and pixels
    are independent given the summary."""
    def part(params: Params, voxels: jax.Array, dlogI: jax.Array) -> Camera:
        stats = jax.lax.psum(summarize(params, voxels, dlogI, window_s=WINDOW_S), "rows")
        return estimate(params, voxels, dlogI, window_s=WINDOW_S, summary=finish(params, stats)[0])

    return split_rows(part, setting)


def split_rows(f: Any, setting: Setting) -> Any:
    """jit of f(params, a, b), the rows of a, b and of the results shared among the devices."""
    if setting.devices == 1:
        return jax.jit(f)
    mesh = jax.make_mesh((setting.devices,), ("rows",), axis_types=(AxisType.Auto,))
    return jax.jit(jax.shard_map(f, mesh=mesh, in_specs=(P(), P("rows"), P("rows")),
                                 out_specs=P("rows")))


def pixels_evflow(setting: Setting) -> Workload:
    (params, note), (voxels, dlogI) = network(setting), window(setting)
    known = partial(estimate_y, window_s=WINDOW_S, summary=known_summary())
    call = split_rows(known, setting) if setting.devices > 1 else known
    return Workload(lambda: call(params, voxels, dlogI),
                    _work(params, dlogI.size, *PIXEL_PARTS), note)


def pixels_torch(
    setting: Setting, rows: int | None, compiled: bool = False, each_core: bool = False
) -> Workload:
    import torch

    from benchmarks import peer_torch

    (params, note), (voxels, dlogI) = network(setting), window(setting)
    n, config = dlogI.size, config_of(params)
    y = np.tile(np.asarray(unsquash_summary(known_summary())), (n, 1))
    inputs = [torch.tensor(np.asarray(a)) for a in (
        voxels.reshape(n, -1), dlogI.reshape(n), np.zeros((n, 3), np.float32), y)]
    net = peer_torch.weights(next(iter(params.values())))

    estimate: Callable[..., Any] = partial(peer_torch.estimate, config=config)
    if compiled and not setting.quick:  # which takes minutes, and a C++ compiler
        estimate = torch.compile(estimate, dynamic=False)

    def call() -> Any:
        with torch.no_grad():
            if each_core:
                return peer_torch.on_each_core(estimate, net, inputs, rows or n, cores())
            return peer_torch.in_chunks(estimate, net, inputs, rows or n)

    return Workload(call, _work(params, n, *PIXEL_PARTS), note)


def flow_inputs(setting: Setting, config: ModelConfig) -> tuple[jax.Array, jax.Array]:
    voxels, _ = window(setting)
    voxels = voxels.reshape(-1, voxels.shape[-1])
    u = jax.random.normal(jax.random.key(1), (len(voxels), config.flow.condition))
    return voxels, u


def flow_evflow(setting: Setting, folded: bool, chunk: int | None = None) -> Workload:
    params, note = network(setting)
    config, net = config_of(params), next(iter(params.values()))["flow"]
    net = flow.fold(net, config.flow) if folded else net
    sizes = {"chunk": chunk} if chunk else {}

    def run(net: Params, x: jax.Array, u: jax.Array) -> Any:
        if folded:
            return flow.forward_folded(net, x, u, config.flow, **sizes)
        return flow.forward(net, x, u, config.flow)

    call, (x, u) = split_rows(run, setting), flow_inputs(setting, config)
    return Workload(lambda: call(net, x, u), _work(params, len(x), "flow"), note)


def flow_torch(setting: Setting) -> Workload:
    import torch

    from benchmarks import peer_torch

    params, note = network(setting)
    config, net = config_of(params), peer_torch.weights(next(iter(params.values()))["flow"])
    x, u = (torch.tensor(np.asarray(a)) for a in flow_inputs(setting, config))

    def call() -> Any:
        with torch.inference_mode():
            return peer_torch.flow(net, x, u, config.flow)

    return Workload(call, _work(params, len(x), "flow"), note)


CASES = (
    Case("estimate", "whole", "evflow", whole, splits=True),
    Case("estimate", "pixels, given the summary", "evflow", pixels_evflow, splits=True),
    Case("estimate", "pixels, given the summary", "torch, eager",
         partial(pixels_torch, rows=None), needs="torch"),
    Case("estimate", "pixels, given the summary", f"torch, {TORCH_ROWS} rows at a time",
         partial(pixels_torch, rows=TORCH_ROWS), needs="torch"),
    Case("estimate", "pixels, given the summary", f"torch.compile, {TORCH_ROWS} rows at a time",
         partial(pixels_torch, rows=TORCH_ROWS, compiled=True), needs="torch"),
    Case("estimate", "pixels, given the summary", f"torch, {CORE_ROWS} rows on each core",
         partial(pixels_torch, rows=CORE_ROWS, each_core=True), needs="torch"),
    Case("estimate", "flow forward", "evflow, folded", partial(flow_evflow, folded=True),
         splits=True),
    Case("estimate", "flow forward", "evflow, folded, chunks of 1024",
         partial(flow_evflow, folded=True, chunk=1024), splits=True),
    Case("estimate", "flow forward", "evflow, unfolded", partial(flow_evflow, folded=False),
         splits=True),
    Case("estimate", "flow forward", "torch, eager", flow_torch, needs="torch"),
)
