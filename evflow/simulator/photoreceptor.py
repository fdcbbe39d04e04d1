"""The signal of a pixel, given frames: added light, a low-pass and a delay.

A pixel sees log(light + dark current) through a low-pass. A frame has its black level subtracted,
and a small error of its time stamp. With light L in DN of the frames, the pixel's signal s follows

    ds/dt = r(t) (u(t) - s),    u = log(L + offset),    r = (L + offset + 20) / 275 / tau

(first order, with a rate proportional to light as in v2e; or r = 1 / tau at any light, where a
later stage is slower than the photoreceptor), `delay` after the frames' clock. The logarithm is
v2e's lin-log, or ESIM's, which is one in dim light too. u is linear between
the given times, which is solved exactly for steps of any length. `SensorModel.cutoff_hz` is v2e's
discretisation, valid for steps far below tau. tau = 1 / (2 pi cutoff).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.camera.numbers import is_off
from evflow.camera.optics import Optics
from evflow.camera.sensors import LogMap, SensorModel
from evflow.light.log_maps import lin_log_inverse, log_dn, log_dn_inverse, to_log
from evflow.light.logarithm import LEAST_DN

Array = jax.Array

FAST = 1e-5  # s: a photoreceptor without visible effect between two fine frames
LEAST_LIGHT = 0.02  # of v2e's full rate
TYPICAL = 0.4  # cutoff of a low-pass proportional to light, in a typical scene, of that at 255 DN


@dataclasses.dataclass(frozen=True)
class Photoreceptor:
    """offset_dn: light added to the frames' DN before the log; tau_s: time constant of the low-pass
    at 255 DN, 0 without one; delay_s: of the events after the frames; by_light: whether the
    low-pass's cutoff is proportional to light; log_map: of a `SensorModel`."""

    offset_dn: float = 0.0
    tau_s: float = 0.0
    delay_s: float = 0.0
    by_light: bool = True
    log_map: LogMap = "linlog"

    @staticmethod
    def of(sensor: SensorModel, optics: Optics) -> Photoreceptor:
        return Photoreceptor(optics.offset_dn, _time_constant(sensor.cutoff_hz), optics.delay_s,
                             sensor.cutoff_by_light, sensor.log_map)

    @property
    def ideal(self) -> bool:
        """Whether the pixel is known to see the light of the frames, without delay."""
        return all(is_off(v) for v in (self.offset_dn, self.tau_s, self.delay_s))

    @property
    def logarithmic(self) -> bool:
        """Whether the logarithm is one in dim light too."""
        return self.log_map == "log_eps"

    @property
    def cutoff_hz(self) -> float:
        """Cutoff of the low-pass at 255 DN; 0 without one."""
        return 1.0 / (2.0 * np.pi * self.tau_s) if self.tau_s > FAST else 0.0

    @property
    def typical_tau_s(self) -> float:
        """Time constant of the low-pass in the light of a typical scene."""
        return self.tau_s / TYPICAL if self.by_light else self.tau_s


IDEAL = Photoreceptor()


def _time_constant(cutoff_hz: Any) -> Any:
    """Seconds; 0 for a cutoff of 0, which is no low-pass. A traced one may have any value."""
    if isinstance(cutoff_hz, float):
        return 1.0 / (2.0 * np.pi * cutoff_hz) if cutoff_hz > 0 else 0.0
    on = jnp.asarray(cutoff_hz) > 0
    return jnp.where(on, 1.0 / (2.0 * np.pi * jnp.where(on, cutoff_hz, 1.0)), 0.0)


def as_measured(sensor: SensorModel, optics: Optics) -> tuple[Photoreceptor, SensorModel]:
    """The two stages of simulating a measured camera: the photoreceptor for `seen_frames`, and the
    circuit behind it, with dead time and noise."""
    behind = dataclasses.replace(sensor, cutoff_hz=0.0, cutoff_by_light=True)
    return Photoreceptor.of(sensor, optics), behind


def lin_log_dn(dn: ArrayLike) -> Array:
    """v2e's lin-log of DN >= 0, beyond 255 too, without its rounding."""
    dn = jnp.asarray(dn)
    return jnp.where(dn <= 20.0, dn * (np.log(20.0) / 20.0), jnp.log(jnp.maximum(dn, 1.0)))


