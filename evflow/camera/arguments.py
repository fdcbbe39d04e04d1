"""Keys, shapes of maps, numbers and arrays of them at the border; traced ones pass."""

from __future__ import annotations

import math
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.checks import plain
from evflow.errors import EvflowDataError

Array = jax.Array


def check_key(key: Any) -> None:
    """Raise EV020 unless it is one key of jax.random."""
    dtype, shape = str(getattr(key, "dtype", None)), getattr(key, "shape", ())
    one: tuple[int, ...] = ()
    if dtype == "uint32":  # the older kind of key: an array of words
        one = jax.eval_shape(jax.random.PRNGKey, 0).shape
    if not (dtype.startswith("key<") or one) or shape[len(shape) - len(one):] != one:
        raise EvflowDataError("EV020", f"key is {key!r:.60}.",
                              "Give a key of jax.random: jax.random.key(0).")
    if shape != one:
        raise EvflowDataError("EV020", f"key holds keys of shape {shape}.",
                              "Give one of them: keys[0].")


def shape_of_maps(shape: Any) -> tuple[int, ...]:
    """The shape (..., H, W) as ints; raises EV002."""
    try:
        sides = tuple(operator.index(side) for side in shape)
    except TypeError:
        sides = ()
    if len(sides) < 2 or min(sides) < 0:
        raise EvflowDataError("EV002", f"shape is {shape!r:.60}.",
                              "Expected (..., H, W), whole numbers.")
    return sides


def parameter(name: str, value: Any) -> Any:
    """A value of maps, a number or an array; raises EV014 for anything else."""
    if isinstance(value, np.ndarray | jax.Array) or not math.isnan(number(value)) or (
            isinstance(value, float)):
        return value
    raise EvflowDataError("EV014", f"{name}={value!r:.60}.", "Give a number.")


def full_map(name: str, value: Any, shape: tuple[int, ...]) -> jax.Array:
    """A map (..., H, W) of a value; raises EV014 as `parameter`, EV002 for values of another
    shape."""
    try:
        return jnp.full(shape, parameter(name, value), jnp.float32)
    except ValueError:
        raise EvflowDataError("EV002", f"{name} has shape {np.shape(value)} for maps of {shape}.",
                              "Give one number, or a map.") from None


def number(value: Any) -> float:
    """An argument that is one number, as a float; NaN if it is something else, as text is."""
    try:
        return math.nan if np.ndim(value) or isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError):
        return math.nan


def pair(values: Any) -> tuple[float, float]:
    """An argument (low, high), as floats; NaN if it is something else."""
    try:
        low, high = values
    except (TypeError, ValueError):
        return math.nan, math.nan
    return number(low), number(high)


def is_real(dtype: Any) -> bool:
    """Whether a dtype is real (including bfloat16, and float8, which NumPy calls void) or bool."""
    return np.dtype(dtype).kind == "b" or (
        jnp.issubdtype(dtype, jnp.number) and not jnp.issubdtype(dtype, jnp.complexfloating))


def map_on_host(name: str, values: Any) -> np.ndarray:
    """A camera's map as a NumPy array; raises EV014 unless it holds real numbers."""
    array = np.asarray(plain(name, values))
    if not is_real(array.dtype):
        raise EvflowDataError("EV014", f"{name} has dtype {array.dtype}.",
                              "A map holds real numbers.")
    return array


def real(values: ArrayLike) -> Array:
    """Convert to float32; float64 is kept in JAX's x64 mode."""
    values = plain("the input", values)
    values = jax.device_put(values) if isinstance(values, np.ndarray) else jnp.asarray(values)
    return values if values.dtype == jnp.float64 else values.astype(jnp.float32)


def real_maps(maps: Any) -> Any:
    """A camera or summary of `real` arrays: its maps may be lists, integers, or bytes of another
    order, which JAX would misread."""
    return type(maps)(*(real(values) for values in vars(maps).values()))
