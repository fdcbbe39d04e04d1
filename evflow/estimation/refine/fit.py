"""From moments to the camera's summary: a few Gauss-Newton steps, then a small fusion network.

The steps move log theta until the balance of the simulated recording equals that of the recorded
one, with the network's estimate as prior; the noise rates come from quiet pixels (noise.py). The
residuals, the number of events behind each, the speed of motion and what the search for the
photoreceptor says (path_signs.py) are features of `FusionNet`, trained on simulated recordings,
which corrects the estimate and gives its std.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.estimation.refine.chunk import Chunk
from evflow.estimation.refine.fusion import corrected
from evflow.estimation.refine.moments import Moments, measure
from evflow.estimation.refine.noise import (
    combined_rate,
    quiet_events,
    rate_error,
    stratum_rates,
    tied_probability,
    tied_rates,
    with_tie,
)
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.path_signs import path_signs
from evflow.estimation.refine.receptor_result import Found
from evflow.estimation.refine.signal import separated_noise_rates
from evflow.estimation.refine.trace import FRESH, RUNNING, Draws, draw, trace_of_camera
from evflow.light.log_maps import lin_log_inverse, noise_factor, normalised_intensity
from evflow.network.coordinates import squashed_summary

Array = jax.Array
Start = tuple[float, float]

OFFSETS = (0.2, 0.08, 0.05)  # log theta: finite differences of the passes
LONGEST_STEP = 0.5  # log theta per pass
MODEL_ERROR = 0.04  # of a balance residual, by interpolation; counts add their own
EMPTY = 0.3  # balance weight below which a residual is negligible
FRESH_ODDS = 2.0  # log odds required for a fresh start: few recordings have one
THETA_ERROR = 0.05  # relative error of the stepped thresholds, where noise follows from them


@dataclasses.dataclass(frozen=True, eq=False)
class Refined:
    """summary, std: the camera; stepped: before the fusion; features: (F,) float32, the fusion's
    input; fresh: whether the memory is at the first frame when the recording starts, as in a
    simulation."""

    summary: Summary
    std: Summary
    stepped: Summary
    features: np.ndarray
    fresh: bool


def _total(parts: Sequence[Moments]) -> Moments:
    return jax.tree.map(lambda *leaves: np.sum([np.asarray(a) for a in leaves], 0), *parts)


def balance_residual(moments: Moments, theta: np.ndarray) -> np.ndarray:
    """Events' contrast minus dL, relative to |dL|: (..., lags, 2 sides), at theta (..., 2)."""
    on, off = theta[..., 0, None, None], theta[..., 1, None, None]
    a, b, d, size = np.moveaxis(np.asarray(moments.balance), -1, 0)
    return np.array([1.0, -1.0]) * (on * a - off * b - d) / (size + EMPTY)


def square_residual(moments: Moments, theta: np.ndarray) -> np.ndarray:
    """Mean squared remainder (..., 2 sides) in units of theta_on theta_off."""
    on, off = theta[..., 0, None], theta[..., 1, None]
    aa, bb, ab, ad, bd, dd, one = np.moveaxis(np.asarray(moments.squares), -1, 0)
    square = (on**2 * aa + off**2 * bb - 2 * on * off * ab - 2 * on * ad + 2 * off * bd + dd)
    return (np.maximum(square, 0.0) / (on * off) + EMPTY) / (one + EMPTY)


