"""The paper's objectives, one function per equation.

A loss returns per-element values; the caller reduces and weights them (Eq. 11).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from evflow.training.config import LossConfig

Array = jax.Array

EPSILON = 1e-3  # of the Charbonnier losses (Eq. 7)
COUNT_LIMIT = 6.0  # asinh(200): more events per bin come from an untrained flow only
RARE = 0.05  # events per bin, added to the expected ones as the least variance
FAR = 30.0  # standard deviations: pixels at the threshold's clamp fire a hundred times as often


def condition_loss(logits: Array, target: Array, beta: float = 2.0) -> Array:
    """Quality focal loss L_I (Eq. 6) of logits against targets in 0..1, element-wise."""
    p = jax.nn.sigmoid(logits)
    entropy = -(target * jax.nn.log_sigmoid(logits) + (1 - target) * jax.nn.log_sigmoid(-logits))
    return jnp.abs(p - target) ** beta * entropy


def charbonnier(error: Array) -> Array:
    """sqrt(error^2 + 1e-6): an absolute value with a smooth foot, element-wise."""
    return jnp.sqrt(error * error + EPSILON**2)


def parameter_loss(predicted: Array, target: Array, confidence: Array | float = 1.0) -> Array:
    """L_P (Eq. 7): Charbonnier over the four parameters, (..., 4) -> (...).

    confidence: lambda, the sample's share of the batch's events times the batch size.
    """
    squared = jnp.sum((predicted - target) ** 2, -1)
    return jnp.sqrt(confidence**2 * squared + EPSILON**2)


def confidence_weight(voxels: Array) -> Array:
    """lambda of Eq. 7 times the batch size (mean 1): voxels (B, ...) -> (B,)."""
    events = voxels.reshape(voxels.shape[0], -1).sum(-1)
    return events * voxels.shape[0] / jnp.maximum(events.sum(), 1.0)


def flow_loss(log_prior: Array, log_latent: Array, log_det: Array) -> Array:
    """L_F (Eq. 8): minus the log-likelihood, from log p(y), log p(z) and the log-det (...).

    log p(y) is 0 in the paper's preset, where L_P takes its place.
    """
    return -(log_prior + log_latent + log_det)


def inverse_flow_loss(log_det: Array) -> Array:
    """L_F' (Eq. 10): minus the log-det of the inverse map, (...)."""
    return -log_det


def edge_weight(strength: Array, size: int, edge: float) -> Array:
    """1 - gamma of Eq. 9 for patches of side `size`: weight in 0..1 of a patch as a moving edge.

    strength: of edges, (..., h, w): the total log-intensity change, or `gradient` of the image. The
    weight is 1 where its root mean square reaches `edge`; at 0 the patch's events are noise.
    """
    strength = jnp.sqrt(_patches(strength[..., None] ** 2, size).mean((-3, -2, -1)) + 1e-12)
    return jnp.clip(strength / edge, 0.0, 1.0)


def gradient(image: Array) -> Array:
    """Magnitude of the gradient of an image (..., h, w) by central differences: (..., h, w)."""
    down, right = jnp.gradient(image, axis=(-2, -1))
    return jnp.sqrt(down**2 + right**2 + 1e-12)


def event_loss(
    generated: Array, voxels: Array, strength: Array, expected: Array, config: LossConfig
) -> Array:
    """L_E (Eq. 9), (..., h, w, 2B) -> (...), averaged over patches and summed over scales.

    generated: asinh of the generated voxels; voxels: the true ones; strength: of edges, (..., h,
    w); expected: approximate number of events, as in `rate_loss`. At moving edges voxels are
    compared (Charbonnier, on asinh as counts span three decades, or on ELU); elsewhere only events
    per patch and polarity, with the variance of a Poisson count.
    """
    events = linear(generated)
    if config.elu:
        events = jax.nn.elu(events)
        error = charbonnier(events - voxels)
    else:
        error = charbonnier(generated - jnp.arcsinh(voxels))
    total = jnp.zeros(voxels.shape[:-3])
    for size in config.patches:
        moving = edge_weight(strength, size, config.edge)
        values = _patches(error, size).mean((-3, -2, -1))
        variance = _counts(expected, size) + 1.0
        noise = dispersion(_counts(events, size), _counts(voxels, size), variance).mean(-1)
        noise = noise / size**2
        total += (moving * values + (1.0 - moving) * noise).mean(-1)
    return total


def rate_loss(generated: Array, voxels: Array, expected: Array, sizes: tuple[int, ...]) -> Array:
    """L_E for generated voxels that are *expected* events: (..., h, w, 2B) -> (...).

    Charbonnier errors (Eq. 9) are minimal at the median, which is 0 for rare events; these are
    minimal at the mean, bin by bin and in the counts per patch and polarity. expected: approximate
    number of events, which sets the variance of the errors.
    """
    events = linear(generated)
    total = dispersion(events, voxels, expected + RARE).mean((-3, -2, -1))
    for size in sizes:
        variance = _counts(expected, size) + 1.0
        counts = dispersion(_counts(events, size), _counts(voxels, size), variance)
        total += counts.mean((-2, -1)) / size**2
    return total


def linear(generated: Array) -> Array:
    """Events from their asinh, limited to COUNT_LIMIT."""
    return jnp.sinh(jnp.clip(generated, -COUNT_LIMIT, COUNT_LIMIT))


def dispersion(made: Array, true: Array, variance: Array | float) -> Array:
    """(made - true)^2 over twice the variance, linear beyond FAR deviations. The variance (no
    gradient) must not depend on `true`, or on the latents' noise in `made`: divided by true + 1,
    for instance, the minimum would be at too few events."""
    error = (made - true) / jnp.sqrt(jax.lax.stop_gradient(variance))
    return FAR**2 * (jnp.sqrt(1.0 + (error / FAR) ** 2) - 1.0)


def _patches(x: Array, size: int) -> Array:
    """(..., h, w, C) -> (..., patches, size, size, C); ragged edges are left out."""
    *lead, h, w, channels = x.shape
    rows, columns = h // size, w // size
    x = x[..., : rows * size, : columns * size, :]
    x = x.reshape(*lead, rows, size, columns, size, channels)
    return jnp.moveaxis(x, -3, -4).reshape(*lead, rows * columns, size, size, channels)


def _counts(voxels: Array, size: int) -> Array:
    """Events per patch and polarity, (..., patches, 2)."""
    patches = _patches(voxels, size)
    on, off = jnp.split(patches, 2, -1)
    return jnp.stack([on.sum((-3, -2, -1)), off.sum((-3, -2, -1))], -1)


def summary_loss(y: Array, y_std: Array, target: Array) -> Array:
    """Charbonnier of the summary, and the Gaussian likelihood of its std (which does not pull
    on the mean), per component: (..., 6) each -> (..., 6)."""
    error = y - target
    return charbonnier(error) + 0.2 * gaussian_nll(jax.lax.stop_gradient(error), y_std)


def gaussian_nll(error: Array, std: Array) -> Array:
    """-log N(error; 0, std^2) up to a constant, element-wise."""
    return 0.5 * (error / std) ** 2 + jnp.log(std)


def adaptive_weight(loss: Array) -> Array:
    """Section IV-D3: the power of ten that brings a loss into 0..10 (2.3e3 -> 2.3), without
    gradient. Losses below 10 keep their weight."""
    size = jnp.maximum(jnp.abs(jax.lax.stop_gradient(loss)), 1e-30)
    return jnp.where(size >= 10.0, 10.0 ** -jnp.floor(jnp.log10(size)), 1.0)
