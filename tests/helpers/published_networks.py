"""State dicts as the published networks have them: their names and shapes at any size, filled with
seeded random numbers; and PyTorch's two containers, written without PyTorch."""

from __future__ import annotations

import struct
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

State = dict[str, np.ndarray]
Shapes = dict[str, tuple[int, ...]]

STEPS, HEIGHT, WIDTH, BINS = 5, 22, 29, 5  # sides that must be padded
CASES: dict[str, dict[str, Any]] = {
    "e2vid_plus": {"family": "e2vid", "base": 4},
    "e2vid_lightweight": {"family": "e2vid", "base": 4, "batch": True, "transposed": True},
    "e2vid_concat": {"family": "e2vid", "base": 4, "encoders": 2, "blocks": 1, "concat": True},
    "firenet_plus": {"family": "firenet"},
    "firenet_2020": {"family": "firenet", "legacy": True},
    "evflownet": {"family": "evflownet", "base": 4},
}


def conv(name: str, out: int, into: int, size: int, bias: bool = True) -> Shapes:
    return {f"{name}.weight": (out, into, size, size), **({f"{name}.bias": (out,)} if bias else {})}


def norm(name: str, features: int) -> Shapes:
    leaves = ("weight", "bias", "running_mean", "running_var")
    return {**{f"{name}.{leaf}": (features,) for leaf in leaves}, f"{name}.num_batches_tracked": ()}


