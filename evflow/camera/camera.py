"""The camera: per-pixel contrast thresholds and noise rates.

`Camera` is a pytree of four float32 maps (..., H, W); it passes through jit, vmap and grad. The
`SensorModel` (sensors.py) holds what is not per pixel, the `CameraPrior` (prior.py) the
distribution that cameras are drawn from.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from evflow.camera import file
from evflow.camera.arguments import check_key, full_map, map_on_host, real_maps, shape_of_maps
from evflow.camera.file import PARAMETERS
from evflow.camera.prior import CameraPrior, Summary, sample_nominal
from evflow.checks import need
from evflow.errors import EvflowDataError, naming

Array = jax.Array

THETA_MIN = 0.01  # v2e clamps thresholds here; a pixel at the clamp is a hot pixel


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """An event camera, pixel by pixel: four float32 maps (..., H, W), a pytree for jit and grad.

    Attributes:
        theta_on: contrast thresholds for ON events, natural-log units, > 0.
        theta_off: contrast thresholds for OFF events, natural-log units, > 0.
        eta_on: ON noise events per second (Hz) and pixel, >= 0, at the recording's mean
            intensity; with `SensorModel(eta_intensity=True)` the rate follows intensity (Eq. 12).
        eta_off: the same for OFF.

    Example:
        >>> camera = ef.Camera.sample(jax.random.key(0), (260, 346))
        >>> camera.save("camera.npz")
    """

    theta_on: Array
    theta_off: Array
    eta_on: Array
    eta_off: Array

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the maps, (..., H, W)."""
        return tuple(np.shape(self.theta_on))

    def __repr__(self) -> str:
        """One line: the size and the median of each map; only the shape where maps have no values
        (traced, or of `jax.eval_shape`)."""
        size = "x".join(str(n) for n in self.shape)
        if self._traced() or 0 in self.shape or not all(
                isinstance(m := getattr(self, n), np.ndarray | Array) and m.dtype.kind in "fiu"
                for n in PARAMETERS):
            return f"Camera({size})"
        middle = (f"{n} {np.median(np.asarray(getattr(self, n))):.4g}" for n in PARAMETERS)
        return f"Camera({size}, medians: {', '.join(middle)})"

    @staticmethod
    def constant(
        shape: tuple[int, ...], theta_on: float = 0.2, theta_off: float = 0.2,
        eta_on: float = 0.0, eta_off: float = 0.0,
    ) -> Camera:
        """The same parameters at every pixel.

        Args:
            shape: (..., H, W) of the maps.
            theta_on: ON threshold, natural-log units, > 0.
            theta_off: OFF threshold, natural-log units, > 0.
            eta_on: ON noise rate in Hz per pixel, >= 0.
            eta_off: OFF noise rate in Hz per pixel, >= 0.

        Returns:
            A camera of float32 maps.

        Raises:
            EvflowDataError: EV002 (no shape of maps), EV014 (a value out of range, or no number).
        """
        named = zip(PARAMETERS, (theta_on, theta_off, eta_on, eta_off), strict=True)
        return Camera(*(full_map(name, v, shape_of_maps(shape)) for name, v in named)).validate()

    @staticmethod
    def sample(key: Array, shape: tuple[int, ...], prior: CameraPrior | None = None) -> Camera:
        """Draw cameras from a prior, nominal values first, then pixels (Section IV-E of the paper).

        Args:
            key: of jax.random.
            shape: (..., H, W); leading axes are independent cameras.
            prior: their distribution; None is `CameraPrior()`.

        Returns:
            The cameras, maps of that shape, thresholds clamped at .01 as in v2e.

        Raises:
            EvflowDataError: EV002 (no shape of maps), EV020 (no key, or no prior).
        """
        check_key(key)
        shape, prior = shape_of_maps(shape), CameraPrior() if prior is None else prior
        need(prior, CameraPrior, "prior", "For example CameraPrior(theta=(0.1, 0.4)).")
        k_nominal, k_pixels = jax.random.split(key)
        nominal = sample_nominal(k_nominal, shape[:-2], prior)
        return sample_pixels(k_pixels, nominal, (shape[-2], shape[-1]), prior.eta_spread)

    def drawn(
        self, key: Array, std: Camera, shared: Mapping[str, float] | None = None
    ) -> Camera:
        """A camera drawn from an estimate: each pixel from N(estimate, std^2), kept in range.

        Estimated maps alone are too uniform: pixels with few events have the camera's median.

        Args:
            key: of jax.random.
            std: standard deviations (..., H, W) of this camera's maps, as `CameraEstimate.std`.
            shared: the part of std that all pixels share, relative to the values, by name of the
                map (`CameraEstimate.shared_error`). It is drawn once per map and multiplied in,
                log-normal; None draws all of std pixel by pixel, which makes a camera whose median
                is uncertain too uneven.

        Returns:
            A camera of the same shape, thresholds >= .01, noise rates >= 0.

        Raises:
            EvflowDataError: EV015 (maps of another shape), EV020 (no key, or no camera).
        """
        check_key(key)
        need(std, Camera, "std", "Give CameraEstimate.std.")
        if std.shape != self.shape:
            raise EvflowDataError("EV015", f"standard deviations of shape {std.shape} for maps of "
                                  f"shape {self.shape}.", "Give those of this camera.")
        camera, std = real_maps(self), real_maps(std)
        kind, count = jnp.result_type(camera.theta_on), len(PARAMETERS)
        draws = jax.random.normal(key, (count, *self.shape), kind)
        once = jax.random.normal(
            jax.random.fold_in(key, count), (count, *self.shape[:-2], 1, 1), kind)
        least, maps = {"theta_on": THETA_MIN, "theta_off": THETA_MIN}, {}
        for name, draw, common in zip(PARAMETERS, draws, once, strict=True):
            value, error, part = getattr(camera, name), getattr(std, name), (shared or {}).get(name)
            if part:
                error = jnp.sqrt(jnp.maximum(error**2 - (part * value) ** 2, 1e-30))
            pixels = value + error * draw
            pixels = pixels * jnp.exp(part * common) if part else pixels
            maps[name] = jnp.maximum(pixels, least.get(name, 0.0))
        return Camera(**maps)

    def validate(self) -> Camera:
        """Refuse an impossible camera (on the host; traced arrays pass unchecked).

        Returns:
            Self.

        Raises:
            EvflowDataError: EV002 (shape), EV014 (out of range), EV015 (different shapes).
        """
        self.check_values()
        if len(self.shape) < 2 and not self._traced():
            raise EvflowDataError("EV002", f"the camera's maps have shape {self.shape}.",
                                  "Expected (..., H, W).")
        if 0 in self.shape[-2:] and not self._traced():
            raise EvflowDataError("EV002", f"the camera's maps have no pixel: {self.shape}.",
                                  "Expected (..., H, W), as large as the sensor.")
        return self

    def check_values(self) -> None:
        """Like `validate`, for parameters of any shape.

        Raises:
            EvflowDataError: EV014 (out of range or not finite), EV015 (different shapes).
        """
        if self._traced():
            return
        leaves = {name: getattr(self, name) for name in PARAMETERS}
        shapes = {name: np.shape(v) for name, v in leaves.items()}
        if len(set(shapes.values())) > 1:
            raise EvflowDataError(
                "EV015", f"the camera's maps have different shapes: {shapes}.",
                "All four maps must be (..., H, W) of one sensor.",
            )
        for name, value in leaves.items():
            array = map_on_host(name, value)
            bad = ~np.isfinite(array) | (array <= 0 if name.startswith("theta") else array < 0)
            if bad.any():
                where = tuple(int(i) for i in np.argwhere(bad)[0])
                rule = "> 0" if name.startswith("theta") else ">= 0"
                why = ("Pixels that were not measured? Give them the median of the others." if
                       not np.isfinite(array[where]) else
                       "" if rule == ">= 0" else
                       "Thresholds are magnitudes: leave out the sign." if array[where] < 0 else
                       f"Clamp thresholds at {THETA_MIN}.")
                raise EvflowDataError(
                    "EV014",
                    f"{name} is {array[where]:g} at index {where} ({bad.sum()} such values).",
                    f"It must be finite and {rule}. {why}".rstrip())

    def _traced(self) -> bool:
        return any(isinstance(getattr(self, name), jax.core.Tracer) for name in PARAMETERS)

    def save(self, path: str | os.PathLike, *, overwrite: bool = False, **extra: ArrayLike) -> Path:
        """Write an .npz with the four maps and their units; all or nothing.

        Of a camera that was loaded, the circuit and all else that its file holds is not written:
        docs/networks.md shows how to crop a file with all that it holds.

        Args:
            path: of the file.
            overwrite: replace a file that exists.
            **extra: arrays to store beside the maps, by name.

        Returns:
            The path.

        Raises:
            EvflowDataError: EV002, EV014, EV015 (no valid camera), EV013 (exists), EV019 (cannot be
                written), EV020 (an extra array has the name of a map, or "meta").
        """
        self.validate()
        maps = {n: np.asarray(getattr(self, n), np.float32) for n in PARAMETERS}
        return file.write_maps(path, maps, {k: np.asarray(v) for k, v in extra.items()}, overwrite)

    @staticmethod
    def load(path: str | os.PathLike) -> Camera:
        """Read the maps written by `save` (pickled arrays are refused).

        The circuit and the optics of an estimate stay in the file: `evflow simulate --camera` and
        `evflow export` read them there.

        Args:
            path: of an .npz.

        Returns:
            The camera, maps (..., H, W).

        Raises:
            EvflowDataError: EV002, EV014, EV015 (its maps make no valid camera), EV008 (no .npz,
                one without these maps, or a pickled one), EV009 (damaged), EV016 (no such file).
        """
        return Camera.load_with_std(path)[0]

    @staticmethod
    def load_with_std(path: str | os.PathLike) -> tuple[Camera, Camera | None]:
        """Read the maps and, where the file holds an estimate, their standard deviations.

        Args:
            path: of an .npz written by `save` or `CameraEstimate.save`.

        Returns:
            The camera, and a camera of standard deviations of the same shape or None.

        Raises:
            EvflowDataError: as `load` (EV008, ...); EV009 also for impossible deviations.
        """
        data, errors = file.read_maps(Path(path))
        with naming(path):
            maps = Camera(*(jnp.asarray(m, jnp.float32) for m in data)).validate()
            if errors is None:
                return maps, None
            std = Camera(*(jnp.asarray(e, jnp.float32) for e in errors))
            jax.tree.map(_check_std, maps, std)
            return maps, std


