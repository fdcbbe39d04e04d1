"""Training sequences for the event networks, simulated on the device: scene, camera, event
tensors, target frames and flow. One pure function of (key, bank, config).

The camera is drawn from a prior, or is a measured one, with a random crop for every sequence:
training data as this camera would record them.

Time in a window is binned from border to border here, during simulation; in `event_tensor` from the
first event to the last, as for published networks. With hundreds of events in a window the two
agree to a per cent.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp

from evflow.camera import Camera, CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.checks import require
from evflow.downstream.prior import WidePrior
from evflow.downstream.tensor import BINS, normalise, signed
from evflow.errors import EvflowDataError
from evflow.scenes import Scene, TextureBank, render, sample_scene, watch
from evflow.scenes.config import SceneConfig
from evflow.scenes.motion import optical_flow
from evflow.simulator.photoreceptor import seen_log

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class SequenceConfig:
    """Training data of the networks.

    sequences: a batch; windows: T of each; steps_per_window: rendered frames in one; crop: side
    in pixels; window_s: of a window. prior, scene: as everywhere. model: the pixel circuit, its
    low-pass as `evflow simulate --camera` has it; offset_dn: light that its pixels see and its
    frames do not show, for networks that make images like its frames.
    pause, resume: probability per window that the scene stops, and that it continues (S2R: .05,
    .1). noise: std of Gaussian noise on every bin but of the first window; hot_pixels: largest
    share of pixels with a constant offset of the same std in all bins and windows.
    """

    sequences: int = 8
    windows: int = 14
    steps_per_window: int = 8
    crop: int = 48
    window_s: float = 0.03
    bins: int = BINS
    prior: CameraPrior | WidePrior = CameraPrior()
    model: SensorModel = SensorModel(eta_intensity=True)
    offset_dn: float = 0.0
    scene: SceneConfig = SceneConfig(contrast=(0.3, 1.0), static_fraction=0.0)
    pause: float = 0.05
    resume: float = 0.1
    noise: float = 0.1
    hot_pixels: float = 0.001

    def __post_init__(self) -> None:
        least = {"sequences": 1, "windows": 2, "steps_per_window": 1, "crop": 16, "bins": 2}
        for name, bound in least.items():
            require(self, name, getattr(self, name) >= bound, f">= {bound}")
        for name in ("pause", "resume", "hot_pixels"):
            require(self, name, 0 <= getattr(self, name) <= 1, "in [0, 1]")
        require(self, "window_s", self.window_s > 0, "> 0")
        require(self, "noise", self.noise >= 0, ">= 0")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sequences:
    """T windows of B sequences, time first as the networks run.

    tensors (T, B, H, W, bins): signed events of each window; noise, of the same shape: to be added
    for training. borders (T + 1, B, H, W): frames at the windows' borders, on [0, 1].
    flow (T, B, 2, H, W): (x, y) px over the window, at its start. back (T, B, 2, H, W): from its
    end to where that point was at its start; visible (T, B, H, W): it was seen there.
    """

    tensors: Array
    noise: Array
    borders: Array
    flow: Array
    back: Array
    visible: Array

    @property
    def before(self) -> Array:
        """Frames (T, B, H, W) at the windows' starts."""
        return self.borders[:-1]

    @property
    def frames(self) -> Array:
        """Frames (T, B, H, W) at the windows' ends."""
        return self.borders[1:]

    def given(self, normalised: bool) -> Array:
        """Input of a network. Noise is added after normalisation, which would else include it."""
        return (normalise(self.tensors) if normalised else self.tensors) + self.noise


def sample_sequences(
    key: Array, bank: TextureBank, config: SequenceConfig, camera: Camera | None = None
) -> Sequences:
    """A batch. camera: maps (H, W) of at least crop x crop pixels, or those of K cameras
    (K, H, W), of which each sequence has one; None draws cameras from the prior."""
    if camera is not None and min(camera.shape[-2:]) < config.crop:
        raise EvflowDataError("EV015", f"the camera has {camera.shape} pixels, the crop "
                              f"{config.crop}.", "Choose a smaller crop.")
    keys = jax.random.split(key, config.sequences)
    one = functools.partial(_sequence, bank=bank, config=config, camera=camera)
    return jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), jax.vmap(one)(keys))


