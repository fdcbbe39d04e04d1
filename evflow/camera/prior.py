"""What a whole camera shares, and the distribution it is drawn from (Section IV-E and Eq. 12 of the
paper). Per-pixel values are in camera.py.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera.arguments import number, pair
from evflow.errors import EvflowDataError
from evflow.light.log_maps import Values

Array = jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Summary:
    """What a whole camera shares, each float32 (...,): a scalar per camera, a pytree.

    Noise rates of an estimate are means over pixels rather than medians, because noise adds up;
    with a spread of 10 % over pixels, mean and median differ by half a percent.

    Attributes:
        theta_on: median ON threshold over pixels, natural-log units.
        theta_off: median OFF threshold over pixels, natural-log units.
        eta_on: ON noise rate in Hz per pixel.
        eta_off: OFF noise rate in Hz per pixel.
        sigma_on: threshold mismatch, the standard deviation of theta_on over pixels (before the
            clamp at .01), natural-log units.
        sigma_off: the same of theta_off.
    """

    theta_on: Array
    theta_off: Array
    eta_on: Array
    eta_off: Array
    sigma_on: Array
    sigma_off: Array

    def __repr__(self) -> str:
        """One line: the values of a single camera; only the shape of several or traced ones."""
        known = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        if all(isinstance(v, np.ndarray | np.generic | jax.Array | float)
               and not isinstance(v, jax.core.Tracer) and np.ndim(v) == 0 for v in known.values()):
            return f"Summary({', '.join(f'{k}={float(v):.4g}' for k, v in known.items())})"
        return f"Summary({'x'.join(map(str, np.shape(self.theta_on)))})"


@dataclasses.dataclass(frozen=True)
class CameraPrior:
    """The distribution that cameras are drawn from (Section IV-E of the paper, Eq. 12).

    Attributes:
        theta: range of the nominal threshold, natural-log units, uniform, drawn separately for ON
            and OFF (paper: .1-.5).
        mismatch: range of the standard deviation of the threshold over pixels, natural-log units
            (v2e's default .03; the paper .15).
        noise: "eq12" ties the rate to the threshold, eta = g R(theta) with the intensity factor g
            of Eq. 12, uniform in [F, 1] (F = .25) if the scene's intensity is not known;
            "independent" draws it log-uniform in `eta`; "mixed" takes either with equal chance,
            and in half of the tied cameras a g independent of the scene; "none" is silent.
        eta: range of the noise rate in Hz per pixel and polarity, > 0, for "independent" and
            "mixed".
        eta_spread: standard deviation of log eta over pixels.

    Raises:
        EvflowDataError: EV020 (an unknown `noise`, an invalid range).
    """

    theta: tuple[float, float] = (0.1, 0.5)
    mismatch: tuple[float, float] = (0.03, 0.03)
    noise: Literal["eq12", "independent", "mixed", "none"] = "eq12"
    eta: tuple[float, float] = (0.02, 1.0)
    eta_spread: float = 0.0

    def __post_init__(self) -> None:
        if self.noise not in ("eq12", "independent", "mixed", "none"):
            raise EvflowDataError("EV020", f"CameraPrior(noise={self.noise!r}).",
                                  "Choose 'eq12', 'independent', 'mixed' or 'none'.")
        lowest = {"theta": np.nextafter(0.0, 1.0), "mismatch": 0.0, "eta": np.nextafter(0.0, 1.0)}
        for name, bound in lowest.items():
            low, high = pair(getattr(self, name))
            if not bound <= low <= high < np.inf:
                raise EvflowDataError(
                    "EV020", f"CameraPrior({name}={getattr(self, name)}).",
                    f"Give (low, high), low <= high, {'>=' if bound == 0 else '>'} 0.")
        if not 0 <= number(self.eta_spread) < np.inf:
            raise EvflowDataError("EV020", f"CameraPrior(eta_spread={self.eta_spread!r:.60}).",
                                  "A standard deviation of log eta: >= 0.")


def noise_of_threshold(theta: Values) -> Values:
    """R(theta) = 4 / (90 theta - 5) of Eq. 12, clipped to the paper's range [.1, 1] Hz.

    The pole at theta = .0556 lies inside the clip: smaller thresholds get 1 Hz. NumPy arrays are
    computed on the host.
    """
    of: Any = np if isinstance(theta, np.ndarray) else jnp
    return of.clip(4.0 / (90.0 * of.maximum(theta, 0.1) - 5.0), 0.1, 1.0)


def sample_nominal(
    key: Array, batch: tuple[int, ...], prior: CameraPrior, factor: Array | None = None
) -> Summary:
    """Draw the camera-wide values, each of shape `batch`. factor: the intensity factor of Eq. 12
    of the scene to be seen, if known."""
    k_theta, k_sigma, k_gain, k_free, k_link = jax.random.split(key, 5)
    pair, kind = (2, *batch), jnp.float32  # in x64 mode too: the same key, the same camera
    theta = jax.random.uniform(k_theta, pair, kind, prior.theta[0], prior.theta[1])
    sigma = jax.random.uniform(k_sigma, pair, kind, prior.mismatch[0], prior.mismatch[1])
    if prior.noise == "none":
        return Summary(*theta, *jnp.zeros_like(theta), *sigma)
    gain = jax.random.uniform(k_gain, pair, kind, 0.25)
    if factor is not None:
        exact = 0.5 if prior.noise == "mixed" else 1.0
        gain = jnp.where(jax.random.bernoulli(jax.random.fold_in(k_gain, 1), exact, batch),
                         factor, gain)
    eta = noise_of_threshold(theta) * gain
    if prior.noise != "eq12":
        lo, hi = np.log(prior.eta[0]), np.log(prior.eta[1])
        free = jnp.exp(jax.random.uniform(k_free, pair, kind, lo, hi))
        tied = jax.random.bernoulli(k_link, 0.5, batch) & (prior.noise == "mixed")
        eta = jnp.where(tied, eta, free)
    return Summary(*theta, *eta, *sigma)