def _check_std(values: Array, std: Array) -> None:
    """EV009 unless the std of a map (..., H, W) is one."""
    if std.shape != values.shape or not bool(jnp.all(jnp.isfinite(std) & (std >= 0))):
        raise EvflowDataError(
            "EV009", f"standard deviations of shape {std.shape} for maps of shape "
            f"{values.shape}, or negative or infinite ones.", "Make the file again.")


def sample_pixels(
    key: Array, nominal: Summary, shape: tuple[int, int], eta_spread: float = 0.0
) -> Camera:
    """Spread the camera-wide values over pixels: theta ~ N(median, sigma) clamped at .01 (v2e),
    eta log-normal around its median. Returns maps (*batch, H, W)."""
    k_on, k_off, k_eta = jax.random.split(key, 3)
    size, kind = (*jnp.shape(nominal.theta_on), *shape), jnp.result_type(nominal.theta_on)

    def theta(k: Array, median: Array, sigma: Array) -> Array:
        draw = median[..., None, None] + sigma[..., None, None] * jax.random.normal(k, size, kind)
        return jnp.maximum(draw, THETA_MIN)

    spread = jnp.ones((2, *size), kind)
    if eta_spread:
        spread = jnp.exp(eta_spread * jax.random.normal(k_eta, spread.shape, kind))
    return Camera(
        theta(k_on, nominal.theta_on, nominal.sigma_on),
        theta(k_off, nominal.theta_off, nominal.sigma_off),
        nominal.eta_on[..., None, None] * spread[0],
        nominal.eta_off[..., None, None] * spread[1],
    )
