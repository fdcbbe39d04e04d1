"""The published networks in PyTorch, written from their description, on state dicts.

    python tests/helpers/torch_reference.py

writes tests/data/downstream.npz, their outputs on the seeded weights and inputs of
`published_networks`; and two small files of torch.save. The tests run without PyTorch on these,
and where it is installed also on its live output.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from helpers.published_networks import CASES, case_input, case_state

DATA = Path(__file__).parents[1] / "data"
Tensor = torch.Tensor


class Weights:
    """Layers by the names of a state dict."""

    def __init__(self, state: dict[str, np.ndarray], prefix: str) -> None:
        self.state = {k.removeprefix(prefix): torch.from_numpy(v.copy()) for k, v in state.items()}

    def conv(self, name: str, x: Tensor, stride: int = 1) -> Tensor:
        weight = self.state[f"{name}.weight"]
        bias = self.state.get(f"{name}.bias")
        return F.conv2d(x, weight, bias, stride, weight.shape[-1] // 2)

    def transposed(self, name: str, x: Tensor) -> Tensor:
        return F.conv_transpose2d(
            x, self.state[f"{name}.weight"], self.state.get(f"{name}.bias"), 2, 2, 1)

    def norm(self, name: str, x: Tensor) -> Tensor:
        if f"{name}.weight" not in self.state:
            return x
        mean, var, weight, bias = (self.state[f"{name}.{leaf}"] for leaf in (
            "running_mean", "running_var", "weight", "bias"))
        return F.batch_norm(x, mean, var, weight, bias, training=False, eps=1e-5)

    def block(self, name: str, x: Tensor) -> Tensor:
        y = torch.relu(self.norm(f"{name}.bn1", self.conv(f"{name}.conv1", x)))
        return torch.relu(x + self.norm(f"{name}.bn2", self.conv(f"{name}.conv2", y)))


def padded(x: Tensor, multiple: int, mode: str) -> tuple[Tensor, int, int]:
    """The larger half of what is missing comes to the top and the left."""
    rows, columns = (-n % multiple for n in x.shape[-2:])
    top, left = -(-rows // 2), -(-columns // 2)
    return F.pad(x, (left, columns - left, top, rows - top), mode=mode), top, left


def up(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def lstm(w: Weights, name: str, x: Tensor, state: Any) -> tuple[Tensor, Tensor]:
    h, c = (torch.zeros_like(x), torch.zeros_like(x)) if state is None else state
    i, f, o, g = w.conv(name, torch.cat([x, h], 1)).chunk(4, 1)
    c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
    return torch.sigmoid(o) * torch.tanh(c), c


def gru(w: Weights, name: str, x: Tensor, h: Any) -> Tensor:
    h = torch.zeros_like(x) if h is None else h
    both = torch.cat([x, h], 1)
    update = torch.sigmoid(w.conv(f"{name}.update_gate", both))
    reset = torch.sigmoid(w.conv(f"{name}.reset_gate", both))
    new = torch.tanh(w.conv(f"{name}.out_gate", torch.cat([x, h * reset], 1)))
    return h * (1 - update) + new * update


def e2vid(state: dict[str, np.ndarray], frames: Tensor, **options: Any) -> list[Tensor]:
    w = Weights(state, "unetrecurrent.")
    encoders, blocks = options.get("encoders", 3), options.get("blocks", 2)
    join = (lambda a, b: torch.cat([a, b], 1)) if options.get("concat") else torch.add
    original = bool(options.get("batch"))
    memory: list[Any] = [None] * encoders
    images = []
    for frame in frames:
        height, width = frame.shape[-2:]
        x, top, left = padded(frame[None], 2**encoders, "reflect" if original else "constant")
        x = head = torch.relu(w.conv("head.conv2d", x))
        for i in range(encoders):
            x = w.norm(f"encoders.{i}.conv.norm_layer", w.conv(f"encoders.{i}.conv.conv2d", x, 2))
            memory[i] = lstm(w, f"encoders.{i}.recurrent_block.Gates", torch.relu(x), memory[i])
            x = memory[i][0]
        for i in range(blocks):
            x = w.block(f"resblocks.{i}", x)
        for i in range(encoders):
            x = join(x, memory[encoders - 1 - i][0])
            x = (w.transposed(f"decoders.{i}.transposed_conv2d", x) if options.get("transposed")
                 else w.conv(f"decoders.{i}.conv2d", up(x)))
            x = torch.relu(w.norm(f"decoders.{i}.norm_layer", x))
        x = w.norm("pred.norm_layer", w.conv("pred.conv2d", join(x, head)))
        x = torch.sigmoid(x) if original else x
        images.append(x[0, 0, top:top + height, left:left + width])
    return images


def firenet(state: dict[str, np.ndarray], frames: Tensor, legacy: bool = False) -> list[Tensor]:
    w = Weights(state, "net.")
    head, cells, blocks = (
        ("head.conv.conv2d", ("head.recurrent_block", "resblocks.0.recurrent_block"),
         ("resblocks.0.conv", "resblocks.1")) if legacy
        else ("head.conv2d", ("G1", "G2"), ("R1", "R2")))
    memory: list[Any] = [None, None]
    images = []
    for frame in frames:
        x = torch.relu(w.conv(head, frame[None]))
        for i in range(2):
            memory[i] = gru(w, cells[i], x, memory[i])
            x = w.block(blocks[i], memory[i])
        images.append(w.conv("pred.conv2d", x)[0, 0])
    return images


def evflownet(state: dict[str, np.ndarray], frames: Tensor, **_: Any) -> list[Tensor]:
    w = Weights(state, "unet.")
    flows = []
    for frame in frames:
        height, width = frame.shape[-2:]
        x, top, left = padded(frame[None], 16, "constant")
        skips = []
        for i in range(4):
            x = torch.relu(w.conv(f"encoders.{i}.conv2d", x, 2))
            skips.append(x)
        for i in range(2):
            x = w.block(f"resblocks.{i}", x)
        for i in range(4):
            x = torch.cat([x, skips[3 - i]], 1)
            x = torch.relu(w.conv(f"decoders.{i}.conv2d", up(x)))
        flows.append(w.conv("pred.conv2d", x)[0, :, top:top + height, left:left + width])
    return flows


FAMILIES = {"e2vid": e2vid, "firenet": firenet, "evflownet": evflownet}


def case_output(name: str) -> np.ndarray:
    """(T, H, W) images, or (T, 2, H, W) flow, of a case."""
    options = {k: v for k, v in CASES[name].items() if k not in ("family", "base")}
    frames = torch.from_numpy(case_input()).permute(0, 3, 1, 2)
    with torch.no_grad():
        images = FAMILIES[CASES[name]["family"]](case_state(name), frames, **options)
    return torch.stack(images).numpy()


def oddities() -> dict[str, Any]:
    """Tensors that share, skip and turn their storage, of every type."""
    whole = torch.arange(24.0).reshape(4, 6)
    return {"epoch": 3, "model": {"num_bins": 5, "norm": "BN"}, "state_dict": {
        "module.whole": whole, "module.turned": whole.T, "module.part": whole[1:3, ::2],
        "module.half": whole.half()[0], "module.bfloat": whole.bfloat16()[1],
        "module.double": whole.double()[2], "module.long": torch.tensor(7),
        "module.bool": whole[0] > 2, "module.empty": torch.zeros(0, 3),
        "module.parameter": torch.nn.Parameter(torch.ones(2))}}


def lpips(params: dict[str, Any], image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """LPIPS (N,) of RGB images (N, H, W, 3) on [0, 1], with the weights of `load_lpips`."""
    alex = "AlexNet_0" in params
    layers = params["AlexNet_0" if alex else "VGG16_0"]

    def conv(i: int, x: Tensor, stride: int, pad: int) -> Tensor:
        kernel, bias = (torch.from_numpy(np.array(layers[f"Conv_{i}"][k])) for k in (
            "kernel", "bias"))
        return torch.relu(F.conv2d(x, kernel.permute(3, 2, 0, 1), bias, stride, pad))

    def features(image: np.ndarray) -> list[Tensor]:
        x = 2 * torch.from_numpy(image).permute(0, 3, 1, 2) - 1
        x = (x - torch.tensor([-0.030, -0.088, -0.188])[:, None, None]) / torch.tensor(
            [0.458, 0.448, 0.450])[:, None, None]
        if alex:
            out = [conv(0, x, 4, 2)]
            out.append(conv(1, F.max_pool2d(out[-1], 3, 2), 1, 2))
            out.append(conv(2, F.max_pool2d(out[-1], 3, 2), 1, 1))
            return [*out, y := conv(3, out[-1], 1, 1), conv(4, y, 1, 1)]
        out, last = [], (1, 3, 6, 9, 12)
        for i in range(13):
            x = conv(i, x, 1, 1)
            if i in last:
                out.append(x)
                x = F.max_pool2d(x, 2)
        return out

    total = torch.zeros(len(image))
    for i, (x, y) in enumerate(zip(features(image), features(reference), strict=True)):
        x, y = (f / (f.pow(2).sum(1, keepdim=True).sqrt() + 1e-10) for f in (x, y))
        head = torch.from_numpy(np.array(params[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]))
        total += F.conv2d((x - y) ** 2, head.permute(3, 2, 0, 1)).mean((1, 2, 3))
    return total.numpy()


if __name__ == "__main__":
    DATA.mkdir(exist_ok=True)
    np.savez_compressed(DATA / "downstream.npz", **{name: case_output(name) for name in CASES})
    for name, zipped in (("torch_zip.pt", True), ("torch_legacy.pt", False)):
        torch.save(oddities(), DATA / name, _use_new_zipfile_serialization=zipped)
