"""Recordings of sensors whose noise is known, for noise_rates: law, video, and simulation."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from evflow import Recording, simulate
from evflow.baselines import voltmeter_noise
from evflow.camera import Summary, noise_of_threshold, sample_pixels
from evflow.camera.sensors import SENSORS, SensorModel
from evflow.light.log_maps import noise_factor, normalised_intensity

MODELS = {"eq12": SensorModel(eta_intensity=True), "dvs346": SENSORS["dvs346"].model}
SCENES = ("flat", "still", "moving")
SIGMA = 0.03  # mismatch, log units: v2e's default
WARM_US, WARM = 100_000_000, 10  # before the recording: leaks of all pixels get out of step
FLAT_S, FRAME_MS, INTERVALS = 10, 40, 24
TEXTURE, DISC, RADIUS, SPEED = 0.2, 0.5, 8.0, 40.0  # contrast, brightness; px, px/s
FRAME_NOISE_DN = 0.5


def law(sensor: str, theta: Any, dn: Any) -> np.ndarray:
    """Noise rates (2, ...) in Hz of a sensor at thresholds (ON, OFF) and luminance; broadcasts."""
    if sensor == "dvs346":
        return np.stack(voltmeter_noise(dn, theta[0], theta[1]))
    factor = noise_factor(normalised_intensity(jnp.asarray(dn, jnp.float32)))
    return np.stack([noise_of_threshold(jnp.float32(t)) * factor for t in theta])


def video(key: jax.Array, scene: str, dn: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T, H, W) in DN and their times in us, from 0."""
    if scene == "flat":
        return (np.full((FLAT_S + 1, size, size), dn, np.float32),
                1_000_000 * np.arange(FLAT_S + 1))
    k_texture, k_turn = jax.random.split(key)
    texture = cv2.GaussianBlur(np.array(jax.random.normal(k_texture, (size, size))), (0, 0), 2.0)
    texture -= texture.mean()
    back = dn * (1 + TEXTURE * texture / np.abs(texture).max())
    if scene == "still":
        frames = np.broadcast_to(back, (INTERVALS + 1, size, size))
        return frames, 1000 * FRAME_MS * np.arange(INTERVALS + 1)
    times = 1000 * np.arange(FRAME_MS * INTERVALS + 1)
    y, x = np.mgrid[:size, :size].astype(np.float32)
    centre = 0.2 * size + SPEED * 1e-6 * times[:, None, None].astype(np.float32)
    away = np.hypot(x - centre, y - size / 2) - RADIUS
    inside = np.clip(0.5 - away, 0, 1)
    frames = np.rot90(back * (1 - inside) + DISC * dn * inside,
                      int(jax.random.randint(k_turn, (), 0, 4)), (1, 2))
    return np.ascontiguousarray(frames, np.float32), times


def record(
    key: jax.Array, sensor: str, scene: str, theta: np.ndarray, dn: float, size: int
) -> tuple[Recording, np.ndarray]:
    """A recording of a camera that has been running, and its noise: mean rates (2,) in Hz."""
    k_video, k_pixels, k_events, k_frames = jax.random.split(key, 4)
    frames, times = video(k_video, scene, dn, size)
    nominal = (jnp.float32(v) for v in (*theta, 0.0, 0.0, SIGMA, SIGMA))
    camera = sample_pixels(k_pixels, Summary(*nominal), (size, size))
    known = theta if sensor == "eq12" else (camera.theta_on, camera.theta_off)
    truth = law(sensor, known, frames.mean(0)).mean((1, 2))
    if sensor == "eq12":  # else the leak is the sensor's own
        eta = law(sensor, theta, frames[0].mean())
        on, off = (jnp.full(camera.shape, rate) for rate in eta)
        camera = dataclasses.replace(camera, eta_on=on, eta_off=off)
    before = np.broadcast_to(frames[:1], (WARM, size, size))
    clock = np.concatenate([WARM_US // WARM * np.arange(WARM), WARM_US + times])
    events = simulate(k_events, np.concatenate([before, frames]), clock, camera,
                      model=MODELS[sensor]).slice(WARM_US, int(clock[-1]) + 1)
    if scene == "flat":
        return Recording.of_events(events), truth
    kept = slice(None, None, FRAME_MS if scene == "moving" else 1)
    noisy = frames[kept] + FRAME_NOISE_DN * np.asarray(
        jax.random.normal(k_frames, frames[kept].shape))
    gray = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return Recording(events, gray, WARM_US + times[kept]), truth


def counting(recording: Recording) -> np.ndarray:
    """Events per pixel and second (2,), of any cause."""
    return recording.events.count_map().mean((1, 2)) / (1e-6 * recording.events.duration_us)
