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
from evflow.camera import Camera, CameraPrior, Summary, sample_pixels
from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import noise_factor, normalised_intensity
from evflow.scenes import TextureBank, watch
from evflow.scenes.config import SceneConfig
from evflow.simulator.photoreceptor import as_measured, seen_frames
from evflow.training.config import PRESETS
from evflow.types import Events

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class Protocol:
    """What the recordings are like. fresh: the events begin at the first frame, with its
    brightness in the memory; else the camera has been running for 20 ms. fade: instead of moving,
    the scene's brightness is multiplied by this in all. off: whether OFF events come as they
    should, have a threshold that nothing reaches, or are sent but left out of the recording.
    exposure_ms: over which a frame is the mean of the light, and exposure_known: whether the
    recording says so; black_dn: added to the frames;
    dark_dn: added to the light that pixels see. exact: the model's low-pass is solved exactly
    between the video's frames; else it is v2e's step from frame to frame, which makes a pixel
    faster than its cutoff says: at 1000 frames/s, 40 Hz act as some 53."""

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
    exposure_ms: int = 0
    exposure_known: bool = False
    black_dn: float = 0.0
    dark_dn: float = 0.0
    exact: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Hidden:
    """A recording and the truth behind it.

    camera, nominal: noise rates are those of all noise but leak, at the recording's mean intensity;
    video: (T, H, W) DN at 1000 frames/s, of which the recording keeps the frames `kept` (K+1,);
    noise: (N,) bool, events that are noise.
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


WHITE_DN, EVERY = 255.0, 20  # of the frames at 1000 frames/s of which light is the mean
BLACK, WHITE = 20.0, 250.0  # DN of a fade: its black when darkest, its white when brightest
UNREACHED = 8.0  # a threshold beyond every change of 8-bit frames


def _faded(image: np.ndarray, factor: float, count: int) -> np.ndarray:
    """(count, H, W) DN: an image (H, W) whose brightness changes steadily by a factor."""
    gains = factor ** np.linspace(0.0, 1.0, count, dtype=np.float32)
    gains /= gains.min()
    room = WHITE / gains.max() - BLACK
    return (BLACK + room * np.clip(image, 0, 255) / 255) * gains[:, None, None]


def _exposed(frames: np.ndarray, kept: np.ndarray, exposure_ms: int) -> np.ndarray:
    """The frames (T, H, W) at `kept`, each the mean over an exposure around its time."""
    half = exposure_ms // 2
    if not half:
        return frames[kept]
    return np.stack([frames[max(0, k - half):k + half + 1].mean(0) for k in kept])


def low_passed(
    lit: np.ndarray, times: np.ndarray, protocol: Protocol
) -> tuple[np.ndarray, SensorModel]:
    """What the circuit behind the low-pass is shown (T, H, W), and that circuit."""
    model = protocol.model
    if not (protocol.exact and model.cutoff_hz):
        return lit, model
    seen_by, behind = as_measured(model, Optics())
    pairs = zip(lit, times.tolist(), strict=True)
    return np.stack([frame for frame, _ in seen_frames(pairs, seen_by)]), behind


def with_dark_light(frames: np.ndarray, dark_dn: float) -> np.ndarray:
    """The light (T, H, W) on pixels that see so many DN more than the frames show, darker by one
    factor, which is no contrast, so that nothing is brighter than white."""
    if not dark_dn:
        return frames
    return (frames + np.float32(dark_dn)) * np.float32(WHITE_DN / (WHITE_DN + dark_dn))


def with_shot_noise(
    camera: Camera, nominal: Summary, light: np.ndarray, model: SensorModel
) -> tuple[Camera, Summary]:
    """The camera, and its summary, with v2e's shot noise among their noise rates: half of it each
    polarity, by the light (T, H, W) DN, and more at lower thresholds."""
    if not model.shot_hz:
        return camera, nominal
    factor = np.asarray(noise_factor(normalised_intensity(light[::EVERY]))).mean(0)
    for name in ("on", "off"):
        theta, eta = np.asarray(getattr(camera, f"theta_{name}")), f"eta_{name}"
        more = 0.5 * model.shot_hz * factor * np.median(theta) / theta
        camera = dataclasses.replace(camera, **{eta: getattr(camera, eta) + more})
        nominal = dataclasses.replace(
            nominal, **{eta: getattr(nominal, eta) + np.float32(more.mean())})
    return camera, nominal


def hidden_recording(key: Array, bank: TextureBank, protocol: Protocol) -> Hidden:
    """Draw a scene and a camera; simulate the recording."""
    k_scene, k_nominal, k_pixels, k_events, k_noise = jax.random.split(key, 5)
    lead = 0 if protocol.fresh else watch.LEAD_MS
    length = lead + protocol.frame_ms * protocol.intervals + 1
    scene = watch.draw_scene(k_scene, bank, protocol.scene, protocol.shape)
    instants = (np.arange(length, dtype=np.float32) - 0.5 * length) * 1e-3
    frames = np.concatenate(list(watch.film(scene, instants, protocol.shape)))
    if protocol.fade != 1.0:
        frames = _faded(frames[length // 2], protocol.fade, length)
    light, prior = watch.light(jnp.asarray(frames)), protocol.prior
    nominal, camera = watch.draw_camera(k_nominal, k_pixels, prior, protocol.shape, light[0])
    if protocol.off == "unreached":
        nominal = dataclasses.replace(nominal, theta_off=jnp.float32(UNREACHED))
        camera = sample_pixels(k_pixels, nominal, protocol.shape, prior.eta_spread)
    times = np.arange(length) * 1000
    lit = with_dark_light(frames, protocol.dark_dn)
    shown, model = low_passed(lit, times, protocol)
    events, labels = simulate(k_events, shown, times, camera, model=model, labels=True,
                              full_scale=WHITE_DN)
    if protocol.off == "dropped":
        on = events.p
        labels = labels[on]
        events = Events(events.x[on], events.y[on], events.t[on], events.p[on], events.size)
    kept = np.arange(lead, length, protocol.frame_ms)
    read = _exposed(frames, kept, protocol.exposure_ms) + np.float32(protocol.black_dn)
    gray = np.asarray(watch.recorded(k_noise, read, protocol.frame_noise_dn), np.uint8)
    gain = watch.noise_gain(protocol.model, light, light[0])
    exposure_us = 1000 * protocol.exposure_ms * protocol.exposure_known
    recording = Recording(events, gray, times[kept], exposure_us=exposure_us)
    return Hidden(recording, *with_shot_noise(
        watch.with_noise(camera, gain), watch.with_noise(nominal, gain), lit, protocol.model),
        frames, kept, labels)


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


def draw_protocols(seed: int, count: int) -> list[Protocol]:
    """So many of them, each by its own number."""
    return [draw_protocol(np.random.default_rng((seed, i))) for i in range(count)]
