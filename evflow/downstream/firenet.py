"""FireNet: event tensors -> video at full resolution, by two ConvGRUs (Scheerlinck et al.,
WACV 2020): head, GRU, residual block, GRU, residual block, prediction."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.downstream.layers import ConvGRU, ConvLayer, ResidualBlock
from evflow.downstream.network import Network, State

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class FireNet(Network):
    """37 777 parameters at base 16, 75 kFLOP per pixel and frame; any H and W, nothing padded."""

    base: int = 16

    @property
    def stride(self) -> int:
        return 1

    def module(self) -> nn.Module:
        return _FireNet(self)

    def _start(self, shape: tuple[int, ...], dtype: Any) -> State:
        zeros = jnp.zeros((*shape, self.base), dtype)
        return zeros, zeros


class _FireNet(nn.Module):
    c: FireNet

    @nn.compact
    def __call__(self, x: Array, state: State) -> tuple[Array, State]:
        x = ConvLayer(self.c.base, name="head")(x)
        new = []
        for i in range(2):
            new.append(ConvGRU(name=f"gru_{i}")(x, state[i]))
            x = ResidualBlock(name=f"block_{i}")(new[-1])
        return ConvLayer(1, 1, relu=False, name="prediction")(x), tuple(new)
