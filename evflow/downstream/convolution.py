"""The convolution of the event networks, whose kernel gradient is also fast on a CPU.

XLA:CPU computes that gradient as a convolution whose window is the whole image, at 10 to 30 GFLOP/s
of one core for layers with few output features or images larger than a cache, while forward and
input gradient reach 60 to 130. In these cases it is a matrix product here: x against copies of the
cotangent shifted by every offset of the kernel, a few hundred pixels at a time so that the copies
stay in a cache (33 to 80 GFLOP/s). The derivative is exact; other devices use XLA's own.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

Array = jax.Array

PIXELS = 256  # of one product; 1024 take 1.3 times as long (48x48, 32 to 16 features)
# Limit of multiplications of a product: XLA divides one of twice as many between two cores, which
# takes 1.8 times as long as one core alone (32 to 32 features at 128x128).
PRODUCT = 32 * 144 * PIXELS
# XLA's gradient is used for FEW and more output features (67 to 95 GFLOP/s) on a batch of at most
# LARGE pixels (30 GFLOP/s at four of 128x128).
FEW = 32
LARGE = 1 << 14


def convolve(x: Array, kernel: Array) -> Array:
    """x (..., H, W, C), kernel (k, k, C, F) with k odd -> (..., H, W, F): stride 1, zeros around.
    Differentiable in reverse mode."""
    if kernel.shape[0] == 1:
        return jnp.dot(x, kernel[0, 0])
    images = x.reshape(-1, *x.shape[-3:])
    method = _with_products if _products_pay(images, kernel) else _plain
    return method(images, kernel).reshape(*x.shape[:-1], kernel.shape[-1])


def for_flax(x: Array, kernel: Array, *_: Any, **__: Any) -> Array:
    """`convolve` with the signature that `nn.Conv` calls. Its other arguments are ignored, and must
    describe the same convolution."""
    return convolve(x, kernel)


def _products_pay(x: Array, kernel: Array) -> bool:
    batch, height, width, channels = x.shape
    few = kernel.shape[-1] < FEW or batch * height * width > LARGE
    return channels >= 8 and few


def _plain(x: Array, kernel: Array) -> Array:
    pad = (kernel.shape[0] // 2,) * 2
    return lax.conv_general_dilated(
        x, kernel, (1, 1), (pad, pad), dimension_numbers=("NHWC", "HWIO", "NHWC"))


@jax.custom_vjp
def _with_products(x: Array, kernel: Array) -> Array:
    return _plain(x, kernel)


def _forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return _plain(x, kernel), (x, kernel)


def _backward(kept: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    x, kernel = kept
    to_input = jnp.flip(kernel, (0, 1)).swapaxes(2, 3)
    to_kernel: Array = lax.platform_dependent(
        x, kernel, cotangent, cpu=_kernel_gradient, default=_xla_kernel_gradient)
    return _plain(cotangent, to_input), to_kernel


_with_products.defvjp(_forward, _backward)


def _xla_kernel_gradient(x: Array, kernel: Array, cotangent: Array) -> Array:
    return jax.vjp(lambda kernel: _plain(x, kernel), kernel)[1](cotangent)[0]


def _kernel_gradient(x: Array, kernel: Array, cotangent: Array) -> Array:
    """The sum over pixels p of x[p] cotangent[p - offset], for every offset of the kernel."""
    size, _, channels, features = kernel.shape
    wide = size * size * features
    batch, height, width, _ = x.shape
    pixels = min(PIXELS, PRODUCT // (channels * wide))
    rows = max(1, min(height, pixels // width))
    images = max(1, min(batch, pixels // (height * width)))
    images, more = (images, -batch % images) if rows == height else (1, 0)
    below, around = -height % rows, size // 2
    x = jnp.pad(x, ((0, more), (0, below), (0, 0), (0, 0)))  # padding adds 0
    cotangent = jnp.pad(
        cotangent, ((0, more), (around, around + below), (around, around), (0, 0)))
    strips = (height + below) // rows

    def add_block(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        total, moved = carry
        first, top = i // strips * images, i % strips * rows

        def part(a: Array, down: int, right: int) -> Array:
            shape = (images, rows, width, a.shape[-1])
            return lax.dynamic_slice(a, (first, top + down, right, 0), shape)

        for tap in range(size * size):  # into one buffer: concatenate would be fused, and slow
            piece = part(cotangent, size - 1 - tap // size, size - 1 - tap % size)
            moved = lax.dynamic_update_slice(moved, piece, (0, 0, 0, tap * features))
        product = lax.dot_general(part(x, 0, 0).reshape(-1, channels), moved.reshape(-1, wide),
                                  (((0,), (0,)), ((), ())))
        return total + product, moved

    start = (jnp.zeros((channels, wide), x.dtype), jnp.zeros((images, rows, width, wide), x.dtype))
    total, _ = lax.fori_loop(0, (batch + more) // images * strips, add_block, start)
    return total.reshape(channels, size, size, features).transpose(1, 2, 0, 3)
