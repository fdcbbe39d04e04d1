"""The U-Net of the adversarial systems: images (..., H, W, C) of any size -> maps.

A head at full resolution, encoders that halve, residual blocks, decoders that double (nearest) with
skip connections, and a linear 1x1 prediction at every scale. Channels are normalised per pixel:
batch statistics of the few small crops that two cores can process are noisy, and those of an image
would depend on its size.
"""

from __future__ import annotations

import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

Array = jax.Array

BLOCKS = 2
KERNEL = nn.initializers.he_uniform()
# As EventGAN's authors: predictions start near 0 (PyTorch's kaiming_normal_ with a = 10), layers of
# the critic with PyTorch's default bound, 1 / sqrt(inputs).
GAINS = {"prediction_": 0.1, "critic_": 6.0**-0.5}


def conv(features: int, stride: int = 1, *, bias: bool = True, name: str) -> nn.Conv:
    """3x3, which keeps H and W, or halves them, rounded up."""
    return nn.Conv(features, (3, 3), (stride, stride), ((1, 1), (1, 1)), use_bias=bias,
                   kernel_init=KERNEL, name=name)


def fresh(key: Array, network: nn.Module, x: Array) -> dict[str, Any]:
    """Params of a network of x: kernels by He et al., but of GAINS; biases 0, scales 1. One draw
    for all of them, since XLA:CPU takes .2 s and more to compile each of `network.init`."""
    shapes: Any = jax.eval_shape(network.init, key, x)["params"]
    leaves, tree = jax.tree_util.tree_flatten_with_path(shapes)
    ends = [0]
    for _, leaf in leaves:
        ends.append(ends[-1] + math.prod(leaf.shape))
    drawn = jax.random.uniform(key, (ends[-1],), minval=-1.0)
    made = []
    for i, (path, leaf) in enumerate(leaves):
        name = path[-1].key
        if name == "kernel":
            gain = next((g for n, g in GAINS.items() if path[0].key.startswith(n)), 1.0)
            bound = gain * math.sqrt(6.0 / math.prod(leaf.shape[:-1]))
            made.append(bound * drawn[ends[i]:ends[i + 1]].reshape(leaf.shape))
        else:
            made.append(jnp.full(leaf.shape, float(name == "scale"), leaf.dtype))
    return jax.tree.unflatten(tree, made)


class UNet(nn.Module):
    """Predictions (..., h, w, outputs) from coarse to full resolution, the last one (..., H, W,
    outputs). scales: how many; base: features of the head, doubled by each of the encoders."""

    outputs: int
    base: int = 32
    encoders: int = 4
    scales: int = 1

    @nn.compact
    def __call__(self, x: Array) -> list[Array]:
        height, width = x.shape[-3:-1]
        x = _filled(x, 2**self.encoders)
        x = nn.relu(conv(self.base, name="head")(x))
        skips = []
        for i in range(self.encoders):
            skips.append(x)
            x = Layer(self.base << (i + 1), stride=2, name=f"encoder_{i}")(x)
        for i in range(BLOCKS):
            y = Layer(x.shape[-1], name=f"block_{i}_a")(x)
            x = nn.relu(x + Layer(x.shape[-1], relu=False, name=f"block_{i}_b")(y))
        found = []
        for i, skip in enumerate(reversed(skips)):
            left = self.encoders - 1 - i  # remaining doublings
            x = jnp.concatenate([jnp.repeat(jnp.repeat(x, 2, -3), 2, -2), skip], -1)
            x = Layer(self.base << left, name=f"decoder_{i}")(x)
            if left < self.scales:
                y = nn.Conv(
                    self.outputs, (1, 1), kernel_init=KERNEL, name=f"prediction_{left}")(x)
                found.append(y[..., :-(-height >> left), :-(-width >> left), :])
        return found


class Layer(nn.Module):
    """3x3 convolution, normalised over the channels of each pixel, ReLU or none."""

    features: int
    stride: int = 1
    relu: bool = True

    @nn.compact
    def __call__(self, x: Array) -> Array:
        x = conv(self.features, self.stride, bias=False, name="conv")(x)
        x = nn.LayerNorm(name="norm")(x)
        return nn.relu(x) if self.relu else x


def _filled(x: Array, stride: int) -> Array:
    """x with its last rows and columns repeated to a multiple of `stride`."""
    spare = [(0, -n % stride) for n in x.shape[-3:-1]]
    return jnp.pad(x, [(0, 0)] * (x.ndim - 3) + [*spare, (0, 0)], mode="edge")
