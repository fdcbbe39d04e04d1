"""Layers of the published event networks, with PyTorch's semantics.

Images are (..., H, W, channels), kernels HWIO. Padding is explicit: SAME puts the border of a
strided convolution one pixel off. A recurrent layer maps (x, state) to (new state); the state
is an array, or a pair of them.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.downstream.convolution import convolve, for_flax
from evflow.downstream.fusing import carried, joined, parted

Array = jax.Array

BN_EPS = 1e-5


def conv(features: int, size: int, stride: int = 1, *, bias: bool = True, name: str) -> nn.Conv:
    """A convolution that keeps H and W (divided by the stride, rounded up)."""
    pad = (size // 2, size // 2)
    return nn.Conv(features, (size, size), (stride, stride), (pad, pad), use_bias=bias, name=name,
                   conv_general_dilated=for_flax if stride == 1 else None)


def upsample2(x: Array) -> Array:
    """Bilinear, twice as large, pixel centres kept in place (align_corners=False)."""
    *lead, height, width, channels = x.shape
    return jax.image.resize(x, (*lead, 2 * height, 2 * width, channels), "bilinear")


class FrozenBatchNorm(nn.Module):
    """y = scale (x - mean) / sqrt(var + 1e-5) + bias with stored statistics, which get no gradient:
    published networks are run, or fine-tuned, with their statistics."""

    @nn.compact
    def __call__(self, x: Array) -> Array:
        shape = (x.shape[-1],)
        scale = self.param("scale", nn.initializers.ones, shape)
        bias = self.param("bias", nn.initializers.zeros, shape)
        mean = jax.lax.stop_gradient(self.param("mean", nn.initializers.zeros, shape))
        var = jax.lax.stop_gradient(self.param("var", nn.initializers.ones, shape))
        gain = scale * jax.lax.rsqrt(var + BN_EPS)
        return x * _over(gain, x) + _over(bias - mean * gain, x)


def _over(vector: Array, x: Array) -> Array:
    return vector.reshape((1,) * (x.ndim - 1) + vector.shape)


class ConvLayer(nn.Module):
    """Convolution, batch norm where `norm` is "batch" (then without a bias), ReLU or none."""

    features: int
    size: int = 3
    stride: int = 1
    norm: str = "none"
    relu: bool = True

    @nn.compact
    def __call__(self, x: Array) -> Array:
        batch = self.norm == "batch"
        x = conv(self.features, self.size, self.stride, bias=not batch, name="conv")(x)
        x = FrozenBatchNorm(name="norm")(x) if batch else x
        return nn.relu(x) if self.relu else x


class TransposedConvLayer(nn.Module):
    """Transposed convolution 5x5, stride 2, padding 2, output padding 1: twice as large; then
    as ConvLayer. The kernel is HWIO and already flipped, for a convolution of the input with zeros
    between its pixels."""

    features: int
    norm: str = "none"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        batch = self.norm == "batch"
        kernel = self.param("kernel", nn.initializers.lecun_normal(),
                            (5, 5, x.shape[-1], self.features))
        lead = x.shape[:-3]
        x = jax.lax.conv_general_dilated(
            x.reshape(-1, *x.shape[-3:]), kernel, (1, 1), ((2, 3), (2, 3)), lhs_dilation=(2, 2),
            dimension_numbers=("NHWC", "HWIO", "NHWC"))
        x = x.reshape(*lead, *x.shape[1:])
        if batch:
            x = FrozenBatchNorm(name="norm")(x)
        else:
            x = x + _over(self.param("bias", nn.initializers.zeros, (self.features,)), x)
        return nn.relu(x)


class UpsampleConvLayer(nn.Module):
    """Bilinear upsampling by 2, then ConvLayer."""

    features: int
    size: int = 5
    norm: str = "none"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return ConvLayer(self.features, self.size, norm=self.norm, name="layer")(upsample2(x))


class ResidualBlock(nn.Module):
    """relu(x + norm(conv(relu(norm(conv(x))))))."""

    norm: str = "none"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        features = x.shape[-1]
        y = ConvLayer(features, norm=self.norm, name="first")(x)
        return nn.relu(x + ConvLayer(features, norm=self.norm, relu=False, name="second")(y))


class ConvLSTM(nn.Module):
    """One 3x3 convolution of [x, h] gives the gates input, forget, output and the candidate:
    c' = f c + i g, h' = o tanh(c'). State (h, c)."""

    @nn.compact
    def __call__(self, x: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        hidden, cell = state
        gates = conv(4 * x.shape[-1], 3, name="gates")(joined(x, hidden))
        i, f, o, g = parted(gates, 4)
        cell = carried(nn.sigmoid(f) * cell + nn.sigmoid(i) * jnp.tanh(g))
        return nn.sigmoid(o) * jnp.tanh(cell), cell


class ConvGRU(nn.Module):
    """h' = (1 - u) h + u tanh(conv[x, r h]): the update gate u weighs the new value. Update and
    reset gate see the same input: two sets of weights, one convolution."""

    @nn.compact
    def __call__(self, x: Array, state: Array) -> Array:
        features = x.shape[-1]
        gates = [_Weights(features, name=name)(2 * features) for name in ("update", "reset")]
        kernel, bias = (jnp.concatenate(pair, -1) for pair in zip(*gates, strict=True))
        opened = convolve(joined(x, state), kernel)
        update, reset = parted(nn.sigmoid(opened + _over(bias, opened)), 2)
        new = jnp.tanh(conv(features, 3, name="out")(joined(x, state * reset)))
        return carried(state * (1.0 - update) + new * update)


class _Weights(nn.Module):
    """Kernel and bias of a 3x3 convolution, as `conv` has them."""

    features: int

    @nn.compact
    def __call__(self, channels: int) -> tuple[Array, Array]:
        shape = (3, 3, channels, self.features)
        return (self.param("kernel", nn.initializers.lecun_normal(), shape),
                self.param("bias", nn.initializers.zeros, (self.features,)))


def decoder(kind: str, features: int, norm: str, name: str) -> Any:
    """The E2VID decoder layer of a kind: "transposed" or "upsample"."""
    if kind == "transposed":
        return TransposedConvLayer(features, norm, name=name)
    return UpsampleConvLayer(features, norm=norm, name=name)
