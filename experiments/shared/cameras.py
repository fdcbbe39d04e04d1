"""Held-out recordings of hidden cameras, as a user would bring them: events and 8-bit frames.

Scenes are rendered at 1000 frames/s and simulated on the host; the recording keeps every n-th
frame. Everything follows from the key.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from evflow import Recording, simulate
from evflow.camera import Camera, CameraPrior, Summary, sample_nominal, sample_pixels
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import noise_factor, normalised_intensity
from evflow.scenes import Scene, TextureBank, render, sample_scene
from evflow.scenes.config import SceneConfig
from evflow.training.config import PRESETS
from evflow.types import Events

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class Protocol:
    """What the recordings are like. fresh: the events begin at the first frame, with its
    brightness in the memory; else the camera has been running for 20 ms. fade: instead of moving,
    the scene's brightness is multiplied by this in all. off: whether OFF events come as they
    should, have a threshold that nothing reaches, or are sent but left out of the recording."""

    prior: CameraPrior = CameraPrior()
    scene: SceneConfig = SceneConfig(speed_px_s=(5.0, 350.0), contrast=(0.2, 1.0))
    model: SensorModel = SensorModel(eta_intensity=True)
    shape: tuple[int, int] = (64, 64)
    frame_ms: int = 25
    intervals: int = 8
    frame_noise_dn: float = 0.5
    fresh: bool = False
    fade: float = 1.0
    off: Literal["sent", "unreached", "dropped"] = "sent"


@dataclasses.dataclass(frozen=True, eq=False)
class Hidden:
    """A recording and the truth behind it.

    nominal: at the recording's mean intensity; video: (T, H, W) DN at 1000 frames/s, of which the
    recording keeps the frames `kept` (K+1,); noise: (N,) bool, events that are noise.
    """

    recording: Recording
    camera: Camera
    nominal: Summary
    video: np.ndarray
    kept: np.ndarray
    noise: np.ndarray

    def signal_events(self) -> np.ndarray:
        """ON and OFF events (2,) less those that noise is expected to send."""
        events = self.recording.events
        seconds = 1e-6 * events.duration_us
        noise = [float(m.sum()) * seconds for m in (self.camera.eta_on, self.camera.eta_off)]
        return np.array([events.p.sum(), (~events.p).sum()]) - np.array(noise)


BLACK, WHITE = 20.0, 250.0  # DN of a fade: its black when darkest, its white when brightest
UNREACHED = 8.0  # a threshold beyond every change of 8-bit frames
BLOCK = 64  # frames rendered at a time: one compiled program for recordings of any length


_scene = jax.jit(sample_scene, static_argnames=("config", "shape"))


def _frames(scene: Scene, shape: tuple[int, int], count: int) -> np.ndarray:
    """(count, H, W) DN at 1000 frames/s, the scene's reference instant in the middle."""
    blocks = -(-count // BLOCK)
    times = (np.arange(blocks * BLOCK, dtype=np.float32) - 0.5 * count) * 1e-3
    parts = [np.asarray(render(scene, t, shape)) for t in times.reshape(blocks, BLOCK)]
    return np.concatenate(parts)[:count]


def _faded(image: np.ndarray, factor: float, count: int) -> np.ndarray:
    """(count, H, W) DN: an image (H, W) whose brightness changes steadily by a factor."""
    gains = factor ** np.linspace(0.0, 1.0, count, dtype=np.float32)
    gains /= gains.min()
    room = WHITE / gains.max() - BLACK
    return (BLACK + room * np.clip(image, 0, 255) / 255) * gains[:, None, None]


def hidden_recording(key: Array, bank: TextureBank, protocol: Protocol) -> Hidden:
    """Draw a scene and a camera; simulate the recording."""
    k_scene, k_nominal, k_pixels, k_events, k_noise = jax.random.split(key, 5)
    lead = 0 if protocol.fresh else 20
    length = lead + protocol.frame_ms * protocol.intervals + 1
    scene = _scene(k_scene, bank, protocol.scene, protocol.shape)
    frames = _frames(scene, protocol.shape, length)
    if protocol.fade != 1.0:
        frames = _faded(frames[length // 2], protocol.fade, length)
    light = noise_factor(normalised_intensity(jnp.asarray(frames)).mean((1, 2)))
    nominal = sample_nominal(k_nominal, (), protocol.prior, light[0])
    if protocol.off == "unreached":
        nominal = dataclasses.replace(nominal, theta_off=jnp.float32(UNREACHED))
    camera = sample_pixels(k_pixels, nominal, protocol.shape, protocol.prior.eta_spread)
    times = np.arange(length) * 1000
    events, labels = simulate(k_events, frames, times, camera, model=protocol.model, labels=True)
    if protocol.off == "dropped":
        on = events.p
        labels = labels[on]
        events = Events(events.x[on], events.y[on], events.t[on], events.p[on], events.size)
    kept = np.arange(lead, length, protocol.frame_ms)
    noise = protocol.frame_noise_dn * jax.random.normal(k_noise, (len(kept), *protocol.shape))
    gray = np.clip(np.rint(frames[kept] + np.asarray(noise)), 0, 255).astype(np.uint8)
    gain = light.mean() / light[0] if protocol.model.eta_intensity else 1.0
    seen = {n: getattr(nominal, n) * gain for n in ("eta_on", "eta_off")}
    return Hidden(
        Recording(events, gray, times[kept]),
        dataclasses.replace(camera, eta_on=camera.eta_on * gain, eta_off=camera.eta_off * gain),
        dataclasses.replace(nominal, **seen), frames, kept, labels)


FRAME_MS = (10, 20, 25, 25, 33, 40)
INTERVALS = (8, 8, 8, 16, 24)


def draw_protocol(rng: np.random.Generator) -> Protocol:
    """One of the whole training distribution: frame rates of 25-100 Hz, .08-1 s, every sensor
    model, both starts."""
    config = PRESETS["default"]
    mismatch = float(rng.choice([0.03, rng.uniform(*config.prior.mismatch), 0.15]))
    prior = dataclasses.replace(config.prior, mismatch=(mismatch, mismatch))
    if rng.random() < 0.5:  # half as in the paper, where accuracy is compared
        tied: Literal["eq12", "independent"] = "eq12" if rng.random() < 0.5 else "independent"
        prior = CameraPrior(mismatch=(mismatch, mismatch), noise=tied)
    return Protocol(
        prior=prior, scene=config.scene,
        model=config.sensors[int(rng.choice(len(config.sensors), p=[0.4, 0.2, 0.3, 0.1]))],
        frame_ms=int(rng.choice(FRAME_MS)), intervals=int(rng.choice(INTERVALS)),
        frame_noise_dn=float(rng.choice([0.0, 0.5])), fresh=bool(rng.random() < 0.4))
