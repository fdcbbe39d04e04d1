"""EV-FlowNet: an event tensor -> optical flow, by a U-Net without memory (Zhu et al., RSS 2018).

Two forms: one linear prediction at full resolution, trained on true flow (Stoffregen et al.,
ECCV 2020); or the original's predictions 256 tanh at four scales, each fed to the next decoder. The
second differs from the original by having no batch norm, another input (the original's is counts
and last times per polarity) and a ReLU after residual blocks; the original was trained with
rotations, windows of one to five frame intervals and weight decay. The flow is (..., 2, H, W) =
(x, y), px over the window.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.checks import require
from evflow.downstream.layers import ConvLayer, ResidualBlock, upsample2
from evflow.downstream.network import Network, Params, State

Array = jax.Array

ENCODERS = 4
BLOCKS = 2
MOST_PX = 256.0  # what the original's tanh is scaled to
NEAR_ZERO = 0.1  # px: initial predictions for features of 1


@dataclasses.dataclass(frozen=True)
class EVFlowNet(Network):
    """scales: 1 or 4, the two forms; encoders: how often H and W are halved, 4 of the published
    ones. 14 125 346 parameters at base 64, four encoders and one scale."""

    base: int = 64
    scales: int = 1
    encoders: int = ENCODERS

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "encoders", 2 <= self.encoders <= 8, "2 to 8")
        require(self, "scales", self.scales in (1, self.encoders), f"1 or {self.encoders}")

    @property
    def stride(self) -> int:
        return 2**self.encoders

    def module(self) -> nn.Module:
        return _EVFlowNet(self)

    def init(self, key: Array, shape: tuple[int, int]) -> Params:
        """Fresh params by He et al., ICCV 2015, and predictions near zero flow.

        Flax's default kernels halve the variance at each layer with a ReLU. The deepest path has
        eight of these, the shortest two, so the path for large motion would contribute little.
        Predictions start near zero, as flow that leaves the image gets no gradient from frames.
        """
        params = super().init(key, shape)
        near_zero = NEAR_ZERO if self.scales == 1 else NEAR_ZERO / MOST_PX
        gains = {name: near_zero if name.startswith("prediction") else math.sqrt(2.0)
                 for name in params}
        return {name: jax.tree.map(lambda a, gain=gains[name]: gain * a, layer)
                for name, layer in params.items()}

    def _start(self, shape: tuple[int, ...], dtype: Any) -> State:
        return ()

    def _finish(self, image: Array) -> Array:
        return jnp.moveaxis(image, -1, -3)

    def pyramid(self, params: Params, voxels: Array) -> tuple[Array, ...]:
        """Flows at 1/8, 1/4, 1/2 and full resolution (scales = 4), or only the last, each in pixels
        of its own scale. H and W must be multiples of 16."""
        flows: Any = self.module().apply({"params": params}, voxels, method="flows")
        return tuple(self._finish(flow) for flow in flows)


class _EVFlowNet(nn.Module):
    c: EVFlowNet

    def __call__(self, x: Array, state: State) -> tuple[Array, State]:
        return self.flows(x)[-1], state

    @nn.compact
    def flows(self, x: Array) -> list[Array]:
        c = self.c
        skips: list[Array] = []
        flows: list[Array] = []
        for i in range(c.encoders):
            x = ConvLayer(c.base << i, stride=2, name=f"encoder_{i}")(x)
            skips.append(x)
        for i in range(BLOCKS):
            x = ResidualBlock(name=f"block_{i}")(x)
        for i, skip in enumerate(reversed(skips)):
            x = jnp.concatenate([x, skip, *flows[-1:]], -1)
            x = self._doubled(x, (c.base << c.encoders - 2) >> i, f"decoder_{i}")
            if c.scales > 1:
                flow = ConvLayer(2, 1, relu=False, name=f"prediction_{i}")(x)
                flows.append(MOST_PX * jnp.tanh(flow))
        return flows or [ConvLayer(2, 1, relu=False, name="prediction")(x)]

    def _doubled(self, x: Array, features: int, name: str) -> Array:
        """One scale: bilinear, then zeros around. Four: nearest, then mirrored around."""
        if self.c.scales == 1:
            return ConvLayer(features, name=name)(upsample2(x))
        x = jnp.repeat(jnp.repeat(x, 2, -3), 2, -2)
        around = [(0, 0)] * (x.ndim - 3) + [(1, 1), (1, 1), (0, 0)]
        x = jnp.pad(x, around, mode="reflect")
        return nn.relu(nn.Conv(features, (3, 3), padding="VALID", name=name)(x))
