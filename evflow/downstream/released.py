"""Released event networks, with architecture and training in the model card.

    trained = load_network("e2vid-small")          # released; or a .safetensors file of a training,
    trained = load_network("E2VID_plus.pth.tar")   # or a published checkpoint
    images = reconstruct(trained.network, trained.params, events, times, **trained.how)
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from evflow.downstream.network import Network, Params
from evflow.downstream.presets import KINDS
from evflow.downstream.published import SPLIT_BINS, read_published
from evflow.errors import EvflowDataError
from evflow.network.weights import load_weights, model_card, save_weights, weights_path
from evflow.process.provenance import sha256

PUBLISHED = (".pth", ".pt", ".tar")  # for missing files; existing ones: all but .safetensors
RELEASED = {"e2vid-small": "e2vid", "evflownet-small": "evflownet"}  # name: network


@dataclasses.dataclass(frozen=True)
class Trained:
    """A network with its params. normalised, split: whether its event tensors are; card: model
    card, empty for a published checkpoint; sha256: of the file, if there is one."""

    network: Network
    params: Params
    normalised: bool
    card: dict[str, Any]
    split: bool = False
    sha256: str = ""

    @property
    def how(self) -> dict[str, bool]:
        """The options that `reconstruct` needs."""
        return {"normalised": self.normalised} | ({"split": True} if self.split else {})


def save_network(
    path: str | os.PathLike, network: Network, params: Params, card: dict[str, Any], *,
    normalised: bool = False, overwrite: bool = False,
) -> Path:
    """Write a network as .safetensors; card: JSON-ready dict on its training."""
    kind = next(name for name, cls in KINDS.items() if type(network) is cls)
    card = card | {"network": kind, "structure": dataclasses.asdict(network),
                   "normalised": normalised}
    return save_weights(path, params, card, overwrite=overwrite)


def load_network(name_or_path: str | os.PathLike) -> Trained:
    """A released network by name, one of `save_network`, or a published checkpoint by path.

    Raises EV016 (no such file), EV009 (damaged), EV018 (the file is of something else), EV007
    (weights that are not finite).
    """
    path = Path(name_or_path)
    if path.suffix in PUBLISHED or (path.is_file() and path.suffix != ".safetensors"):
        network, params, normalised = read_published(path)
        return Trained(network, params, normalised, {},
                       split=network.bins == SPLIT_BINS, sha256=sha256(path))
    file = _file(name_or_path)
    card = model_card(file)
    kind = KINDS.get(str(card.get("network")))
    if kind is None:
        raise EvflowDataError("EV018", f"{file} holds no event network.",
                              f"Its model card should name one of {list(KINDS)}.")
    params = load_weights(file)
    try:
        network = kind(**card["structure"])
        expected = jax.eval_shape(lambda: network.init(jax.random.key(0), (16, 16)))
    except Exception as e:  # a card may hold anything
        raise EvflowDataError("EV009", f"{file}: its model card does not describe a network "
                              f"({type(e).__name__}: {e}).") from e
    if jax.tree.map(jnp.shape, params) != jax.tree.map(jnp.shape, expected):
        raise EvflowDataError("EV018", f"{file}: the parameters are not those of {network}.")
    return Trained(network, params, bool(card.get("normalised")), card,
                   sha256=sha256(file))


def _file(name_or_path: str | os.PathLike) -> Path:
    """The path of the weights; EV016 explains how to obtain missing released ones."""
    kind = RELEASED.get(str(name_or_path))
    try:
        return weights_path(name_or_path)
    except EvflowDataError as e:
        if kind is None:
            raise
        raise EvflowDataError(
            "EV016", f"the weights {name_or_path} are not in this installation.",
            f"Pass the path of others, or make them: python -m experiments.train_network "
            f"--network {kind} --out runs/{kind}") from e
