"""E2VID: event tensors -> video, by a recurrent U-Net (Rebecq et al., PAMI 2019).

Head, encoders that halve and remember (ConvLSTM), residual blocks, decoders that double, a
prediction of one channel; the skips are added, or joined.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.checks import require
from evflow.downstream.layers import ConvLayer, ConvLSTM, ResidualBlock, decoder
from evflow.downstream.network import Network, State

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class E2VID(Network):
    """The E2VID family; the defaults are those of E2VID+ (Stoffregen et al., ECCV 2020).

    encoders, blocks: how many; decoder: "upsample" (bilinear, convolution) or "transposed";
    norm: "none" or "batch"; skip: "sum" or "concat"; output: "linear" or "sigmoid".
    10 710 401 parameters at base 32, 908 kFLOP per pixel and frame.
    """

    encoders: int = 3
    blocks: int = 2
    decoder: str = "upsample"
    norm: str = "none"
    skip: str = "sum"
    output: str = "linear"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "encoders", 1 <= self.encoders <= 8, "1 to 8")
        require(self, "blocks", self.blocks >= 0, ">= 0")
        for name, choices in (("decoder", ("transposed", "upsample")), ("norm", ("batch", "none")),
                              ("skip", ("concat", "sum")), ("output", ("linear", "sigmoid"))):
            require(self, name, getattr(self, name) in choices, f"one of {choices}")

    @property
    def stride(self) -> int:
        return 2**self.encoders

    def module(self) -> nn.Module:
        return _E2VID(self)

    def _start(self, shape: tuple[int, ...], dtype: Any) -> State:
        *lead, height, width = shape
        zeros = (jnp.zeros((*lead, height >> i, width >> i, self.base << i), dtype)
                 for i in range(1, self.encoders + 1))
        return tuple((z, z) for z in zeros)


# As published: E2VID (its `E2VID_lightweight` file) and E2VID+.
E2VID_LIGHTWEIGHT = E2VID(decoder="transposed", norm="batch", output="sigmoid", padding="reflect")
E2VID_PLUS = E2VID()
E2VID_SMALL = E2VID(base=8, encoders=2, blocks=1)  # trains on a CPU: 0.14 M parameters


class _E2VID(nn.Module):
    c: E2VID

    @nn.compact
    def __call__(self, x: Array, state: State) -> tuple[Array, State]:
        c = self.c

        def joined(x: Array, skip: Array) -> Array:
            return x + skip if c.skip == "sum" else jnp.concatenate([x, skip], -1)

        head = x = ConvLayer(c.base, 5, name="head")(x)
        new = []
        for i in range(c.encoders):
            x = ConvLayer(c.base << (i + 1), 5, 2, c.norm, name=f"encoder_{i}")(x)
            new.append(ConvLSTM(name=f"lstm_{i}")(x, state[i]))
            x = new[-1][0]
        for i in range(c.blocks):
            x = ResidualBlock(c.norm, name=f"block_{i}")(x)
        for i in range(c.encoders):
            level = c.encoders - 1 - i
            layer = decoder(c.decoder, c.base << level, c.norm, f"decoder_{i}")
            x = layer(joined(x, new[level][0]))
        x = ConvLayer(1, 1, norm=c.norm, relu=False, name="prediction")(joined(x, head))
        return nn.sigmoid(x) if c.output == "sigmoid" else x, tuple(new)
