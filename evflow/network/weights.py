"""Released parameters: safetensors files with the model card as metadata.

`load_weights()` reads the weights that ship in the wheel (evflow/weights/default.safetensors).
A file holds flat names "default/flow/level_0/actnorm/raw"; params is the nested dict.
"""

from __future__ import annotations

import hashlib
import json
import os
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np
from safetensors.numpy import save

from evflow.checks import need
from evflow.errors import EvflowDataError, naming
from evflow.files.atomic import atomic_text
from evflow.files.json_text import parse_json
from evflow.files.limits import read_whole
from evflow.network import tensors
from evflow.network.config import MODELS
from evflow.process.provenance import sha256

Params = dict[str, Any]

FOLDER = Path(str(resources.files("evflow") / "weights"))
SUMS = "SHA256SUMS"  # of the released files
DIGEST = "sha256"  # key in a card: hash of the arrays
AGAIN = "Copy or create it again."


def weights_path(name_or_path: str | os.PathLike = "default") -> Path:
    """The file of a released name ("default"), or the path itself; EV008, EV016 if it is none."""
    need(name_or_path, str | os.PathLike, "name_or_path", "Give a released name or a path.")
    path = Path(name_or_path)
    if path.suffix != ".safetensors":
        inside = path / "weights.safetensors"
        if inside.is_file():
            raise EvflowDataError("EV016", f"{path} is a folder.", f"Pass {inside}.", where=path)
        if path.is_file():
            raise EvflowDataError("EV008", f"{path} is not a .safetensors.", "Pass the "
                                  "weights.safetensors that evflow train writes.", where=path)
        path = FOLDER / f"{name_or_path}.safetensors"
    if not path.is_file():
        names = sorted(p.stem for p in FOLDER.glob("*.safetensors"))
        kinds = {kind: [n for n in names if (n in MODELS) == (kind == "estimators")]
                 for kind in ("estimators", "networks for video and flow")}
        raise EvflowDataError(
            "EV016", f"no weights at {path}.", "Released names: "
            + "; ".join(f"{', '.join(of)} ({kind})" for kind, of in kinds.items())
            + "; or give a .safetensors path.")
    return path


def weights_hash(name_or_path: str | os.PathLike = "default") -> str:
    """SHA-256 of the file that `load_weights` reads."""
    return sha256(weights_path(name_or_path))


def load_weights(name_or_path: str | os.PathLike = "default") -> Params:
    """Parameters of the network, for `estimate` and the rest of the API.

    Args:
        name_or_path: a released name ("default", or "paper", the paper's network, trained on one
            core), or a .safetensors file.

    Returns:
        A nested dict of float32 arrays under one key, the architecture's name.

    Raises:
        EvflowDataError: EV007 (NaN), EV009 (damaged or modified), EV016 (no such file or name),
            EV018 (tensors that are not float32, or nest badly), EV020 (neither a name nor a path).
    """
    path = weights_path(name_or_path)
    data = read_whole(path)
    with naming(path):
        card = _card(data)
        try:
            arrays = tensors.parse(data)
        except ValueError as e:
            raise EvflowDataError("EV009", f"it is no valid safetensors file ({e}).", AGAIN) from e
        _check_whole(path, data, arrays, card)
    params: Params = {}
    for name, array in arrays.items():
        *parents, leaf = name.split("/")
        node = params
        for part in parents:
            node = node.setdefault(part, {})
        node[leaf] = jax.device_put(array)  # unlike `jnp.asarray`, needs no program per shape
    return params


def _check_whole(path: Path, data: bytes, arrays: tensors.Arrays, card: dict[str, Any]) -> None:
    """Raise EV009 if the numbers differ from those saved or released; EV007 if some are not finite;
    EV018 if there are none."""
    if not arrays:
        raise EvflowDataError("EV018", "it holds no array.", "Expected a file from save_weights.")
    if DIGEST in card and tensors.digest(arrays) != card[DIGEST]:
        raise EvflowDataError("EV009", "its numbers differ from those saved (their SHA-256 "
                              "is not that of its model card).", AGAIN)
    if path.parent == FOLDER and hashlib.sha256(data).hexdigest() != _released().get(path.name):
        raise EvflowDataError(
            "EV009", f"it differs from the released file (its SHA-256 is not in {SUMS}).",
            f"Install evflow again. Replaced on purpose? Then correct {SUMS} (sha256sum).")
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise EvflowDataError("EV007", f"{name} has NaN or infinite values.",
                                  "A training that diverged? Use an earlier checkpoint.")


