"""Quality of optical flow: sharpness of warped events (FWL, RSAT), or error (AEE).

Events are arrays of a fixed length N, weight 0 for padding; flow (2, H, W) = (x, y) in pixels per
unit of the events' time. Pure, jit-able, batched by vmap. FWL of the same flow differs by window,
splat and polarity (1.1 to 1.4 for the true flow over 50 ms), so these are always reported.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates

from evflow.errors import EvflowDataError
from evflow.metrics.image import as_array, pair_up

Array = jax.Array

SPLATS = ("bilinear", "round")
POLARITIES = ("count", "signed")
REFERENCES = ("last", "first")


@dataclasses.dataclass(frozen=True)
class FwlConvention:
    """How the flow warp loss is measured.

    reference: events are transported to the time of the "last" or the "first" event; splat: each
    adds to the four pixels around ("bilinear") or to the nearest ("round"); polarity: events
    "count", or add their sign ("signed"); blur: standard deviation in px of a Gaussian over the
    images. The defaults count bilinear votes at the last event, without blur.
    """

    reference: str = "last"
    splat: str = "bilinear"
    polarity: str = "count"
    blur: float = 0.0

    def __post_init__(self) -> None:
        for name, choices in (("reference", REFERENCES), ("splat", SPLATS),
                              ("polarity", POLARITIES)):
            if getattr(self, name) not in choices:
                raise EvflowDataError("EV020", f"FwlConvention({name}={getattr(self, name)!r}).",
                                      f"Choose one of {choices}.")
        if not isinstance(self.blur, int | float) or not 0 <= self.blur < math.inf:
            raise EvflowDataError("EV020", f"FwlConvention(blur={self.blur!r}).",
                                  "It must be >= 0.")

    def as_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


FWL = FwlConvention()


def fwl(
    x: Array, y: Array, t: Array, p: Array, weight: Array, flow: Array,
    convention: FwlConvention = FWL,
) -> Array:
    """Flow warp loss Var(I(flow)) / Var(I(0)) of one window; above 1 where the flow is better
    than none (Stoffregen et al., ECCV 2020). NaN where the events give an even image, or none.

    x, y, t: (N,), also between pixels, of any dtype and origin; p: (N,) bool or sign; weight: (N,)
    1, or 0 for padding; flow: (2, H, W) px per unit of t.
    Raises EV002 (shapes), EV020 (not an FwlConvention), as do `warped_image` and `rsat`.
    """
    flow = _flow(flow)
    warped = warped_image(x, y, t, p, weight, flow, convention)
    still = warped_image(x, y, t, p, weight, jnp.zeros_like(flow), convention)
    scale = jnp.var(still)
    return jnp.where(scale > 0, jnp.var(warped) / jnp.where(scale > 0, scale, 1.0), jnp.nan)


def warped_image(
    x: Array, y: Array, t: Array, p: Array, weight: Array, flow: Array,
    convention: FwlConvention = FWL,
) -> Array:
    """Image (H, W) of the events transported along the flow at their pixels, read bilinearly:
    x' = x + (t_ref - t) v(x, y). What leaves the image is lost. Arguments as of `fwl`."""
    if not isinstance(convention, FwlConvention):
        raise EvflowDataError("EV020", f"convention {convention!r}.", "Give an FwlConvention.")
    x, y, t, p, weight = _columns(x, y, t, p, weight)
    flow = _flow(flow)
    warped_x, warped_y, _ = _transported(x, y, t, weight, flow, convention.reference)
    if convention.polarity == "signed":
        weight = weight * jnp.where(p > 0, 1.0, -1.0).astype(weight.dtype)
    shape = (flow.shape[-2], flow.shape[-1])
    image = splat(warped_x, warped_y, weight, shape, convention.splat)
    return _gaussian_blur(image, convention.blur) if convention.blur else image


def rsat(x: Array, y: Array, t: Array, p: Array, weight: Array, flow: Array) -> Array:
    """Ratio of the squared average timestamps, warped to unwarped, of both polarities per active
    pixel, each event voting for the nearest one; below 1 where the flow is better than none
    (Hagenaars et al., NeurIPS 2021). Unlike FWL, it does not reward flow that collapses all events.
    Arguments as of `fwl`."""
    columns, flow = _columns(x, y, t, p, weight), _flow(flow)
    return _timestamps(*columns, flow) / _timestamps(*columns, jnp.zeros_like(flow))


def _flow(flow: Any) -> Array:
    flow = jnp.asarray(as_array(flow))
    if flow.ndim != 3 or flow.shape[0] != 2:
        raise EvflowDataError("EV002", f"flow is {flow.shape}.",
                              "Expected (2, H, W); vmap takes several.")
    return flow


def _columns(
    x: Any, y: Any, t: Any, p: Any, weight: Any
) -> tuple[Array, Array, Array, Array, Array]:
    """Events as floats, but for p. Times of NumPy count from the first event: an epoch's seconds
    would be rounded to minutes."""
    t = t if hasattr(t, "ndim") else np.asarray(t)
    x, y, t, p, weight = map(as_array, (x, y, t, p, weight))
    shapes = [a.shape for a in (x, y, t, p, weight)]
    if t.ndim != 1 or len(set(shapes)) > 1:
        raise EvflowDataError("EV002", f"x, y, t, p, weight are {', '.join(map(str, shapes))}.",
                              "Expected five of (N,); vmap takes several windows.")
    if isinstance(t, np.ndarray) and t.size:
        traced = isinstance(weight, jax.core.Tracer)
        real = np.ones(len(t), bool) if traced else np.asarray(weight, bool)
        t = t - t[real].min() if real.any() else t
    x, y, t, weight = (a if jnp.issubdtype(a.dtype, jnp.floating) else a.astype(float)
                       for a in map(_on_device, (x, y, t, weight)))
    return x, y, t, jnp.asarray(p), weight


