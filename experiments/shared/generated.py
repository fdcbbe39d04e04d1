"""Generated windows of events (by the inverse direction or EventGAN) against simulated ones."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from evflow import Camera
from evflow.camera import CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import lin_log
from evflow.scenes import TextureBank, render, sample_scene, watch
from evflow.scenes.config import SceneConfig

Array = jax.Array
Row = dict[str, np.ndarray]

MODEL = SensorModel(eta_intensity=True)
SCENE = SceneConfig(speed_px_s=(5.0, 350.0), contrast=(0.2, 1.0))
BINS = 16
ENOUGH = 20  # events of a scene, for a meaningful correlation


@dataclasses.dataclass(frozen=True)
class Windows:
    """Windows to generate: the cameras' prior, duration, (H, W)."""

    prior: CameraPrior
    window_s: float
    shape: tuple[int, int] = (64, 64)


@partial(jax.jit, static_argnames="windows")
def scene_of(key: Array, bank: TextureBank, windows: Windows) -> tuple[Array, Camera]:
    """log frames (4 * BINS + 1, H, W) of a window, and a camera."""
    k_scene, k_nominal, k_pixels = jax.random.split(key, 3)
    scene = sample_scene(k_scene, bank, SCENE, windows.shape)
    steps = 4 * BINS
    times = (jnp.arange(steps + 1) / steps - 0.5) * windows.window_s
    frames = render(scene, times, windows.shape)
    light = watch.light(frames[0])
    _, camera = watch.draw_camera(k_nominal, k_pixels, windows.prior, windows.shape, light)
    return lin_log(frames), camera


@partial(jax.jit, static_argnames="window_s")
def simulated(
    key: Array, frames: Array, camera: Camera, window_s: float, running: float = 1.0
) -> Array:
    """voxels (H, W, 2 BINS) of a camera that has been running: its memory is anywhere between
    the thresholds. running 0: it is at the first frame."""
    k_phase, k_sim = jax.random.split(key)
    dt = jnp.float32(window_s / (len(frames) - 1))
    phase = running * watch.memory(k_phase, camera)
    return watch.voxels(k_sim, frames, camera, MODEL, 1, dt, BINS, phase)[0]


def compare(made: Array, one: Array, two: Array, where: Array) -> Row:
    """Additive sums: generated voxels against two simulations of the same camera. Correlations
    count only for scenes with at least ENOUGH events."""
    def counts(voxels: Array) -> Array:
        on, off = jnp.split(voxels, 2, -1)
        return jnp.stack([on.sum(-1), off.sum(-1)])

    def correlation(a: Array, b: Array) -> Array:
        return jnp.corrcoef(jnp.stack([a[:, where].ravel(), b[:, where].ravel()]))[0, 1]

    made_n, one_n, two_n = counts(made), counts(one), counts(two)
    empty = where & (one.sum(-1) + two.sum(-1) == 0)
    used = float(one_n[:, where].sum()) >= ENOUGH
    pair = [correlation(made_n, one_n), correlation(one_n, two_n), 1.0] if used else [0.0] * 3
    return {"made": np.asarray((made_n * where[None]).sum((1, 2))),
            "simulated": np.asarray(0.5 * ((one_n + two_n) * where[None]).sum((1, 2))),
            "empty": np.array([(jnp.abs(made) * empty[..., None]).sum(),
                               empty.sum() * made.shape[-1]]),
            "correlations": np.array(pair)}


def figures(total: Row) -> dict[str, float]:
    """Ratios of the sums over scenes."""
    with_one, between, scenes = total["correlations"]
    ratio = total["made"] / total["simulated"]
    return {"on": float(ratio[0]), "off": float(ratio[1]),
            "empty": float(total["empty"][0] / total["empty"][1]),
            "correlation": float(with_one / scenes), "two simulations": float(between / scenes),
            "relative": float(with_one / between)}
