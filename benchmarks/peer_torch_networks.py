"""FireNet's and E2VID's peer: the same networks of the same weights in plain PyTorch, and one
training step of them as it is usually written, with autograd and torch.optim.Adam.

`tensors` turns evflow's params into named tensors; images are (B, C, H, W). The step unrolls T
windows from a zero state; its loss is the mean absolute error of the images.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import torch
import torch.nn.functional as F

from evflow.downstream import E2VID, FireNet, Network

Tensor = torch.Tensor
Weights = dict[str, Tensor]
State = list[Any]
Cell = Callable[[Weights, Tensor, State], tuple[Tensor, State]]


def tensors(params: Any, layout: torch.memory_format) -> Weights:
    """{"gru_0/out/kernel": (F, C, k, k), ...}, leaves of the gradient."""
    found = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        array = np.asarray(leaf)
        array = array.transpose(3, 2, 0, 1) if array.ndim == 4 else array
        leaf = torch.tensor(np.ascontiguousarray(array))
        leaf = leaf.contiguous(memory_format=layout) if leaf.ndim == 4 else leaf
        found["/".join(str(key.key) for key in path)] = leaf.requires_grad_()
    return found


def conv(w: Weights, name: str, x: Tensor, stride: int = 1) -> Tensor:
    kernel = w[f"{name}/kernel"]
    return F.conv2d(x, kernel, w[f"{name}/bias"], stride, kernel.shape[-1] // 2)


def _residual(w: Weights, name: str, x: Tensor) -> Tensor:
    hidden = F.relu(conv(w, f"{name}/first/conv", x))
    return F.relu(x + conv(w, f"{name}/second/conv", hidden))


def firenet(w: Weights, x: Tensor, state: State) -> tuple[Tensor, State]:
    x = F.relu(conv(w, "head/conv", x))
    new: State = []
    for i, h in enumerate(state):
        both = torch.cat([x, h], 1)
        update = torch.sigmoid(conv(w, f"gru_{i}/update", both))
        reset = torch.sigmoid(conv(w, f"gru_{i}/reset", both))
        value = torch.tanh(conv(w, f"gru_{i}/out", torch.cat([x, h * reset], 1)))
        new.append(h * (1 - update) + value * update)
        x = _residual(w, f"block_{i}", new[-1])
    return conv(w, "prediction/conv", x), new


def e2vid(w: Weights, x: Tensor, state: State) -> tuple[Tensor, State]:
    """With a linear output, no batch norm, upsampling decoders and added skips."""
    head = x = F.relu(conv(w, "head/conv", x))
    new: State = []
    for i, (h, c) in enumerate(state):
        x = F.relu(conv(w, f"encoder_{i}/conv", x, 2))
        gates = conv(w, f"lstm_{i}/gates", torch.cat([x, h], 1)).chunk(4, 1)
        entry, forget, output = (torch.sigmoid(gate) for gate in gates[:3])
        cell = forget * c + entry * torch.tanh(gates[3])
        x = output * torch.tanh(cell)
        new.append((x, cell))
    for i in range(sum(name.endswith("first/conv/kernel") for name in w)):
        x = _residual(w, f"block_{i}", x)
    for i, (h, _) in enumerate(reversed(new)):
        wide = F.interpolate(x + h, scale_factor=2, mode="bilinear", align_corners=False)
        x = F.relu(conv(w, f"decoder_{i}/layer/conv", wide))
    return conv(w, "prediction/conv", x + head), new


CELLS: dict[type[Network], Cell] = {FireNet: firenet, E2VID: e2vid}


class Trainer:
    """step() trains once on voxels (T, B, H, W, bins) and images (T, B, H, W) -> loss.

    layout: of 4-D tensors; compiled: every window through torch.compile.
    """

    def __init__(self, network: Network, params: Any, voxels: jax.Array, images: jax.Array,
                 rate: float, layout: torch.memory_format, compiled: bool = False) -> None:
        def there(array: Any) -> Tensor:
            tensor = torch.tensor(np.asarray(array)).movedim(-1, -3)
            return tensor.contiguous(memory_format=layout)

        self.weights = tensors(params, layout)
        self.optimiser = torch.optim.Adam(self.weights.values(), rate)
        cell = CELLS[type(network)]
        self.cell = torch.compile(cell, dynamic=False) if compiled else cell
        self.voxels = [there(x) for x in voxels]
        self.images = torch.tensor(np.asarray(images))[:, :, None]
        start = network.start(voxels.shape[1:-1])
        self.start = list(jax.tree.map(there, start))

    def loss(self) -> Tensor:
        state, images = self.start, []
        for x in self.voxels:
            image, state = self.cell(self.weights, x, state)
            images.append(image)
        return (torch.stack(images) - self.images).abs().mean()

    def step(self) -> Tensor:
        self.optimiser.zero_grad()
        loss = self.loss()
        loss.backward()
        self.optimiser.step()
        return loss.detach()
