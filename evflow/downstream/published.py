"""Published weights as params, matched by the names and shapes of their PyTorch modules.

E2VID, E2VID+, FireNet (2020 and S2R's), EV-FlowNet (S2R's). The structure (sizes, decoder, norm,
skips) is derived from the arrays, so that networks of other sizes trained by the same code load
too.
"""

from __future__ import annotations

import os
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.downstream.e2vid import E2VID
from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.firenet import FireNet
from evflow.downstream.network import Network, Params
from evflow.downstream.published_names import LEAVES, PREFIXES, modules, published
from evflow.downstream.torch_file import read_checkpoint
from evflow.errors import EvflowDataError, naming

Arrays = dict[str, np.ndarray]

SPLIT_BINS = 10  # S2R's later models: five of ON events, then five of OFF


def load_published(path: str | os.PathLike) -> tuple[Network, Params]:
    """The network and params of a published PyTorch checkpoint; no PyTorch is needed.

    Raises as `read_checkpoint`, EV007 where weights are not finite, EV018 for unknown networks.
    """
    return read_published(path)[:2]


def read_published(path: str | os.PathLike) -> tuple[Network, Params, bool]:
    """`load_published`, and whether the network needs normalised event tensors."""
    checkpoint = read_checkpoint(path)
    with naming(path):
        network = recognise(checkpoint.arrays, checkpoint.settings)
        params = to_params(network, checkpoint.arrays)
        return network, params, normalised(network, checkpoint.arrays)


def normalised(network: Network, arrays: Arrays) -> bool:
    """E2VID of 2019 and FireNet of 2020 were trained on normalised tensors; E2VID+, FireNet+ and
    EV-FlowNet were not. The two FireNets have one structure, and differ by the layers' names."""
    if isinstance(network, FireNet):
        return any("head.recurrent_block" in name for name in arrays)
    return isinstance(network, E2VID) and network.output == "sigmoid"


def recognise(arrays: Arrays, settings: dict[str, Any] | None = None) -> Network:
    """The network of a state dict; EV018 if it is unknown.

    The output's activation and the padding are not in the weights: E2VID's own files, which
    have settings under "model" or batch norm, are sigmoid (if "final_activation" there is no
    other) and mirrored, S2R's linear and zeros.
    """
    arrays = _stripped(arrays)
    names = " ".join(arrays)

    def count(pattern: str) -> int:
        return sum(re.fullmatch(pattern, name) is not None for name in arrays)

    if "recurrent_block.Gates" in names:
        base, bins = _conv_sizes(arrays, "head.conv2d.weight")
        batch = "running_mean" in names
        stated = (settings or {}).get("model")
        original = batch or stated is not None
        last = stated.get("final_activation", "sigmoid") if isinstance(stated, dict) else "sigmoid"
        return E2VID(
            bins=bins, base=base,
            encoders=count(r"encoders\.\d\.recurrent_block\.Gates\.weight"),
            blocks=count(r"resblocks\.\d\.conv1\.weight"),
            decoder="transposed" if "transposed_conv2d" in names else "upsample",
            norm="batch" if batch else "none",
            skip="sum" if _conv_sizes(arrays, "pred.conv2d.weight")[1] == base else "concat",
            output="sigmoid" if original and last == "sigmoid" else "linear",
            padding="reflect" if original else "zeros")
    if "update_gate" in names:
        legacy = "head.conv.conv2d.weight"
        base, bins = _conv_sizes(arrays, legacy if legacy in arrays else "head.conv2d.weight")
        return FireNet(bins=bins, base=base)
    if count(r"encoders\.\d\.conv2d\.weight") and count(r"pred\.conv2d\.weight"):
        base, bins = _conv_sizes(arrays, "encoders.0.conv2d.weight")
        return EVFlowNet(bins=bins, base=base)
    raise EvflowDataError(
        "EV018", f"the weights are of no known network (they begin with {sorted(arrays)[:3]}).",
        "E2VID, E2VID+, FireNet and S2R's EV-FlowNet are known.")


def to_params(network: Network, arrays: Arrays) -> Params:
    """The state dict as params of `network`; EV018 where a name or a shape does not fit."""
    expected = {join(keys): leaf.shape for keys, leaf in jax.tree_util.tree_leaves_with_path(
        jax.eval_shape(lambda: network.init(jax.random.key(0), (16, 16))))}
    layers, found, own = modules(network), {}, {}
    for name, array in _stripped(arrays).items():
        if not name.endswith(".num_batches_tracked"):
            module, _, leaf = name.rpartition(".")
            if module not in layers or leaf not in LEAVES:
                raise EvflowDataError(
                    "EV018", f"{_called(network)} has nothing called {name[:80]!r}.")
            path, value = _ours(layers[module], leaf, array, "transposed" in module)
            found[path] = value
            own[path] = next(p + name for p in ("", *PREFIXES) if p + name in arrays)
    if missing := sorted(expected.keys() - found.keys()):
        listed = ", ".join(f"{path} ({published(network, path)})" for path in missing[:3])
        raise EvflowDataError("EV018", f"the weights of {_called(network)} lack {listed}.")
    params: Params = {}
    for path, value in found.items():
        if expected.get(path) != value.shape:
            raise EvflowDataError(
                "EV018", f"{path} ({own[path]} of {arrays[own[path]].shape}) is {value.shape}; "
                f"{_called(network)} has {expected.get(path, 'no such layer')}.")
        *parents, leaf = path.split("/")
        node = params
        for part in parents:
            node = node.setdefault(part, {})
        with np.errstate(over="ignore"):
            node[leaf] = jnp.asarray(value.astype(np.float32))
        if not np.isfinite(np.asarray(node[leaf])).all():
            raise EvflowDataError("EV007", f"{path} is not all finite (in float32).",
                                  "A training that diverged? Take an earlier checkpoint.")
    return params


def _ours(layer: str, leaf: str, array: np.ndarray, transposed: bool) -> tuple[str, np.ndarray]:
    """Our path and layout of one published array."""
    if leaf == "weight" and array.ndim == 1:
        return f"{layer}/scale", array
    if leaf == "weight" and array.ndim == 4:
        if transposed:  # (in, out, h, w), of which a convolution takes the mirror image
            return f"{layer}/kernel", array[:, :, ::-1, ::-1].transpose(2, 3, 0, 1)
        return f"{layer}/kernel", array.transpose(2, 3, 1, 0)
    return f"{layer}/{LEAVES[leaf]}", array


def _stripped(arrays: Arrays) -> Arrays:
    """Names without the prefix of a module around the network. Names without it are unchanged, and
    will be reported as foreign."""
    for prefix in PREFIXES:
        if any(name.startswith(prefix) for name in arrays):
            return {name.removeprefix(prefix): array for name, array in arrays.items()}
    return arrays


def _conv_sizes(arrays: Arrays, name: str) -> tuple[int, int]:
    """(out, in) channels of a convolution."""
    if name not in arrays or arrays[name].ndim != 4 or not arrays[name].size:
        raise EvflowDataError("EV018", f"{name} is no kernel of a convolution, or absent.")
    return arrays[name].shape[0], arrays[name].shape[1]


def _called(network: Network) -> str:
    return type(network).__name__


def join(keys: Any) -> str:
    """The path of a leaf of params."""
    return "/".join(str(k.key) for k in keys)
