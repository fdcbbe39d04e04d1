"""Shared by the event networks: pure init and apply, padding, running over a sequence.

A network is a frozen dataclass of its static structure; its params are a nested dict of arrays,
its state a pytree. `apply` takes one event tensor, `run` a sequence of them.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.checks import require
from evflow.errors import EvflowDataError

Array = jax.Array
Params = dict[str, Any]
State = Any  # a pytree of arrays; () for networks without memory

PADDINGS = {"zeros": "constant", "reflect": "reflect"}


@dataclasses.dataclass(frozen=True)
class Network:
    """A network from event tensors (..., H, W, bins) to images; see the subclasses.

    bins: channels of the event tensor; base: features of the first layer; padding: of H and W to
    multiples of `stride`, at all sides, "zeros" or "reflect".
    """

    bins: int = 5
    base: int = 32
    padding: str = "zeros"

    def __post_init__(self) -> None:
        for name in ("bins", "base"):
            value = getattr(self, name)
            require(self, name, isinstance(value, int) and value >= 1, "a whole number, >= 1")
        require(self, "padding", self.padding in PADDINGS, f"one of {sorted(PADDINGS)}")

    @property
    def stride(self) -> int:
        """H and W are padded to a multiple of this."""
        raise NotImplementedError

    def module(self) -> nn.Module:
        """The flax module: (x, state) -> (image (..., H, W, C), state) on padded x."""
        raise NotImplementedError

    def _start(self, shape: tuple[int, ...], dtype: Any) -> State:
        """Zero state for a padded (..., H, W)."""
        raise NotImplementedError

    def _finish(self, image: Array) -> Array:
        """Convert (..., H, W, C) to the output of `apply`."""
        return image[..., 0]

    def init(self, key: Array, shape: tuple[int, int]) -> Params:
        """Fresh params; shape: (H, W) of any input (they do not depend on it)."""
        size = tuple(n + -n % self.stride for n in shape)
        x = jnp.zeros((1, *size, self.bins))
        variables = jax.jit(self.module().init)(key, x, self._start((1, *size), x.dtype))
        return dict(variables["params"])

    def start(self, shape: tuple[int, ...], dtype: Any = jnp.float32) -> State:
        """The zero state before the first of a sequence of tensors (..., H, W, bins); shape:
        (..., H, W)."""
        *lead, height, width = shape
        return self._start(
            (*lead, height + -height % self.stride, width + -width % self.stride), dtype)

    def apply(self, params: Params, voxels: Array, state: State = None) -> tuple[Array, State]:
        """Event tensor (..., H, W, bins) -> image (..., H, W) and the next state.

        state: None before the first tensor. Raises EV002 where the channels are not `bins`, or the
        state is not one of such a tensor.
        """
        voxels = as_floats(voxels, params)
        if voxels.ndim < 3 or voxels.shape[-1] != self.bins:
            raise EvflowDataError("EV002", f"the event tensor is {voxels.shape}.",
                                  f"Expected (..., H, W, {self.bins}).")
        if state is None:
            state = self.start(voxels.shape[:-1], voxels.dtype)
        else:
            self._require_state(state, voxels)
        x, (top, left) = self._pad(voxels)
        image, state = self.module().apply({"params": params}, x, state)
        height, width = voxels.shape[-3:-1]
        return self._finish(image[..., top:top + height, left:left + width, :]), state

    def _require_state(self, state: State, voxels: Array) -> None:
        """Raise EV002 unless the state fits a tensor like `voxels`."""
        wanted = jax.tree.leaves(jax.eval_shape(lambda: self.start(voxels.shape[:-1])))
        have, fitting = ([jnp.shape(a) for a in leaves]
                         for leaves in (jax.tree.leaves(state), wanted))
        if have != fitting:
            raise EvflowDataError(
                "EV002", f"the state's arrays are {have}, the event tensor is {voxels.shape}.",
                f"It follows a state of {fitting}; begin another size or batch with state=None.")

    def _pad(self, x: Array) -> tuple[Array, tuple[int, int]]:
        """Padded x, and the rows and columns added at the top and left: the larger part of an odd
        number, as in the published evaluations."""
        spare = [-n % self.stride for n in x.shape[-3:-1]]
        before = [(n + 1) // 2 for n in spare]
        if not any(spare):
            return x, (0, 0)
        widths = [(0, 0)] * (x.ndim - 3) + [
            (b, n - b) for b, n in zip(before, spare, strict=True)] + [(0, 0)]
        return jnp.pad(x, widths, mode=PADDINGS[self.padding]), (before[0], before[1])


def as_floats(voxels: Any, params: Params) -> Array:
    """On the device, in the dtype of the network's arithmetic."""
    return jnp.asarray(voxels, jnp.result_type(voxels, *jax.tree.leaves(params)))


def run(
    network: Network, params: Params, voxels: Array, state: State = None, *, train: bool = False
) -> tuple[Array, State]:
    """Event tensors (T, ..., H, W, bins) -> images (T, ..., H, W) and the last state.

    train: whether gradients will be taken. XLA:CPU computes the gradient of a convolution within a
    loop 17 times slower than outside, so on a CPU the sequence is unrolled; elsewhere each step is
    recomputed in the backward pass, which needs the memory of one step only. Raises EV002 where
    shapes do not fit.
    """
    voxels = as_floats(voxels, params)
    if voxels.ndim < 4:
        raise EvflowDataError("EV002", f"the event tensors are {voxels.shape}.",
                              f"Expected (T, ..., H, W, {network.bins}).")
    if state is None:
        state = network.start(voxels.shape[1:-1], voxels.dtype)

    def step(state: State, x: Array) -> tuple[State, Array]:
        image, state = network.apply(params, x, state)
        return state, image

    if train and jax.default_backend() == "cpu" and len(voxels):
        made = []
        for x in voxels:
            state, image = step(state, x)
            made.append(image)
        return jnp.stack(made), state
    body: Any = jax.checkpoint(step) if train else step
    state, images = jax.lax.scan(body, state, voxels)
    return images, state
