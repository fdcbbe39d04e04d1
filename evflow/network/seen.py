"""What a slow pixel sees in a window: a code's changes of light, filtered by a photoreceptor.

The filter is that of simulator/photoreceptor.py, which `evflow simulate --camera` uses for a
measured camera. The window begins at rest, since earlier light is unknown.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import lin_log_inverse
from evflow.simulator.photoreceptor import Photoreceptor, seen_path

Array = jax.Array

SUBSTEPS = 4  # per change: the photoreceptor's speed follows the light within it


def photoreceptor(sensor: SensorModel | None, optics: Optics | None) -> Photoreceptor:
    """The photoreceptor for a circuit and optics, each ideal if None."""
    return Photoreceptor.of(sensor or SensorModel(), optics or Optics())


def seen_changes(
    seen_by: Photoreceptor, changes: Array, intensity: Array, window_s: Array
) -> tuple[Array, Array]:
    """Changes (..., H, W, m) of log intensity and its mean (..., H, W), as the pixels see them.
    intensity, window_s: of the light, broadcastable to (..., H, W)."""
    if seen_by.ideal and not seen_by.logarithmic:
        return changes, intensity
    law = (seen_by.offset_dn, seen_by.tau_s, seen_by.delay_s, seen_by.by_light,
           seen_by.logarithmic)
    return _seen(changes, intensity, window_s, *law)


@jax.jit
def _seen(
    changes: Array, intensity: Array, window_s: Array, offset_dn: float, tau_s: float,
    delay_s: float, by_light: bool, logarithmic: bool,
) -> tuple[Array, Array]:
    count = changes.shape[-1]
    each = jnp.moveaxis(jnp.repeat(changes / SUBSTEPS, SUBSTEPS, -1), -1, 0)
    first = intensity - 0.5 * each.sum(0)
    log_light = first[None] + jnp.concatenate([jnp.zeros_like(each[:1]), jnp.cumsum(each, 0)])
    dt_s = jnp.broadcast_to(window_s / (SUBSTEPS * count), intensity.shape)
    steps = jnp.broadcast_to(dt_s, (len(each), *dt_s.shape))
    path = seen_path(lin_log_inverse(log_light), steps, offset_dn, tau_s, by_light,
                     logarithmic)
    # At the ends of the parts, `delay` later; after the window the light stays constant.
    ends = jnp.arange(0, len(path), SUBSTEPS, dt_s.dtype).reshape(-1, *[1] * dt_s.ndim)
    at = jnp.clip(ends - (delay_s / dt_s)[None], 0.0, len(each))
    low = jnp.minimum(jnp.floor(at), len(each) - 1.0)
    below, above = (jnp.take_along_axis(path, low.astype(jnp.int32) + i, 0) for i in (0, 1))
    seen = below + (at - low) * (above - below)
    darker = jnp.log1p(jnp.maximum(offset_dn, 0.0) / 255.0)  # as for simulated frames
    return jnp.moveaxis(jnp.diff(seen, axis=0), 0, -1), 0.5 * (seen[0] + seen[-1]) - darker