def seen_path(
    dn: ArrayLike, dt_s: ArrayLike, offset: ArrayLike, tau_s: ArrayLike, by_light: ArrayLike = True,
    logarithmic: ArrayLike = False,
) -> Array:
    """s (T + 1, ...) of light dn (T + 1, ...) in DN at times dt_s (T,) apart, starting at rest."""
    u, rate = _light(dn, offset, tau_s, by_light, logarithmic)

    def step(s: Array, x: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        s = _followed(s, *x)
        return s, s

    pace = 0.5 * (rate[1:] + rate[:-1])
    _, s = jax.lax.scan(step, u[0], (u[:-1], u[1:], pace, jnp.asarray(dt_s)))
    return jnp.concatenate([u[:1], s])


def seen_log(
    frames: Array, dt_s: float, sensor: SensorModel, offset_dn: float = 0.0
) -> tuple[Array, SensorModel]:
    """`seen_frames` on the device.

    Args:
        frames: (T, H, W) in DN, at instants dt_s apart.
        dt_s: seconds.
        sensor: the circuit, with its low-pass.
        offset_dn: light in DN that the pixels see and the frames do not show.

    Returns:
        Log intensity (T, H, W) in the map of the circuit behind the photoreceptor, and that
        circuit, to simulate with.
    """
    seen_by, behind = as_measured(sensor, Optics(offset_dn))
    if seen_by.ideal:
        return to_log(frames, behind.log_map), behind
    how = offset_dn, seen_by.tau_s, seen_by.by_light, seen_by.logarithmic
    s = _light(frames, *how)[0]
    if not is_off(seen_by.tau_s):  # a traced one may be 0
        low_passed = seen_path(frames, jnp.full(len(frames) - 1, dt_s), *how)
        s = jnp.where(seen_by.tau_s > 0, low_passed, s)
    darker = jnp.log1p(jnp.maximum(offset_dn, 0.0) / 255.0)
    return to_log(_shown(s, darker, seen_by.logarithmic), behind.log_map), behind


def seen_frames(
    pairs: Iterable[tuple[np.ndarray, int]], seen_by: Photoreceptor
) -> Iterator[tuple[np.ndarray, int]]:
    """Convert frames so that an ideal pixel gives the events of one behind a photoreceptor.

    Args:
        pairs: (frame (H, W) in DN, time in us).
        seen_by: the photoreceptor.

    Yields:
        (frame, time on the events' clock): float32 DN on 0..255. With added light all are scaled
        by one factor to fit, as pixels respond to changes of the log only.
    """
    if seen_by.ideal:
        yield from pairs
        return
    offset, tau_s = (np.float32(v) for v in (seen_by.offset_dn, max(seen_by.tau_s, FAST)))
    darker = np.float32(np.log1p(max(seen_by.offset_dn, 0.0) / 255.0))
    before: tuple[Array, Array, Array, int] | None = None
    for frame, t_us in pairs:
        now, rate = _light_of_frame(
            np.asarray(frame, np.float32), offset, tau_s, seen_by.by_light, seen_by.logarithmic)
        s = now
        if before is not None and seen_by.tau_s:
            old, u, pace, last_us = before
            s = _step(old, u, now, 0.5 * (pace + rate), np.float32((t_us - last_us) * 1e-6))
        before = s, now, rate, t_us
        shown = np.asarray(_shown(s, darker, seen_by.logarithmic))
        yield shown, t_us + round(seen_by.delay_s * 1e6)


def _light(
    dn: ArrayLike, offset: ArrayLike, tau_s: ArrayLike, by_light: ArrayLike, logarithmic: ArrayLike
) -> tuple[Array, Array]:
    """u and r at light in DN."""
    light = jnp.maximum(jnp.asarray(dn) + offset, LEAST_DN)
    share = jnp.where(by_light, jnp.maximum((light + 20.0) / 275.0, LEAST_LIGHT), 1.0)
    u = jnp.where(logarithmic, log_dn(light), lin_log_dn(light))
    return u, share / jnp.maximum(tau_s, FAST)


def _followed(s: Array, before: Array, now: Array, rate: Array, dt_s: Array) -> Array:
    """s at the end of a step in which u changes linearly from `before` to `now`."""
    lag = (now - before) / (rate * dt_s)
    return now - lag + (s - before + lag) * jnp.exp(-rate * dt_s)


@jax.jit
def _shown(s: Array, darker: ArrayLike, logarithmic: ArrayLike) -> Array:
    """The frame in DN (0..255) whose log is s minus `darker` log units."""
    s = s - darker
    return jnp.minimum(jnp.where(logarithmic, log_dn_inverse(s), lin_log_inverse(s)), 255.0)


_light_of_frame, _step = jax.jit(_light), jax.jit(_followed)