def e2vid(
    base: int = 32, encoders: int = 3, blocks: int = 2, batch: bool = False,
    transposed: bool = False, concat: bool = False,
) -> Shapes:
    shapes = conv("head.conv2d", base, BINS, 5)
    double = 2 if concat else 1
    for i in range(encoders):
        out = base << (i + 1)
        shapes |= conv(f"encoders.{i}.conv.conv2d", out, out // 2, 5, not batch)
        shapes |= norm(f"encoders.{i}.conv.norm_layer", out) if batch else {}
        shapes |= conv(f"encoders.{i}.recurrent_block.Gates", 4 * out, 2 * out, 3)
    top = base << encoders
    for i in range(blocks):
        for j in (1, 2):
            shapes |= conv(f"resblocks.{i}.conv{j}", top, top, 3, not batch)
            shapes |= norm(f"resblocks.{i}.bn{j}", top) if batch else {}
    for i in range(encoders):
        into, out = double * (top >> i), top >> (i + 1)
        if transposed:
            shapes |= conv(f"decoders.{i}.transposed_conv2d", into, out, 5, False)
            shapes |= {} if batch else {f"decoders.{i}.transposed_conv2d.bias": (out,)}
        else:
            shapes |= conv(f"decoders.{i}.conv2d", out, into, 5, not batch)
        shapes |= norm(f"decoders.{i}.norm_layer", out) if batch else {}
    shapes |= conv("pred.conv2d", 1, double * base, 1, not batch)
    shapes |= norm("pred.norm_layer", 1) if batch else {}
    return {f"unetrecurrent.{name}": shape for name, shape in shapes.items()}


def firenet(base: int = 16, legacy: bool = False) -> Shapes:
    gates = ("reset_gate", "update_gate", "out_gate")
    head = "net.head.conv.conv2d" if legacy else "head.conv2d"
    grus = (("net.head.recurrent_block", "net.resblocks.0.recurrent_block") if legacy
            else ("G1", "G2"))
    blocks = ("net.resblocks.0.conv", "net.resblocks.1") if legacy else ("R1", "R2")
    shapes = conv(head, base, BINS, 3)
    for gru, block in zip(grus, blocks, strict=True):
        for gate in gates:
            shapes |= conv(f"{gru}.{gate}", base, 2 * base, 3)
        for j in (1, 2):
            shapes |= conv(f"{block}.conv{j}", base, base, 3)
    return shapes | conv("net.pred.conv2d" if legacy else "pred.conv2d", 1, base, 1)


def evflownet(base: int = 64) -> Shapes:
    shapes: Shapes = {}
    for i in range(4):
        shapes |= conv(f"encoders.{i}.conv2d", base << i, base << (i - 1) if i else BINS, 3)
    for i in range(2):
        for j in (1, 2):
            shapes |= conv(f"resblocks.{i}.conv{j}", base << 3, base << 3, 3)
    for i in range(4):
        shapes |= conv(f"decoders.{i}.conv2d", (base << 2) >> i, (base << 4) >> i, 3)
    shapes |= conv("pred.conv2d", 2, base // 2, 1)
    return {f"unet.{name}": shape for name, shape in shapes.items()}


FAMILIES = {"e2vid": e2vid, "firenet": firenet, "evflownet": evflownet}


def case_state(name: str) -> State:
    """The weights of a case: conv kernels of the gain that keeps activations alive."""
    options = {k: v for k, v in CASES[name].items() if k != "family"}
    return draw(FAMILIES[CASES[name]["family"]](**options), sorted(CASES).index(name))


def draw(shapes: Shapes, seed: int) -> State:
    rng = np.random.default_rng(seed)
    state: State = OrderedDict()
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            state[name] = np.array(7, np.int64)
            continue
        noise = rng.standard_normal(shape)
        if name.endswith("running_var"):
            value = 0.5 + np.abs(noise)
        elif name.endswith("weight"):
            kernel = noise * (1.5 / np.prod(shape[1:])) ** 0.5
            value = kernel if len(shape) == 4 else 1 + 0.2 * noise
        else:
            value = 0.1 * noise
        state[name] = value.astype(np.float32)
    return state


def case_input() -> np.ndarray:
    """Event tensors (T, H, W, bins): sparse signed counts."""
    rng = np.random.default_rng(99)
    shape = (STEPS, HEIGHT, WIDTH, BINS)
    return (rng.poisson(0.3, shape) * rng.choice([-1.0, 1.0], shape)).astype(np.float32)


STORAGES = {"float32": "Float", "int64": "Long", "float16": "Half", "uint8": "Byte"}


class Raw(bytes):
    """Instructions of a pickle, put in as they are."""


def pickled(value: Any, storages: list[np.ndarray], legacy: bool) -> bytes:
    """`value` as torch.save pickles it (protocol 2); its arrays are appended to `storages`."""
    def one(value: Any) -> bytes:
        if isinstance(value, Raw):
            return bytes(value)
        if value is None or isinstance(value, bool):
            return {None: b"N", True: b"\x88", False: b"\x89"}[value]
        if isinstance(value, int):
            return b"\x8a\x0a" + value.to_bytes(10, "little", signed=True)
        if isinstance(value, float):
            return b"G" + struct.pack(">d", value)
        if isinstance(value, str):
            return b"X" + struct.pack("<I", len(value.encode())) + value.encode()
        if isinstance(value, dict):
            items = b"".join(one(k) + one(v) for k, v in value.items())
            ordered = isinstance(value, OrderedDict)
            return (b"ccollections\nOrderedDict\n)R(" if ordered else b"}(") + items + b"u"
        if isinstance(value, list | tuple):
            inside = b"(" + b"".join(map(one, value))
            return b"]" + inside + b"e" if isinstance(value, list) else inside + b"t"
        return tensor(value)

    def tensor(array: np.ndarray) -> bytes:
        kind = Raw(f"ctorch\n{STORAGES[array.dtype.name]}Storage\n".encode())
        identity = ("storage", kind, str(len(storages)), "cpu", array.size)
        storages.append(array)
        strides = tuple(s // array.itemsize for s in array.strides)
        persistent = Raw(one(identity + ((None,) if legacy else ())) + b"Q")
        return b"ctorch._utils\n_rebuild_tensor_v2\n" + one(
            (persistent, 0, array.shape, strides, False, OrderedDict())) + b"R"

    return b"\x80\x02" + one(value) + b"."


def write_legacy(path: Path, content: Any) -> None:
    """The chain of pickles of PyTorch before 1.6."""
    storages: list[np.ndarray] = []
    body = pickled(content, storages, legacy=True)
    system = {"protocol_version": 1001, "little_endian": True}
    parts = [pickled(value, [], True) for value in (0x1950A86A20F9469CFC6C, 1001, system)]
    parts += [body, pickled([str(i) for i in range(len(storages))], [], True)]
    parts += [struct.pack("<q", a.size) + a.tobytes() for a in storages]
    path.write_bytes(b"".join(parts))


def write_zip(path: Path, content: Any) -> None:
    """The archive of PyTorch 1.6 and later."""
    storages: list[np.ndarray] = []
    body = pickled(content, storages, legacy=False)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", body)
        archive.writestr("archive/byteorder", b"little")
        for i, array in enumerate(storages):
            archive.writestr(f"archive/data/{i}", array.tobytes())
