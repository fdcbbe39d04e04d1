"""Layer names in published PyTorch checkpoints."""

from __future__ import annotations

from evflow.downstream.e2vid import E2VID
from evflow.downstream.evflownet import BLOCKS, EVFlowNet
from evflow.downstream.firenet import FireNet
from evflow.downstream.network import Network

PREFIXES = ("unetrecurrent.", "unet.", "net.")  # of a module around the whole network
LEAVES = {"weight": "kernel", "bias": "bias", "running_mean": "mean", "running_var": "var"}

_GATES = ("reset", "update", "out")
_HALVES = {1: "first", 2: "second"}  # of a residual block


def modules(network: Network) -> dict[str, str]:
    """Our layer by each module name that a file of this network may have."""
    if isinstance(network, E2VID):
        return _e2vid(network)
    if isinstance(network, FireNet):
        return _firenet()
    assert isinstance(network, EVFlowNet)
    return _evflownet(network)


def published(network: Network, path: str) -> str:
    """The published names of the weights at our path, "a or b" where files differ."""
    layer, _, ours = path.rpartition("/")
    leaf = next((theirs for theirs, name in LEAVES.items() if name == ours), "weight")
    return " or ".join(
        f"{module}.{leaf}" for module, mine in modules(network).items() if mine == layer)


def _e2vid(network: E2VID) -> dict[str, str]:
    found = {"head.conv2d": "head/conv", "pred.conv2d": "prediction/conv",
             "pred.norm_layer": "prediction/norm"}
    for i in range(network.encoders):
        found |= {f"encoders.{i}.conv.conv2d": f"encoder_{i}/conv",
                  f"encoders.{i}.conv.norm_layer": f"encoder_{i}/norm",
                  f"encoders.{i}.recurrent_block.Gates": f"lstm_{i}/gates"}
        if network.decoder == "transposed":
            found |= {f"decoders.{i}.transposed_conv2d": f"decoder_{i}",
                      f"decoders.{i}.norm_layer": f"decoder_{i}/norm"}
        else:
            found |= {f"decoders.{i}.conv2d": f"decoder_{i}/layer/conv",
                      f"decoders.{i}.norm_layer": f"decoder_{i}/layer/norm"}
    for i in range(network.blocks):
        found |= _block(f"resblocks.{i}", i)
        found |= {f"resblocks.{i}.bn{k}": f"block_{i}/{half}/norm" for k, half in _HALVES.items()}
    return found


def _firenet() -> dict[str, str]:
    """S2R's names, and those of the legacy code of 2020: one network."""
    found = {"head.conv2d": "head/conv", "head.conv.conv2d": "head/conv",
             "pred.conv2d": "prediction/conv"}
    units = (("G1", "R1", "head.recurrent_block", "resblocks.0.conv"),
             ("G2", "R2", "resblocks.0.recurrent_block", "resblocks.1"))
    for i, (gru, block, legacy_gru, legacy_block) in enumerate(units):
        found |= {f"{unit}.{gate}_gate": f"gru_{i}/{gate}"
                  for unit in (gru, legacy_gru) for gate in _GATES}
        found |= _block(block, i) | _block(legacy_block, i)
    return found


def _evflownet(network: EVFlowNet) -> dict[str, str]:
    found = {"pred.conv2d": "prediction/conv"}
    for i in range(network.encoders):
        found |= {f"encoders.{i}.conv2d": f"encoder_{i}/conv",
                  f"decoders.{i}.conv2d": f"decoder_{i}/conv"}
    for i in range(BLOCKS):
        found |= _block(f"resblocks.{i}", i)
    return found


def _block(name: str, i: int) -> dict[str, str]:
    return {f"{name}.conv{k}": f"block_{i}/{half}/conv" for k, half in _HALVES.items()}
