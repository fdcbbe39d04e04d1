"""PyTorch checkpoints as NumPy arrays, without PyTorch and without executing their pickles.

Both containers are read: the zip of PyTorch 1.6 and later, and the older chain of pickles (the
published E2VID, FireNet and EV-FlowNet files). Names are allow-listed: tensors are built, objects
of the training code (configuration, paths) are dropped, anything else is refused.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import math
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files import pickles
from evflow.files.archives import is_zip, unzipped
from evflow.files.bounded import BoundedPath

ZIP_BEGIN = b"PK\x03\x04"
MAGIC = 0x1950A86A20F9469CFC6C  # of the chain of pickles
PROTOCOL = 1001
MOST_BYTES = 2**31  # E2VID with its optimiser takes 128 MB
MOST_AXES = 8
MOST_EXPANDED = 1 << 24  # elements of a tensor that repeats those of its storage
STORAGES = {
    "Float": "<f4", "Double": "<f8", "Half": "<f2", "Long": "<i8", "Int": "<i4", "Short": "<i2",
    "Char": "i1", "Byte": "u1", "Bool": "?", "BFloat16": "<u2",
}
WRAPPERS = ("module.", "_orig_mod.")
# Objects that training programs save beside the weights, and which are dropped.
DROPPED = (
    "parse_config.ConfigParser", "pathlib.PosixPath", "pathlib.PurePosixPath",
    "pathlib.WindowsPath", "pathlib.PureWindowsPath", "pathlib._local.PosixPath",
    "torch.device", "torch.Size", "_codecs.encode", "argparse.Namespace",
    "collections.Counter", "collections.defaultdict", "numpy.ndarray", "numpy.dtype",
    *(f"numpy.{core}.multiarray.{name}" for core in ("core", "_core")
      for name in ("scalar", "_reconstruct")),
    *(f"{module}.{name}" for module in ("builtins", "__builtin__")
      for name in ("object", "set", "frozenset", "list", "dict", "int", "float", "complex")),
    *(f"torch.{name}" for name in (
        "float16", "bfloat16", "float32", "float64", "complex64", "complex128", "bool", "uint8",
        "int8", "int16", "int32", "int64")),
)


@dataclasses.dataclass(frozen=True)
class _Storage:
    """A flat buffer elsewhere in the file, `fill`ed once the pickle is read: tensors are views."""

    kind: str
    data: np.ndarray

    def fill(self, raw: bytes) -> None:
        if len(raw) != self.data.nbytes:
            raise ValueError(f"a storage of {self.data.nbytes} bytes has {len(raw)}")
        self.data.view(np.uint8)[:] = np.frombuffer(raw, np.uint8)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """arrays: the weights by their published names (bfloat16 as float32). settings: numbers and
    strings beside them, and dicts of such."""

    arrays: dict[str, np.ndarray]
    settings: dict[str, Any]


def read_checkpoint(path: str | os.PathLike) -> Checkpoint:
    """Weights from a file of torch.save: its "state_dict", else the only dict in it that holds
    tensors, else the dict itself. The prefixes "module." and, if all have it, "model." are removed.

    Raises EV016 (no file), EV008 (not a PyTorch file), EV009 (damaged, or it holds what no
    checkpoint needs), EV018 (no weights in it), EV020 (larger than 2 GiB).
    """
    path = Path(path)
    if not path.is_file():
        raise EvflowDataError("EV016", f"no checkpoint at {path}.")
    if path.stat().st_size > MOST_BYTES:
        raise EvflowDataError("EV020", f"{path} has {path.stat().st_size} bytes.",
                              f"The largest that is read has {MOST_BYTES}.")
    try:
        return _checkpoint(path, _read_zip(path) if is_zip(path) else _read_chain(path))
    except pickles.Refused as e:
        raise EvflowDataError(
            "EV009", f"{path}: {e}.", "Only weights are read. Where the file can be loaded, save "
            "only them: torch.save(model.state_dict(), 'weights.pth').") from e
    except (ValueError, struct.error) as e:
        raise EvflowDataError(
            "EV009", f"{path}: {e}.",
            "Copy it again; only files of torch.save with a state dict are read.") from e


def _read_chain(path: Path) -> Any:
    """Magic, protocol, system, object, keys; then each storage, its length before it."""
    with BoundedPath(path).open("rb") as f:
        try:
            known = pickles.load(f, {}) == MAGIC
        except ValueError:
            known = False
        if not known:
            f.seek(0)
            if f.read(len(ZIP_BEGIN)) == ZIP_BEGIN:
                raise ValueError("it begins as a zip, and lacks its end")
            raise EvflowDataError(
                "EV008", f"{path} is not a PyTorch checkpoint (neither a zip nor its magic "
                "number).", "Is it still packed, or a page that was saved in its place?")
        if pickles.load(f, {}) != PROTOCOL:
            raise ValueError("its protocol is unknown")
        system = pickles.load(f, {})
        if not isinstance(system, dict) or not system.get("little_endian"):
            raise ValueError("it was written on a big-endian machine")
        found: dict[str, _Storage] = {}
        refer = functools.partial(_refer, found, path.stat().st_size)
        content, keys = pickles.load(f, _NAMES, refer), pickles.load(f, {})
        strings = isinstance(keys, list) and all(isinstance(key, str) for key in keys)
        if not strings or sorted(keys) != sorted(found):
            raise ValueError("its list of storages is not that of its tensors")
        for storage in map(found.__getitem__, keys):
            (count,) = struct.unpack("<q", f.read(8))
            if count != len(storage.data):
                raise ValueError(f"a storage has {count} elements, not {len(storage.data)}")
            storage.fill(f.read(storage.data.nbytes))
    return content


def _read_zip(path: Path) -> Any:
    """The members data.pkl and data/<key> of the archive's one folder. The pickle is read outside
    of `unzipped`, which reports any error as damage."""
    with unzipped(path) as archive:
        sizes = {info.filename: info.file_size for info in archive.infolist()}
        roots = [n.removesuffix("data.pkl") for n in sizes if n.endswith("/data.pkl")]
        if len(roots) != 1:
            raise EvflowDataError("EV008", f"{path} is a zip, but not one of torch.save.")
        root = roots[0]
        pickle = io.BytesIO(archive.read(root + "data.pkl"))
        order = archive.read(root + "byteorder") if root + "byteorder" in sizes else b"little"
    if order != b"little":
        raise ValueError("it was written on a big-endian machine")
    found: dict[str, _Storage] = {}
    content = pickles.load(pickle, _NAMES, functools.partial(_refer, found, sum(sizes.values())))
    members = {f"{root}data/{key}": storage for key, storage in found.items()}
    if missing := members.keys() - sizes.keys():
        raise ValueError(f"it lacks {min(missing)[:80]}")
    with unzipped(path) as archive:
        for name, storage in members.items():
            storage.fill(archive.read(name))
    return content


def _ordered(*items: Any) -> dict[Any, Any]:
    if items:
        raise ValueError("an OrderedDict is built from a list")  # torch sets its items one by one
    return {}


def _refer(found: dict[str, _Storage], there: int, identity: Any) -> _Storage:
    """A storage from ("storage", type, key, location, elements, None), recorded in `found`. there:
    limit of the bytes of all storages."""
    if not (isinstance(identity, tuple) and len(identity) in (5, 6) and identity[0] == "storage"):
        raise ValueError("a storage is referred to in an unknown way")
    _, named, key, _, count, *view = identity
    if not (isinstance(named, pickles.Named) and isinstance(key, str) and _whole(count)
            and view in ([], [None])):
        raise ValueError("a storage is described in an unknown way")
    kind = named.name.removeprefix("torch.").removesuffix("Storage")
    if kind not in STORAGES:
        raise ValueError(f"a storage is of the type {named.name}")
    if key not in found:
        taken = sum(storage.data.nbytes for storage in found.values())
        if taken + count * np.dtype(STORAGES[kind]).itemsize > there:
            raise ValueError(f"its storages take more than the {there} bytes that are there")
        found[key] = _Storage(kind, np.empty(count, STORAGES[kind]))
    if (found[key].kind, len(found[key].data)) != (kind, count):
        raise ValueError(f"storage {key[:40]} is described twice")
    return found[key]


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> np.ndarray:
    """The view of a storage; offset, shape and strides are in elements."""
    good = isinstance(storage, _Storage) and _whole(offset) and all(
        isinstance(v, tuple) and len(v) <= MOST_AXES and all(map(_whole, v))
        for v in (shape, strides))
    if not good or len(shape) != len(strides):
        raise ValueError("a tensor is described in an unknown way")
    flat, size = storage.data, math.prod(shape)
    if not size:
        return np.zeros(shape, flat.dtype)
    if offset + sum((n - 1) * s for n, s in zip(shape, strides, strict=True)) >= len(flat):
        raise ValueError(f"a tensor {shape} lies outside of its storage of {len(flat)}")
    if size > max(len(flat), MOST_EXPANDED):  # a few bytes would fill the memory
        raise ValueError(f"a tensor {shape} repeats a storage of {len(flat)}")
    steps = tuple(s * flat.itemsize for s in strides)
    return np.lib.stride_tricks.as_strided(flat[offset:], shape, steps)


def _whole(value: Any) -> bool:
    return type(value) is int and 0 <= value <= MOST_BYTES


def _array(tensor: np.ndarray) -> np.ndarray:
    """A copy; uint16 is bfloat16, the upper half of a float32."""
    if tensor.dtype == np.uint16:
        return (tensor.astype(np.uint32) << 16).view(np.float32)
    return tensor.copy()


_NAMES: dict[str, pickles.Builder] = {
    "collections.OrderedDict": _ordered,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": lambda tensor, *_: tensor,
    "copyreg._reconstructor": pickles.Inert,
    "copy_reg._reconstructor": pickles.Inert,
    **{f"torch.{kind}Storage": pickles.Inert for kind in STORAGES},
    **dict.fromkeys(DROPPED, pickles.Inert),
}


def _checkpoint(path: Path, content: Any) -> Checkpoint:
    content = content if isinstance(content, dict) else {}
    nested = [key for key, value in content.items() if _tensors(value)]
    key = "state_dict" if "state_dict" in content or len(nested) != 1 else nested[0]
    tensors = _tensors(content.get(key, content))
    if tensors and all(name.startswith("model.") for name in tensors):
        tensors = {_bare(name.removeprefix("model.")): value for name, value in tensors.items()}
    if not tensors:
        raise EvflowDataError(
            "EV018", f"{path} holds no weights, but {sorted(map(str, content))[:8]}.",
            "Expected a state dict, or a dict with one under 'state_dict'; or with only one.")
    if sum(8 * tensor.size for tensor in tensors.values()) > 2 * MOST_BYTES:
        raise ValueError("its tensors are more than its storages")
    arrays = {name: _array(tensor) for name, tensor in tensors.items()}
    settings = {k: _plain(value) for k, value in content.items() if k != key}
    return Checkpoint(arrays, {str(k): v for k, v in settings.items() if v is not None})


def _tensors(value: Any) -> dict[str, np.ndarray]:
    """The named tensors of a dict."""
    return {_bare(name): tensor for name, tensor in value.items()
            if isinstance(name, str) and isinstance(tensor, np.ndarray)
            } if isinstance(value, dict) else {}


def _bare(name: str) -> str:
    """Names without the prefixes of data-parallel and compiled modules."""
    while name.startswith(WRAPPERS):
        name = name.partition(".")[2]
    return name


def _plain(value: Any, depth: int = 0) -> Any:
    """Numbers, strings and dicts of such to a depth of 2; None for all else."""
    if isinstance(value, str | int | float):
        return value
    if isinstance(value, dict) and depth < 2:
        return {str(k): _plain(v, depth + 1) for k, v in value.items()}
    return None
