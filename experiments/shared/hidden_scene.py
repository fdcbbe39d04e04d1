"""A hidden camera before a rendered scene, and what the estimated one sees of the same frames."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from evflow import CameraEstimate, Events, Recording, simulate
from evflow.camera import Camera, CameraPrior, Summary, sample_nominal, sample_pixels
from evflow.camera.sensors import SensorModel
from evflow.scenes import SceneConfig, make_bank, render, sample_scene
from evflow.simulator import simulate_stream
from evflow.simulator.interpolate import unzip, upsample
from evflow.simulator.photoreceptor import as_measured, seen_frames

FPS, FRAME_EVERY = 1000, 25  # rendered frames per second; one in 25 is given to the estimator


def hidden_camera(
    seed: int, width: int, height: int, milliseconds: int
) -> tuple[Recording, Camera, Summary]:
    """A recording of a rendered scene by a random camera, frames every 25 ms and 8 bit; the
    camera's maps; its nominal values (the truth of the table)."""
    k_bank, k_scene, k_nominal, k_pixels, k_noise = jax.random.split(jax.random.key(seed), 5)
    shape = (height, width)
    bank = make_bank(k_bank, 48)
    config = SceneConfig(speed_px_s=(60.0, 200.0), static_fraction=0.0, contrast=(0.6, 1.0),
                         gamma=(0.8, 1.2), foreground_probability=1.0)
    scene = sample_scene(k_scene, bank, config, shape)
    frame = jax.jit(lambda t: render(scene, t, shape))
    times = np.arange(milliseconds + 1)
    frames = np.concatenate([np.asarray(frame(jnp.asarray(t / FPS, jnp.float32)))
                             for t in np.array_split(times, max(1, len(times) // 50))])
    nominal = sample_nominal(k_nominal, (), CameraPrior(theta=(0.15, 0.4), mismatch=(0.03, 0.06)))
    truth = sample_pixels(k_pixels, nominal, shape)
    model = SensorModel(noise_resets_memory=True)
    events = simulate(k_noise, frames, times * 1000, truth, model=model)
    kept = slice(None, None, FRAME_EVERY)
    recording = Recording(events, np.clip(np.rint(frames[kept]), 0, 255).astype(np.uint8),
                          times[kept] * 1000)
    return recording, truth, nominal


def simulate_again(recording: Recording, found: CameraEstimate, seed: int) -> Events:
    """The recording's frames, interpolated to <= .5 px of motion, seen by the estimated camera
    with its circuit, in the light that it was measured to see."""
    pairs = ((recording.frame_dn(i), int(t)) for i, t in enumerate(recording.frame_times)
             if recording.events.t[0] - 1000 <= t <= recording.events.t[-1] + 1000)
    seen_by, model = as_measured(found.sensor, found.optics)
    frames, times = unzip(seen_frames(upsample(pairs), seen_by))
    key = jax.random.key(seed + 1)
    return Events.concatenate(list(simulate_stream(key, frames, times, found.camera, model=model)))