class Fit:
    """State of the Gauss-Newton passes over one recording's chunks."""

    def __init__(self, chunks: list[Chunk], start: Summary, std: Summary, seed: int) -> None:
        self.chunks, self.key = chunks, jax.random.key(seed)
        self.draws: dict[int, Draws] = {}
        self.simulated: dict[tuple[int, bytes, bytes], Moments] = {}
        self.names = [f.name for f in dataclasses.fields(Summary)]
        self.prior = np.array([float(getattr(start, n)) for n in self.names])
        relative = np.array([float(getattr(std, n)) for n in self.names]) / np.maximum(
            self.prior, 1e-3)
        self.prior_std = np.clip(relative, 0.02, 2.0)
        self.values = self.prior.copy()
        self.quiet = np.sum([quiet_events(c, STEPS) for c in chunks], 0)
        self.values[2:4] = combined_rate(self.quiet, self.prior[2:4], self.prior_std[2:4])
        self.start = self.later = RUNNING
        self.factor = _mean_factor(chunks)
        self.recorded = _total([measure(c.recorded, c.path, c.dt_s, c.bright, STEPS)
                                for c in chunks])

    def simulate(self, values: np.ndarray, starts: Sequence[Start] = ()) -> Moments:
        """Moments of V cameras summed over the chunks, leading axis V. starts: of the first chunk;
        all others begin as `later`, as of a camera that has been running."""
        starts = starts or [self.start] * len(values)
        cameras = list(zip(values.astype(np.float32), np.array(starts, np.float32), strict=True))
        later = np.array(self.later, np.float32)
        totals = [[self._moments(i, row, later if i else start) for row, start in cameras]
                  for i in range(len(self.chunks))]
        added = map(_total, zip(*totals, strict=True))
        return jax.tree.map(lambda *leaves: np.stack(leaves), *added)

    def _moments(self, i: int, row: np.ndarray, start: np.ndarray) -> Moments:
        """Moments of a camera on chunk i, cached: passes share cameras."""
        known, c = (i, row.tobytes(), start.tobytes()), self.chunks[i]
        if i not in self.draws:
            self.draws[i] = draw(self.key, i, c.bright.shape, len(c.dt_s), STEPS)
        if known not in self.simulated:
            draws = self.draws[i]
            trace = trace_of_camera(
                draws, c.path, c.dt_s, draws.thresholds(row), row[2:4], start, STEPS)
            self.simulated[known] = measure(trace, c.path, c.dt_s, c.bright, STEPS)
        return self.simulated[known]

    def choose_start(self, others: Sequence[Start] = (FRESH,)) -> None:
        """Choose how the recording starts: as of a running camera (`later`), or one of `others`;
        the one with the highest Poisson likelihood of the number of pixels that fire at once."""
        starts = [self.later, *others]
        made = np.asarray(self.simulate(np.stack([self.values] * len(starts)), starts).early) + 0.5
        log_likelihood = float(self.recorded.early) * np.log(made) - made
        log_likelihood[0] += FRESH_ODDS
        self.start = starts[int(np.argmax(log_likelihood))]

    def step(self, offset: float) -> None:
        """Take one Gauss-Newton step of log theta. offset: of the finite differences."""
        values = np.stack([self.values] * 3)
        values[1, 0] *= np.exp(offset)
        values[2, 1] *= np.exp(offset)
        moments = self.simulate(values)
        excess = (balance_residual(self.recorded, values[:, :2])
                  - balance_residual(moments, values[:, :2]))[:, :3].mean(1)  # lags 1, 2, 4
        jacobian = ((excess[1:] - excess[0]) / offset).T
        size = np.asarray(self.recorded.balance)[1, :, 3]
        precision = np.diag(1.0 / (MODEL_ERROR**2 + 0.2 / (size + EMPTY)))
        held = np.diag(self.prior_std[:2] ** -2.0)
        away = np.log(self.values[:2] / self.prior[:2])
        curvature = jacobian.T @ precision @ jacobian + held
        gradient = jacobian.T @ precision @ excess[0] + held @ away
        change = -np.linalg.solve(curvature, gradient)
        self.move(slice(2), change)

    def move(self, which: int | slice, change: np.ndarray | float) -> None:
        """Change log theta of ON (0), OFF (1) or both, by at most LONGEST_STEP."""
        moved = self.values[which] * np.exp(np.clip(change, -LONGEST_STEP, LONGEST_STEP))
        self.values[which] = np.clip(moved, 0.02, 2.0)

    def features(self) -> np.ndarray:
        """The fusion's features (F,) at the current values."""
        made = jax.tree.map(lambda a: a[0], self.simulate(self.values[None]))
        seen, theta = self.recorded, self.values[:2]

        def ratio(name: str) -> np.ndarray:
            return np.log((getattr(seen, name) + 1.0) / (getattr(made, name) + 1.0))

        residual = balance_residual(seen, theta) - balance_residual(made, theta)
        size = seen.balance[..., 3]
        motion = np.concatenate([c.motion_px for c in self.chunks])
        light = np.mean([c.path[0].mean() for c in self.chunks])
        pixels = max(float(seen.pixels), 1.0)
        parts = [
            np.log(self.values[:4] / self.prior[:4]), np.log(self.prior_std),
            np.log(self.values[:4]), np.log(self.values[4:] + 0.01), residual.ravel(),
            ratio("roots"), ratio("active"), ratio("events"), [ratio("early")],
            np.log(square_residual(seen, theta) / square_residual(made, theta)),
            np.log(size[[0, -1]] + EMPTY).ravel(), np.log(seen.events + 1.0),
            np.log((seen.active + 1.0) / pixels), *self.noise_features(),
            np.log([float(seen.exposure) + 1.0, pixels]),
            [np.log(motion.mean() + 0.1), np.log(motion.max() + 0.1), light, self.start == FRESH,
             np.log(np.mean([c.dt_s.mean() for c in self.chunks]) / 0.025)],
        ]
        return np.concatenate([np.asarray(p, np.float64).ravel() for p in parts]).astype(
            np.float32)

    def noise_features(self) -> list[np.ndarray]:
        """Rates of the strata against their combination, and agreement with Eq. 12."""
        rates = stratum_rates(self.quiet, self.prior[2:4], self.prior_std[2:4])
        theta, found = self.values[:2], np.log(self.values[2:4])
        predicted, error = tied_rates(theta, THETA_ERROR * theta, self.factor)
        away = found - np.log(predicted)
        tied = tied_probability(away, np.hypot(error, rate_error(self.quiet)))
        return [np.log(rates) - found, np.log(self.quiet + 1.0), np.clip(away, -2.0, 2.0),
                tied * away, np.array([tied])]