def _on_device(a: Any) -> Array:
    """As a JAX array; doubles become floats, without a warning, where JAX has no doubles."""
    return jnp.asarray(a, jnp.result_type(a))


def _timestamps(x: Array, y: Array, t: Array, p: Array, weight: Array, flow: Array) -> Array:
    shape = (flow.shape[-2], flow.shape[-1])
    x, y, age = _transported(x, y, t, weight, flow, "last")
    age = 1.0 - age / jnp.maximum(jnp.max(age * weight, initial=0.0), jnp.finfo(age.dtype).tiny)
    squares, active = jnp.zeros((), flow.dtype), jnp.zeros(shape, bool)
    for mine in (p > 0, p <= 0):
        votes = weight * mine.astype(weight.dtype)
        count = splat(x, y, votes, shape, "round")
        mean = splat(x, y, votes * age, shape, "round") / (count + 1e-9)
        squares, active = squares + jnp.sum(mean**2), active | (count > 0)
    return squares / jnp.maximum(jnp.sum(active), 1)


def _transported(
    x: Array, y: Array, t: Array, weight: Array, flow: Array, reference: str
) -> tuple[Array, Array, Array]:
    """Where the events are at the reference time, and t_ref - t."""
    there = weight > 0
    if reference == "last":
        t_ref = jnp.max(jnp.where(there, t, -jnp.inf), initial=-jnp.inf)
    else:
        t_ref = jnp.min(jnp.where(there, t, jnp.inf), initial=jnp.inf)
    time = jnp.where(there, t_ref - t, 0.0)
    u, v = (map_coordinates(part, [y, x], order=1, mode="nearest") for part in flow)
    return x + time * u, y + time * v, time


def splat(
    x: Array, y: Array, weight: Array, shape: tuple[int, int], kind: str = "bilinear"
) -> Array:
    """Sum of weights (N,) at (x, y) as an image (H, W): each to the four pixels around, or to the
    nearest one. Votes outside the image are lost."""
    if kind == "round":
        corners = [(jnp.round(x), jnp.round(y), weight)]
    else:
        x0, y0 = jnp.floor(x), jnp.floor(y)
        fx, fy = x - x0, y - y0
        corners = [(x0 + dx, y0 + dy, weight * (fx if dx else 1 - fx) * (fy if dy else 1 - fy))
                   for dy in (0, 1) for dx in (0, 1)]
    height, width = shape
    image = jnp.zeros(height * width, weight.dtype)
    for column, row, vote in corners:
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        index = jnp.where(inside, row * width + column, height * width).astype(jnp.int32)
        image = image.at[index].add(vote, mode="drop")
    return image.reshape(shape)


def _gaussian_blur(image: Array, sigma: float) -> Array:
    """Gaussian, cut off at 4 sigma, edges repeated."""
    radius = max(1, round(4 * sigma))
    taps = jnp.exp(-0.5 * (jnp.arange(-radius, radius + 1, dtype=image.dtype) / sigma) ** 2)
    taps = taps / taps.sum()
    image = jnp.pad(image, radius, mode="edge")
    rows = jax.vmap(lambda line: jnp.convolve(line, taps, "valid"))(image)
    return jax.vmap(lambda line: jnp.convolve(line, taps, "valid"))(rows.T).T


def endpoint_error(flow: Array, truth: Array) -> Array:
    """|flow - truth| of (..., 2, H, W): (..., H, W), px. Raises EV002."""
    flow, truth = as_array(flow), as_array(truth)
    if flow.ndim < 3 or flow.shape[-3] != 2 or flow.shape[-3:] != truth.shape[-3:] or not pair_up(
            flow, truth):
        raise EvflowDataError("EV002", f"flow is {flow.shape}, truth {truth.shape}.",
                              "Expected two of (..., 2, H, W).")
    square = jnp.sum((flow - truth) ** 2, -3)
    still = square == 0  # where the root has no gradient; NaN stays NaN
    return jnp.where(still, 0.0, jnp.sqrt(jnp.where(still, 1.0, square)))


def aee(
    flow: Array, truth: Array, mask: Array | None = None, *, outlier_px: float = 3.0
) -> tuple[Array, Array]:
    """Average endpoint error in px, and the percentage of pixels beyond `outlier_px`; of flows
    (..., 2, H, W) where mask (..., H, W) is not 0: by custom, pixels with events and a valid truth.
    Where the truth is NaN it is unknown, and not scored. Both NaN where nothing is left. Raises
    EV002."""
    flow, truth = (jnp.asarray(as_array(f)) for f in (flow, truth))
    if flow.ndim < 3 or flow.shape[-3] != 2 or flow.shape != truth.shape:
        raise EvflowDataError("EV002", f"flow is {flow.shape}, truth {truth.shape}.",
                              "Expected two of (..., 2, H, W).")
    known = jnp.isfinite(truth).all(-3)
    if mask is not None and jnp.shape(mask) != known.shape:
        raise EvflowDataError("EV002", f"mask is {jnp.shape(mask)}.", f"Expected {known.shape}.")
    mask = known if mask is None else known & (jnp.asarray(mask) != 0)
    error = endpoint_error(flow, jnp.where(mask[..., None, :, :], truth, flow))
    count = mask.sum((-2, -1))
    error = jnp.where(mask, error, 0.0)
    beyond = (~(error <= outlier_px)).astype(error.dtype)  # NaN is no hit
    return error.sum((-2, -1)) / count, 100.0 * beyond.sum((-2, -1)) / count
