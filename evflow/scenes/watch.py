"""Simulation of a running camera before a scene: the one way from a scene to events and frames.

    scene ─ film ─ frames in DN ─┬─ light ─ draw_camera ─ a camera whose noise follows Eq. 12
                                 ├─ memory, voxels ─ its events, binned on the device
                                 └─ recorded ─ the recorded frames

A camera has been running when a recording begins: its memory is anywhere between the thresholds
(`memory`), or the simulation starts `LEAD_MS` before the recording. Noise rates are reported at the
recording's mean intensity, and simulated from that of the first frame (`noise_gain`).

Pure functions of their keys. All but `film` batch by `vmap`; frames are (T, H, W).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera, CameraPrior, Summary, sample_nominal, sample_pixels
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import Values, noise_factor, normalised_intensity
from evflow.scenes.render import Scene, render, sample_scene
from evflow.simulator import noise, sensor
from evflow.simulator.constants import Constants
from evflow.simulator.voxels import simulate_window

Array = jax.Array
Parameters = TypeVar("Parameters", Camera, Summary)

BLOCK = 64  # frames rendered at a time
LEAD_MS = 20  # simulated on the host before the first recorded frame

draw_scene = jax.jit(sample_scene, static_argnames=("config", "shape"))


def film(
    scene: Scene, times_s: np.ndarray, shape: tuple[int, int], block: int = BLOCK
) -> Iterator[np.ndarray]:
    """Frames (T, H, W) float32 DN at the scene's instants, in blocks of `block` on the host: one
    compiled program for any length."""
    for first in range(0, len(times_s), block):
        part = times_s[first : first + block]
        padded = np.pad(part, (0, block - len(part)), mode="edge")
        yield np.asarray(render(scene, padded, shape))[: len(part)]


def exposures(
    key: Array, times_s: Array, count: int, exposure_s: float, jitter_s: float
) -> Array:
    """Times (T, count) over which the frames at times_s (T,) are averaged: exposures of up to
    exposure_s, with time stamps off by a std of up to jitter_s. Half of the scenes have no
    exposure, and, independently, half no jitter."""
    k_some, k_span, k_late, k_frame = jax.random.split(key, 4)
    some = jax.random.bernoulli(k_some, 0.5, (2,))
    span = some[0] * exposure_s * jax.random.uniform(k_span)
    late = some[1] * jitter_s * jax.random.uniform(k_late)
    inside = (jnp.arange(count) + 0.5) / count - 0.5
    centre = times_s + late * jnp.clip(jax.random.normal(k_frame, times_s.shape), -2.0, 2.0)
    return centre[:, None] + span * inside[None]


def exposed(scene: Scene, instants_s: Array, shape: tuple[int, int]) -> Array:
    """Frames (T, H, W) DN, each the mean over its instants (T, count)."""
    frames = render(scene, instants_s.reshape(-1), shape)
    return frames.reshape(*instants_s.shape, *shape).mean(1)


def recorded(key: Array, frames: Array | np.ndarray, noise_dn: float) -> Array:
    """The frames with Gaussian noise of noise_dn, rounded to 8 bits, as float32 DN."""
    frames = frames + noise_dn * jax.random.normal(key, frames.shape)
    return jnp.clip(jnp.round(frames), 0.0, 255.0)


def light(frames: Values) -> Values:
    """Intensity factor of the noise in Eq. 12, (...), of frames (..., H, W) DN."""
    return noise_factor(normalised_intensity(frames).mean((-2, -1)))


def noise_gain(model: SensorModel, light: Values, first: Values | float) -> Values | float:
    """Mean noise rate of a recording relative to the simulator's reference, the first frame. light,
    first: intensity factors of Eq. 12 of the recording (per frame or pixel) and of that frame."""
    return light.mean() / first if model.eta_intensity else 1.0


def with_noise(parameters: Parameters, gain: Array | float) -> Parameters:
    """Noise rates times gain."""
    return dataclasses.replace(parameters, eta_on=parameters.eta_on * gain,
                               eta_off=parameters.eta_off * gain)


def draw_camera(
    k_nominal: Array, k_pixels: Array, prior: CameraPrior, shape: tuple[int, int],
    light: Array | None,
) -> tuple[Summary, Camera]:
    """Draw a camera of the prior: its summary and maps (H, W). light: of the first frame; None
    where the noise does not depend on the scene."""
    nominal = sample_nominal(k_nominal, (), prior, light)
    return nominal, sample_pixels(k_pixels, nominal, shape, prior.eta_spread)


def memory(key: Array, camera: Camera) -> Array:
    """Initial contrast (H, W) of a running camera: brightness relative to the memory, uniform
    between the thresholds."""
    return (jax.random.uniform(key, camera.theta_on.shape) * (camera.theta_on + camera.theta_off)
            - camera.theta_off)


def voxels(
    key: Array, log_frames: Array, camera: Camera, model: SensorModel, windows: int,
    dt_s: Array | float, bins: int, phase: Array | float,
) -> Array:
    """Voxels (windows, H, W, 2 * bins) of log frames (windows * steps + 1, H, W) dt_s apart.
    phase: initial contrast of the pixels: of `memory`, or 0 for a memory at the first frame."""
    law = Constants.of(model)
    medians = noise.nominal_thresholds(law, camera)
    pixels, state = sensor.start(key, log_frames[0], camera, law, medians, phase)
    parts = log_frames[1:].reshape(windows, -1, *log_frames.shape[1:])

    def window(state: sensor.SimState, part: Array) -> tuple[sensor.SimState, Array]:
        return simulate_window(law, pixels, state, part, dt_s, bins)

    return jax.lax.scan(window, state, parts)[1]
