"""Training sequences for the event networks, simulated on the device: scene, camera, event
tensors, target frames and flow. One pure function of (key, bank, config).

The camera is drawn from a prior, or is a measured one, of which every sequence sees a random
crop: training data as that very camera would have recorded them.

Time in a window runs from border to border here, as it is binned while it is simulated; of a
recording (`event_tensor`) from its first event to its last, as published networks have it. Where
a window holds hundreds of events the two are the same to a per cent.
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
from evflow.light.log_maps import lin_log
from evflow.scenes import Scene, TextureBank, render, sample_scene, watch
from evflow.scenes.config import SceneConfig
from evflow.scenes.motion import optical_flow

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class SequenceConfig:
    """What the networks are trained on.

    sequences: a batch; windows: T of each; steps_per_window: rendered frames in one; crop: side
    in pixels; window_s: of a window. prior, model, scene: as everywhere.
    pause, resume: chance a window that the scene stops, and that it goes on (S2R: .05, .1).
    noise: deviation of Gaussian noise on every bin but of the first window; hot_pixels: at most
    this share of pixels carries, in all bins and windows, a constant of the same deviation.
    """

    sequences: int = 8
    windows: int = 14
    steps_per_window: int = 8
    crop: int = 48
    window_s: float = 0.03
    bins: int = BINS
    prior: CameraPrior | WidePrior = CameraPrior()
    model: SensorModel = SensorModel(eta_intensity=True)
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

    tensors (T, B, H, W, bins): signed events of each window; noise, of the same shape: what is
    put on them for training. borders (T + 1, B, H, W): frames at the windows' borders, on [0, 1].
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
        """What a network gets: the noise goes on top of normalised events, as it would else be
        taken for events and measured with them."""
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
    """Scene time (T * steps + 1,) in s: it stands still in some windows, as the world does."""
    def window(running: Array, draw: Array) -> tuple[Array, Array]:
        running = jnp.where(running, draw >= config.pause, draw < config.resume)
        return running, running

    draws = jax.random.uniform(key, (config.windows,))
    _, running = jax.lax.scan(window, jnp.array(True), draws)
    # Whole steps are added: a sum of seconds would drift, and never quite stand still.
    steps = jnp.cumsum(jnp.repeat(running.astype(jnp.int32), config.steps_per_window))
    steps = jnp.concatenate([jnp.zeros(1, steps.dtype), steps])
    return steps.astype(jnp.float32) * (config.window_s / config.steps_per_window)


def _draw(key: Array, prior: CameraPrior | WidePrior, frame: Array) -> Camera:
    """A camera of the prior that looks at the frame (H, W), by whose light its noise may go."""
    height, width = frame.shape
    if isinstance(prior, WidePrior):
        return prior.sample(key, (height, width))
    k_nominal, k_pixels = jax.random.split(key)
    return watch.draw_camera(k_nominal, k_pixels, prior, (height, width), watch.light(frame))[1]


def _crop(key: Array, camera: Camera, shape: tuple[int, int]) -> Camera:
    """A random part of a camera's maps, or of one of several cameras'."""
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
    return signed(watch.voxels(
        k_sim, lin_log(frames), camera, config.model, config.windows, dt, config.bins,
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
    """Where (..., H, W) the tensors (..., H, W, bins) hold more than what a lone event leaves."""
    return jnp.abs(tensors).sum(-1) > 1.0


def _flows(scene: Scene, edges: Array, shape: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Flow of every window forward and back, and what of its end was visible at its start."""
    def window(ends: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        there, _ = optical_flow(scene, *ends, shape)
        return there, *optical_flow(scene, *ends[::-1], shape)

    # A loop, whose results are kept: under vmap XLA works the flow out again wherever the loss
    # reads it, and a training step takes twice as long.
    flows: tuple[Array, Array, Array] = jax.lax.map(window, (edges[:-1], edges[1:]))
    return flows
