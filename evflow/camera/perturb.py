"""Pixels that differ from their neighbours: hot ones, dead ones, and measured noise.

Functions take a `Camera` and return a `Camera`. `with_faults` makes a small share of the pixels hot
or dead; `with_noise_histogram` gives every pixel the noise rates of a measured one. The
measurements are host-side files in the layout of IEBCS (Joubert et al., Frontiers in Neuroscience
2021).
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.camera.arguments import check_key, number, pair, real_maps
from evflow.checks import need
from evflow.errors import EvflowDataError

Array = jax.Array

DEAD_THETA = 1e3  # log units; the whole range of 8-bit video spans 5.5
AXIS_HZ = np.outer(10.0 ** np.arange(-3, 5), np.arange(1, 10)).ravel()  # 1..9 x 10^k, (72,)


def with_faults(
    key: Array, camera: Camera, hot: float = 1e-3, hot_hz: tuple[float, float] = (5.0, 100.0),
    dead: float = 1e-3,
) -> Camera:
    """The camera with a few of its pixels hot and a few dead, chosen at random.

    A hot pixel keeps its thresholds, and its noise rates are log-uniform in hot_hz, ON and OFF
    independently. A dead pixel has thresholds of 1e3 and no noise: neither light nor leak makes
    it fire.

    Args:
        key: of jax.random.
        camera: maps (..., H, W).
        hot: share of the pixels that are hot, 0..1.
        hot_hz: (low, high) of their noise rates in Hz, 0 < low <= high.
        dead: share of the pixels that are dead, 0..1; hot + dead <= 1.

    Returns:
        A camera of the same shape.

    Raises:
        EvflowDataError: EV002, EV014, EV015 (no valid camera), EV020 (impossible shares or rates;
            no key or camera).
    """
    camera = _checked(key, camera)
    if not (number(hot) >= 0 and number(dead) >= 0 and hot + dead <= 1):
        raise EvflowDataError("EV020", f"hot={hot!r:.60}, dead={dead!r:.60}.",
                              "Give shares of the pixels, >= 0 and at most 1 together.")
    low, high = pair(hot_hz)
    if not 0 < low <= high < np.inf:
        raise EvflowDataError("EV020", f"hot_hz={hot_hz}.", "Give (low, high) in Hz, 0 < low.")
    k_which, k_rate = jax.random.split(key)
    dtype = jnp.result_type(camera.eta_on)
    which = jax.random.uniform(k_which, camera.shape, dtype)
    rates = jnp.exp(jax.random.uniform(
        k_rate, (2, *camera.shape), dtype, minval=np.log(low), maxval=np.log(high)))
    is_hot, is_dead = which < hot, which >= 1.0 - dead

    def theta(value: Array) -> Array:
        return jnp.where(is_dead, jnp.asarray(DEAD_THETA, dtype), value)

    def eta(value: Array, rate: Array) -> Array:
        return jnp.where(is_dead, jnp.zeros((), dtype), jnp.where(is_hot, rate, value))

    return Camera(theta(camera.theta_on), theta(camera.theta_off),
                  eta(camera.eta_on, rates[0]), eta(camera.eta_off, rates[1]))


def _checked(key: Array, camera: Camera) -> Camera:
    """The validated camera, of float maps; EV020 without a key or a camera."""
    check_key(key)
    need(camera, Camera, "camera", "For example that of Camera.sample or Camera.load.")
    maps: Camera = real_maps(camera.validate())
    return maps


@dataclasses.dataclass(frozen=True, eq=False)
class NoiseHistogram:
    """Noise events of one polarity, measured in N pixels at rest.

    Attributes:
        counts: (N, 71) float64, how many intervals between two events of the pixel had an
            instantaneous frequency (1 / interval) in [AXIS_HZ[b], AXIS_HZ[b + 1]).
    """

    counts: np.ndarray

    def rates(self) -> np.ndarray:
        """Mean rate of each pixel in Hz, (N,): its number of intervals over their total length,
        log-uniform within a bin; 0 for a pixel without intervals (one event at most)."""
        width = np.log(AXIS_HZ[1:] / AXIS_HZ[:-1])
        seconds = self.counts @ ((1.0 / AXIS_HZ[:-1] - 1.0 / AXIS_HZ[1:]) / width)
        return self.counts.sum(1) / np.where(seconds > 0, seconds, 1.0)


def read_noise_histogram(path: str | os.PathLike, name: str | None = None) -> NoiseHistogram:
    """Read measured noise of one polarity, a file in the layout of IEBCS (Joubert et al. 2021).

    Each row is a cumulative histogram over `AXIS_HZ`, the edges of 71 bins: column b counts the
    intervals below AXIS_HZ[b + 1] Hz, the last column is unused (0, or the total again).

    Args:
        path: a .npy of (H, W, 72) or (N, 72) numbers, or an .npz that holds such an array.
        name: of the array in an .npz; may be left out where there is only one.

    Returns:
        The histogram of each pixel; `.rates()` are its noise rates in Hz.

    Raises:
        EvflowDataError: EV001 (no pixel), EV002 (shape), EV003 (dtype), EV007 (NaN), EV008
            (another frequency axis), EV009 (unreadable, or not a cumulative histogram), EV016 (no
            such file), EV020 (no array of that name, or several and no name).
    """
    path = Path(path)
    if not path.is_file():
        raise EvflowDataError("EV016", f"no noise histogram at {path}.",
                              "Expected a .npy or .npz in the layout of IEBCS.")
    try:
        with open(path, "rb") as file:
            data = np.load(file, allow_pickle=False)
            if isinstance(data, np.lib.npyio.NpzFile):
                data = _chosen({k: data[k] for k in data.files}, path, name)
    except EvflowDataError:
        raise
    except Exception as e:  # zip, zlib, NumPy's header parser, tokenize raise many types
        raise EvflowDataError("EV009", f"{path} is not a readable .npy or .npz ({e}).") from e
    return NoiseHistogram(_counts(data, path))


def _chosen(arrays: dict[str, np.ndarray], path: Path, name: str | None) -> np.ndarray:
    """The array of this name, or the only histogram if no name is given."""
    axes = [a for a in arrays.values() if a.shape == AXIS_HZ.shape and a.dtype.kind == "f"]
    if any(not np.allclose(axis, AXIS_HZ) for axis in axes):
        raise EvflowDataError("EV008", f"{path} has another frequency axis.",
                              "Expected 1..9 x 10^k Hz, k = -3..4.")
    names = sorted(k for k, a in arrays.items() if a.ndim >= 2 and a.shape[-1] == len(AXIS_HZ))
    if name is None and len(names) == 1:
        name = names[0]
    if name not in names:
        raise EvflowDataError(
            "EV020", f"{path} holds the histograms {names}, but not name={name!r}.",
            "Pass the name of one of them.")
    return arrays[name]


def _counts(data: np.ndarray, path: Path) -> np.ndarray:
    """Intervals per pixel and bin, (N, 71) float64, from cumulative rows (..., 72)."""
    if data.ndim not in (2, 3) or data.shape[-1] != len(AXIS_HZ):
        raise EvflowDataError("EV002", f"{path} holds an array of shape {data.shape}.",
                              "Expected (H, W, 72) or (N, 72) cumulative histograms.")
    if data.dtype.kind not in "uif":
        raise EvflowDataError("EV003", f"{path} has dtype {data.dtype}.", "Expected numbers.")
    if not data.size:
        raise EvflowDataError("EV001", f"{path} holds no pixel.")
    rows = data.reshape(-1, len(AXIS_HZ)).astype(np.float64)
    if not np.isfinite(rows).all():
        raise EvflowDataError("EV007", f"{path} holds NaN or infinite counts.")
    counts = np.diff(rows[:, :-1], axis=1, prepend=0.0)
    spare, total = rows[:, -1], rows[:, -2]
    wrong = (counts < 0).any(1) | ((spare != 0) & (spare != total))
    if wrong.any():
        raise EvflowDataError(
            "EV009", f"{path}: row {int(np.argmax(wrong))} decreases ({int(wrong.sum())} in all).",
            "A cumulative histogram never decreases along its 71 bins; are these plain counts?")
    return counts


def with_noise_histogram(
    key: Array, camera: Camera, on: NoiseHistogram, off: NoiseHistogram
) -> Camera:
    """The camera with the noise rates of measured pixels, drawn with replacement.

    Where both histograms hold the same number of pixels, ON and OFF rates of a pixel come from the
    same measured one: in the dark they are correlated (.95 at .1 lux in the files of IEBCS).
    Otherwise they are drawn independently.

    Args:
        key: of jax.random.
        camera: maps (..., H, W); its thresholds are kept.
        on: ON noise, of `read_noise_histogram`.
        off: OFF noise.

    Returns:
        A camera of the same shape, eta in Hz.

    Raises:
        EvflowDataError: EV002, EV014, EV015 (no valid camera), EV020 (no key, camera or
            histogram).
    """
    camera = _checked(key, camera)
    for histogram in (on, off):
        need(histogram, NoiseHistogram, "noise", "Give those of read_noise_histogram.")
    sizes = [len(h.counts) for h in (on, off)]
    k_on, k_off = jax.random.split(key)
    k_off = k_on if sizes[0] == sizes[1] else k_off

    def drawn(k: Array, histogram: NoiseHistogram, like: Any) -> Array:
        rates = jnp.asarray(histogram.rates(), jnp.result_type(like))
        at = jax.random.randint(k, camera.shape, 0, len(rates))
        return jnp.take(rates, at, axis=0, mode="clip")

    return dataclasses.replace(camera, eta_on=drawn(k_on, on, camera.eta_on),
                               eta_off=drawn(k_off, off, camera.eta_off))
