"""Target cameras, and what they record: the cameras of `experiments.see_better`.

A target is a camera of known maps behind a circuit other than the one that simulates training
data: a low-pass, dead times, leak and shot noise ("noisy"), Brownian motion ("voltmeter"), or
ESIM's logarithm. It gives one recording to estimate it from, and clips of held-out scenes with
their frames and flow. Everything follows from the names and `SEED`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from evflow import Recording, simulate
from evflow.camera import Camera, Summary, sample_pixels
from evflow.camera.perturb import with_faults
from evflow.camera.sensors import SensorModel
from evflow.downstream.simulated import SequenceConfig, scene_clock
from evflow.downstream.tensor import BINS, event_tensor, windows_between
from evflow.scenes import Scene, TextureBank, make_bank, watch
from evflow.scenes.config import SceneConfig
from evflow.scenes.motion import optical_flow
from evflow.types import Events

Array = jax.Array

SEED = 7_000_003  # of scenes, textures and cameras that nothing is trained on
# theta ON, OFF (natural log), eta ON, OFF (Hz), mismatch of both thresholds.
CAMERAS = {"high": (0.45, 0.35, 1.0, 0.6, 0.05), "low": (0.12, 0.16, 4.0, 2.5, 0.03),
           "middle": (0.30, 0.42, 1.5, 1.0, 0.05)}
CIRCUITS = {
    "noisy": SensorModel(
        cutoff_hz=200.0, refractory_s=1e-3, leak_hz=0.1, leak_jitter=0.1, leak_fpn_decades=0.1,
        shot_hz=0.5, eta_intensity=True, noise_resets_memory=True),
    "voltmeter": SensorModel(kind="voltmeter", eta_intensity=True),
    "esim": SensorModel(kind="esim", refractory_s=1e-3, eta_intensity=True),
}
# Below 20 px/s hardly anything moves in the .6 s of a clip.
SCENES = SceneConfig(contrast=(0.3, 1.0), static_fraction=0.0, speed_px_s=(20.0, 350.0))
HOT = 2e-3  # share of hot pixels
STEP_US = 1000  # between rendered frames
LEAD = watch.LEAD_MS * 1000 // STEP_US  # frames before the first window
FRAME_STEPS, FRAME_NOISE_DN = 25, 0.5  # of the recording that is estimated from


@dataclasses.dataclass(frozen=True, eq=False)
class Target:
    """A camera (H, W) and its circuit; nominal: the camera-wide values of its maps; source: of no
    file."""

    name: str
    camera_name: str
    camera: Camera
    nominal: Summary
    circuit: SensorModel
    source: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Clip:
    """T windows of a held-out scene. edges_us (T + 1,); tensors (T, H, W, bins): signed events;
    borders (T + 1, H, W): frames at the edges, on [0, 1]; flow (T, 2, H, W): px over the window.
    """

    events: Events
    edges_us: np.ndarray
    tensors: np.ndarray
    borders: np.ndarray
    flow: np.ndarray


def target(camera: str, circuit: str, shape: tuple[int, int]) -> Target:
    """The target of these names; its maps do not depend on the circuit."""
    on, off, eta_on, eta_off, sigma = (jnp.float32(v) for v in CAMERAS[camera])
    nominal = Summary(on, off, eta_on, eta_off, sigma, sigma)
    k_pixels, k_hot = jax.random.split(_key("camera", camera))
    maps = with_faults(k_hot, sample_pixels(k_pixels, nominal, shape), HOT, dead=0.0)
    return Target(f"{camera} {circuit}", camera, maps, nominal, CIRCUITS[circuit])


def _key(*words: str) -> Array:
    """A key of its own for every use."""
    key = jax.random.key(SEED)
    for letter in " ".join(words).encode():
        key = jax.random.fold_in(key, letter)
    return key


def held_out_bank(textures: int, photos: bool = True) -> TextureBank:
    """Textures of a seed of their own. photos: and scikit-image's photographs, to test networks
    whose training had none."""
    return make_bank(_key("textures"), textures, photos=photos)


def recording(seen: Target, bank: TextureBank, data: SequenceConfig, seconds: float) -> Recording:
    """What a user would bring: events and 8-bit frames, 40 a second, of one scene."""
    shape = (seen.camera.shape[0], seen.camera.shape[1])
    steps = round(seconds * 1e6 / STEP_US)
    times = (np.arange(steps + 1, dtype=np.float32) - 0.5 * steps) * (STEP_US * 1e-6)
    scene = watch.draw_scene(_key("recorded scene"), bank, data.scene, shape)
    video = np.concatenate(list(watch.film(scene, times, shape)))
    stamps = STEP_US * np.arange(len(video))
    k_events, k_noise = jax.random.split(_key("recording", seen.name))
    events = simulate(k_events, video, stamps, seen.camera, model=seen.circuit)
    kept = np.arange(LEAD, len(video), FRAME_STEPS)
    frames = np.asarray(watch.recorded(k_noise, video[kept], FRAME_NOISE_DN), np.uint8)
    return Recording(events, frames, stamps[kept])


def clips(
    seen: Target, bank: TextureBank, data: SequenceConfig, count: int, windows: int,
    *others: str,
) -> Iterator[Clip]:
    """Held-out scenes with pauses as in training, the same for every target. others: name scenes
    and events that are not those held out."""
    shape = (seen.camera.shape[0], seen.camera.shape[1])
    steps = round(data.window_s * 1e6 / STEP_US)
    data = dataclasses.replace(data, windows=windows, steps_per_window=steps)
    for i in range(count):
        k_scene, k_pause = jax.random.split(jax.random.fold_in(_key("clips", *others), i))
        scene = watch.draw_scene(k_scene, bank, data.scene, shape)
        clock = np.asarray(scene_clock(k_pause, data))
        lead = STEP_US * 1e-6 * np.arange(-LEAD, 0, dtype=np.float32)
        instants = np.concatenate([lead, clock])
        video = np.concatenate(list(watch.film(scene, instants, shape)))
        times = STEP_US * np.arange(len(video))
        k_events = jax.random.fold_in(_key("events", seen.name, *others), i)
        events = simulate(k_events, video, times, seen.camera, model=seen.circuit, full_scale=255)
        yield clip_of(events, times[LEAD::steps], video[LEAD::steps] / 255.0,
                      flows(scene, clock[::steps], shape))


def clip_of(events: Events, edges: np.ndarray, borders: np.ndarray, flow: np.ndarray) -> Clip:
    """Event tensors as networks take them, by the events after the first edge."""
    events = events.slice(int(edges[0]), int(edges[-1]) + 1)
    parts = windows_between(events.t, edges[1:])
    tensors = [event_tensor(Events.unchecked(
        events.x[w], events.y[w], events.t[w], events.p[w], events.size), BINS) for w in parts]
    return Clip(events, edges, np.stack(tensors), borders, flow)


def flows(scene: Scene, edges_s: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The true flow of every window, (T, 2, H, W), px."""
    def window(start: Array, stop: Array) -> Array:
        return optical_flow(scene, start, stop, shape)[0]

    return np.asarray(jax.vmap(window)(jnp.asarray(edges_s[:-1]), jnp.asarray(edges_s[1:])))