def _sequence(
    key: Array, bank: TextureBank, config: SequenceConfig, camera: Camera | None
) -> Sequences:
    k_scene, k_pause, k_camera, k_sim, k_noise = jax.random.split(key, 5)
    shape = (config.crop, config.crop)
    scene = sample_scene(k_scene, bank, config.scene, shape)
    clock = scene_clock(k_pause, config)
    frames = render(scene, clock, shape)
    seen = (_draw(k_camera, config.prior, frames[0]) if camera is None
            else _crop(k_camera, camera, shape))
    tensors = _simulate(k_sim, frames, seen, config)
    edges = clock[::config.steps_per_window]
    flow, back, visible = _flows(scene, edges, shape)
    borders = frames[::config.steps_per_window] / 255.0
    return Sequences(tensors, draw_noise(k_noise, config), borders, flow, back, visible)


def scene_clock(key: Array, config: SequenceConfig) -> Array:
    """Scene time (T * steps + 1,) in s, which pauses in some windows."""
    def window(running: Array, draw: Array) -> tuple[Array, Array]:
        running = jnp.where(running, draw >= config.pause, draw < config.resume)
        return running, running

    draws = jax.random.uniform(key, (config.windows,))
    _, running = jax.lax.scan(window, jnp.array(True), draws)
    # Whole steps are added: sums of seconds would drift, also in pauses.
    steps = jnp.cumsum(jnp.repeat(running.astype(jnp.int32), config.steps_per_window))
    steps = jnp.concatenate([jnp.zeros(1, steps.dtype), steps])
    return steps.astype(jnp.float32) * (config.window_s / config.steps_per_window)


def _draw(key: Array, prior: CameraPrior | WidePrior, frame: Array) -> Camera:
    """A camera of the prior; its noise may depend on the light of the frame (H, W)."""
    height, width = frame.shape
    if isinstance(prior, WidePrior):
        return prior.sample(key, (height, width))
    k_nominal, k_pixels = jax.random.split(key)
    return watch.draw_camera(k_nominal, k_pixels, prior, (height, width), watch.light(frame))[1]


def _crop(key: Array, camera: Camera, shape: tuple[int, int]) -> Camera:
    """A random crop of a camera's maps, or of one of several cameras."""
    k_row, k_column, k_which = jax.random.split(key, 3)
    *several, rows, columns = camera.shape
    start = [jax.random.randint(k_row, (), 0, rows - shape[0] + 1),
             jax.random.randint(k_column, (), 0, columns - shape[1] + 1)]
    if several:
        start.insert(0, jax.random.randint(k_which, (), 0, several[0]))
    size = (*(1 for _ in several), *shape)
    return jax.tree.map(lambda m: jax.lax.dynamic_slice(m, start, size).reshape(shape), camera)


def _simulate(key: Array, frames: Array, camera: Camera, config: SequenceConfig) -> Array:
    """Event tensors (T, H, W, bins) of a camera that has been running for a while."""
    k_phase, k_sim = jax.random.split(key)
    dt = config.window_s / config.steps_per_window
    log_frames, circuit = seen_log(frames, dt, config.model, config.offset_dn)
    return signed(watch.voxels(
        k_sim, log_frames, camera, circuit, config.windows, dt, config.bins,
        watch.memory(k_phase, camera)))


def draw_noise(key: Array, config: SequenceConfig) -> Array:
    """Gaussian noise and hot pixels (T, H, W, bins), so that a network does not trust a single
    event."""
    k_noise, k_share, k_where, k_value = jax.random.split(key, 4)
    shape = (config.crop, config.crop)
    later = (jnp.arange(config.windows) > 0)[:, None, None, None]
    grain = later * jax.random.normal(k_noise, (config.windows, *shape, config.bins))
    share = config.hot_pixels * jax.random.uniform(k_share)
    hot = jax.random.bernoulli(k_where, share, shape)
    value = hot * jax.random.normal(k_value, shape)
    return config.noise * (grain + value[None, :, :, None])


def has_events(tensors: Array) -> Array:
    """(..., H, W) bool: pixels of tensors (..., H, W, bins) with more than a single event."""
    return jnp.abs(tensors).sum(-1) > 1.0


def _flows(scene: Scene, edges: Array, shape: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Flow of every window, forward and back, and which pixels of its end were visible at its
    start."""
    def window(ends: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        there, _ = optical_flow(scene, *ends, shape)
        return there, *optical_flow(scene, *ends[::-1], shape)

    # A loop, so that results are stored: under vmap XLA recomputes the flow wherever the loss reads
    # it, and a training step takes twice as long.
    flows: tuple[Array, Array, Array] = jax.lax.map(window, (edges[:-1], edges[1:]))
    return flows