def _released() -> dict[str, str]:
    """SHA-256 of each released file, by name."""
    lines = (FOLDER / SUMS).read_text().splitlines()
    return {name: found for found, name in (line.split() for line in lines)}


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
        EvflowDataError: EV007 (NaN), EV013 (exists), EV019 (cannot be written), EV020 (another
            extension, with which it could not be read again; params that are not nested dicts of
            arrays, or a card that JSON cannot hold).
    """
    if Path(path).suffix != ".safetensors":
        raise EvflowDataError("EV020", f"{path} does not end in .safetensors.",
                              f"Name it {Path(path).with_suffix('.safetensors')}.")
    arrays = _named(params)
    if lost := [name for name, array in arrays.items() if not np.isfinite(array).all()]:
        raise EvflowDataError("EV007", f"{lost[0]} has NaN or infinite values.",
                              "A training that diverged? Save an earlier state.")
    need(card, dict, "card", "Give a dict of what is to be known, {} for nothing.")
    card = card | {DIGEST: tensors.digest(arrays)}
    try:
        text = json.dumps(card, sort_keys=True)
    except (TypeError, ValueError) as e:
        raise EvflowDataError("EV020", f"the card cannot be written as JSON ({e}).",
                              "Give numbers, text, lists and dicts.") from e
    data = save(arrays, metadata={"card": text})
    atomic_text(path, data, overwrite=overwrite)
    return Path(path)


def _named(params: Params) -> tensors.Arrays:
    """The arrays as float32 by their flat names; raises EV020."""
    fix = "Give nested dicts of arrays, as load_weights returns them."
    need(params, dict, "params", fix)
    arrays: tensors.Arrays = {}
    for keys, leaf in jax.tree_util.tree_leaves_with_path(params):
        try:
            arrays["/".join(str(k.key) for k in keys)] = np.asarray(leaf, np.float32)
        except (AttributeError, TypeError, ValueError) as e:
            where = jax.tree_util.keystr(keys)
            raise EvflowDataError(
                "EV020", f"params{where}, of type {type(leaf).__name__}, is no array of numbers in "
                "nested dicts.", fix) from e
    if not arrays:
        raise EvflowDataError("EV020", "params hold no array.", fix)
    return arrays


def model_card(name_or_path: str | os.PathLike = "default") -> dict[str, Any]:
    """The card that was saved with the weights: command, seed, steps, data, figures."""
    path = weights_path(name_or_path)
    with naming(path):
        card = _card(read_whole(path))
    card.pop(DIGEST, None)  # specific to this file; cards are copied to others
    return card


def _card(data: bytes) -> dict[str, Any]:
    """The model card stored in the file; raises EV009."""
    try:
        metadata = tensors.read_header(data)[0].get(tensors.CARD, {})
        card = parse_json(metadata.get("card", "{}"))
        if not isinstance(card, dict):
            raise TypeError(f"it is not an object but a {type(card).__name__}")
    except (ValueError, TypeError, AttributeError) as e:
        raise EvflowDataError("EV009", f"it has no readable model card ({e}).", AGAIN) from e
    return card


def trained_steps(card: dict[str, Any]) -> dict[str, int]:
    """Training steps by part, from a model card. Weights of one run have one count, "all"; those
    put together from several runs, such as the released ones, have a card per part."""
    if isinstance(card.get("steps"), int):
        return {"all": card["steps"]}
    return {part: inner["steps"] for part, inner in card.items()
            if isinstance(inner, dict) and isinstance(inner.get("steps"), int)}