_dn = jax.jit(lin_log_inverse)


def _mean_factor(chunks: list[Chunk]) -> float:
    """Mean intensity factor of Eq. 12 over the frames."""
    frames = (np.asarray(_dn(c.path[::STEPS])) for c in chunks)
    return float(np.mean([noise_factor(normalised_intensity(dn)).mean() for dn in frames]))


def refine_summary(
    chunks: list[Chunk], summary: Summary, std: Summary, fusion: dict[str, Any] | None = None,
    signal: dict[str, Any] | None = None, *, found: Found | None = None, noise_dn: float = 0.0,
    blur_s: float = 0.0, seed: int = 0,
) -> Refined:
    """Refine the network's estimate of a camera on the chunks of a recording.

    Args:
        chunks: of the recording.
        summary, std: the network's estimate.
        fusion: {"net": parameters of several FusionNets, stacked, "mean", "scale", "low", "high":
            (F,) of the features in training, "widen": (6,) calibration of the std}; None: only the
            Gauss-Newton steps, with the network's std.
        signal: the network that separates noise from signal (signal.py); None: the noise rates are
            those of quiet pixels.
        found, noise_dn, blur_s: the search for the photoreceptor, None if there was none, and the
            frames' noise (std in DN) and exposure if it is known: features beside those of the
            events.
        seed: of the simulated noise and mismatch.

    Returns:
        The refined summary, its std, what the steps alone give and the features.

    Raises:
        EvflowDataError: EV018 where `fusion` was trained on another number of features.
    """
    fit = Fit(chunks, summary, std, seed)
    fit.choose_start()
    for offset in OFFSETS:
        fit.step(offset)
    signs = path_signs(found, noise_dn, blur_s, fit.values[:2])
    features = np.concatenate([fit.features(), signs.astype(np.float32)])
    stepped = Summary(*(jnp.float32(v) for v in fit.values))
    if fusion is None:
        return Refined(stepped, std, stepped, features, fit.start == FRESH)
    if fusion["mean"].shape != features.shape:
        raise EvflowDataError(
            "EV018", f"the weights' fusion sees {fusion['mean'].size} features of a recording, "
            f"this version has {features.size}.",
            'They are of another version: pass refine="off", or refit: python -m experiments.fuse.')
    result, result_std = squashed_summary(*corrected(fusion, features, stepped))
    result, result_std = _with_noise(chunks, result, result_std, signal, fit.factor)
    return Refined(result, result_std, stepped, features, fit.start == FRESH)


def _with_noise(
    chunks: list[Chunk], summary: Summary, std: Summary, signal: dict[str, Any] | None,
    factor: float,
) -> tuple[Summary, Summary]:
    """Noise rates with noise separated from signal, shrunk towards Eq. 12 where consistent."""
    def both(s: Summary, name: str) -> np.ndarray:
        return np.array([float(getattr(s, f"{name}_{p}")) for p in ("on", "off")])

    theta, eta = both(summary, "theta"), both(summary, "eta")
    log_eta, log_std = np.log(eta), both(std, "eta") / eta
    if signal is not None:
        log_eta, log_std = separated_noise_rates(chunks, theta, log_eta, log_std, signal)
    log_eta, log_std = with_tie(theta, both(std, "theta"), log_eta, log_std, factor)
    rates = dict(zip(("eta_on", "eta_off"), map(jnp.float32, np.exp(log_eta)), strict=True))
    errors = dict(zip(rates, map(jnp.float32, np.exp(log_eta) * log_std), strict=True))
    return dataclasses.replace(summary, **rates), dataclasses.replace(std, **errors)
