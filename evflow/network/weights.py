"""Released parameters: safetensors files with the model card as metadata.

`load_weights()` reads the weights that ship in the wheel (evflow/weights/default.safetensors).
A file holds flat names "default/flow/level_0/actnorm/raw"; params is the nested dict.
"""

from __future__ import annotations

import json
import os
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write
from evflow.process.provenance import sha256

Params = dict[str, Any]


def weights_path(name_or_path: str | os.PathLike = "default") -> Path:
    """The file of a released name ("default") or the path itself."""
    need(name_or_path, str | os.PathLike, "name_or_path", "Give a released name or a path.")
    path = Path(name_or_path)
    if path.suffix != ".safetensors":
        path = Path(str(resources.files("evflow") / "weights" / f"{name_or_path}.safetensors"))
    if not path.is_file():
        folder = Path(str(resources.files("evflow") / "weights"))
        known = sorted(p.stem for p in folder.glob("*.safetensors"))
        raise EvflowDataError("EV016", f"no weights at {path}.",
                              f"Released names: {known}; or give a .safetensors path.")
    return path


def weights_hash(name_or_path: str | os.PathLike = "default") -> str:
    """SHA-256 of the file that `load_weights` reads."""
    return sha256(weights_path(name_or_path))


def load_weights(name_or_path: str | os.PathLike = "default") -> Params:
    """Parameters of the network, for `estimate` and the rest of the API.

    Args:
        name_or_path: a released name ("default" ships with the package), or a .safetensors file.

    Returns:
        A nested dict of float32 arrays under one key, the architecture's name.

    Raises:
        EvflowDataError: EV009 (damaged), EV016 (no such file or name), EV018 (tensors that are not
            float32, or nest badly), EV020 (neither a name nor a path).
    """
    path = weights_path(name_or_path)
    params: Params = {}
    try:
        with safe_open(path, framework="numpy") as file:
            _check_tensors(path, file)
            for name in file.keys():  # noqa: SIM118 - safe_open is no mapping
                *parents, leaf = name.split("/")
                node = params
                for part in parents:
                    node = node.setdefault(part, {})
                node[leaf] = jnp.asarray(file.get_tensor(name))
    except SafetensorError as e:
        raise EvflowDataError("EV009", f"{path} is not a readable safetensors file ({e}).") from e
    return params


def _check_tensors(path: Path, file: Any) -> None:
    """EV018 unless all are float32 and none has the name of a group of others."""
    names = list(file.keys())
    groups = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    for name in names:
        kind = file.get_slice(name).get_dtype()
        if kind != "F32" or str(PurePosixPath(name)) in groups:
            raise EvflowDataError(
                "EV018", f"{path}: {name} is of {kind}"
                + (" and also a group of others." if kind == "F32" else "."),
                "Expected float32 arrays, as save_weights writes them.")


def save_weights(
    path: str | os.PathLike, params: Params, card: dict[str, Any], *, overwrite: bool = False
) -> Path:
    """Write parameters and a model card as one .safetensors file; all or nothing.

    Args:
        path: of the file, which ends in .safetensors.
        params: nested dict of arrays; stored as float32.
        card: any JSON-ready dict: command, seed, steps, data, figures.
        overwrite: replace a file that exists.

    Returns:
        The path.

    Raises:
        EvflowDataError: EV013 (exists), EV019 (cannot be written), EV020 (another ending, by which
            it could not be read again).
    """
    if Path(path).suffix != ".safetensors":
        raise EvflowDataError("EV020", f"{path} does not end in .safetensors.",
                              f"Name it {Path(path).with_suffix('.safetensors')}.")
    leaves = jax.tree_util.tree_leaves_with_path(params)
    tensors = {"/".join(str(k.key) for k in keys): np.asarray(leaf, np.float32)
               for keys, leaf in leaves}
    data = save(tensors, metadata={"card": json.dumps(card, sort_keys=True)})
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def model_card(name_or_path: str | os.PathLike = "default") -> dict[str, Any]:
    """The card that was saved with the weights: command, seed, steps, data, figures."""
    path = weights_path(name_or_path)
    try:
        with safe_open(path, framework="numpy") as file:
            card = json.loads((file.metadata() or {}).get("card", "{}"))
    except (SafetensorError, ValueError, RecursionError) as e:
        raise EvflowDataError("EV009", f"{path} has no readable model card ({e}).") from e
    if not isinstance(card, dict):
        raise EvflowDataError("EV009", f"the model card of {path} is no object but a "
                              f"{type(card).__name__}.")
    return card


def trained_steps(card: dict[str, Any]) -> dict[str, int]:
    """Steps of training by part of a model card. Weights of one run have one count, "all"; those
    put together from several runs have a card a part, and the released ones are such."""
    if isinstance(card.get("steps"), int):
        return {"all": card["steps"]}
    return {part: inner["steps"] for part, inner in card.items()
            if isinstance(inner, dict) and isinstance(inner.get("steps"), int)}
