"""One sequence of a data set, as a pure function of (config, seed, number).

Textures, scene, camera, noise: everything is drawn from fold_in(key(seed), number), so a sequence
is the same whoever makes it, and in whatever order. Frames are rendered and simulated in blocks;
only those that are kept stay in memory.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.dataset.config import DatasetConfig
from evflow.dataset.sequence import EventSequence
from evflow.light.log_maps import to_log
from evflow.scenes import Scene, TextureBank, load_photos, make_bank, watch
from evflow.scenes.motion import optical_flow
from evflow.simulator import simulate_stream
from evflow.types import Events

Array = jax.Array

BLOCK_PIXELS = 32 * 346 * 260  # frames x pixels rendered at a time: 12 MB
BLOCK_FRAMES = 64
TEST_PHOTO = 4  # every fourth photograph is used only in test sequences


def make_sequence(config: DatasetConfig, seed: int, number: int) -> EventSequence:
    """Sequence `number` of the set, counting training sequences first, then test.

    Bytes are equal on machines of one kind with the same package versions; elsewhere the last bits
    of a logarithm may differ.
    """
    k_bank, k_scene, k_camera, k_events, k_noise = jax.random.split(
        jax.random.fold_in(jax.random.key(seed), number), 5)
    bank = _bank(k_bank, config, test=number >= config.train)
    scene = watch.draw_scene(k_scene, bank, config.scene, config.shape)
    film = Film(scene, config)
    nominal, camera = _draw_camera(
        *jax.random.split(k_camera), config.prior, config.shape, jnp.float32(film.light[0]))
    events = _events(k_events, film, camera, config)
    # The simulator expects rates at the first frame's mean intensity; the ground truth has those
    # at the sequence's.
    light = np.array(film.light[config.lead :])
    gain = float(watch.noise_gain(config.model, light, film.light[0]))
    video = np.stack(film.kept)
    log = np.asarray(to_log(video, config.model.log_map))
    flow, visible = _flows(scene, _instants(config)[config.lead :: config.every], config.shape)
    return EventSequence(
        events=events,
        frames=np.asarray(watch.recorded(k_noise, video, config.frame_noise_dn), np.uint8),
        frame_times=_times_us(config)[config.lead :: config.every],
        flow=np.asarray(flow), flow_visible=np.asarray(visible), changes=np.diff(log, axis=0),
        camera=_at_mean(camera, gain),
        nominal={name: float(v) for name, v in _at_mean(nominal, gain).items()})


class Film:
    """The rendered frames of a scene, played once; keeps those of the sequence, and the intensity
    factor of Eq. 12 of every frame so far (initially, of the first block)."""

    def __init__(self, scene: Scene, config: DatasetConfig) -> None:
        self.kept: list[np.ndarray] = []
        self.light: list[float] = []
        self._scene, self._config = scene, config
        blocks = self._render()
        self._blocks = itertools.chain([next(blocks)], blocks)

    def __iter__(self) -> Iterator[np.ndarray]:
        """Blocks (T, H, W) of DN."""
        return self._blocks

    def _render(self) -> Iterator[np.ndarray]:
        config, instants = self._config, _instants(self._config)
        first = -config.lead
        for block in watch.film(self._scene, instants, config.shape, block_length(config)):
            mean = block.mean((1, 2), keepdims=True, dtype=np.float64)
            self.light += watch.light(mean).tolist()
            index = np.arange(first, first + len(block))
            self.kept += list(block[(index >= 0) & (index % config.every == 0)])
            first += len(block)
            yield block


def block_length(config: DatasetConfig) -> int:
    """Frames per block."""
    return min(max(1, BLOCK_PIXELS // (config.width * config.height)), BLOCK_FRAMES)


def _times_us(config: DatasetConfig) -> np.ndarray:
    """Times of the rendered frames, int64 us: 0 is the first of the sequence."""
    count = config.lead + config.every * config.intervals + 1
    return (np.arange(count, dtype=np.int64) - config.lead) * (1_000_000 // config.render_hz)


def _instants(config: DatasetConfig) -> np.ndarray:
    """The same in seconds of the scene, whose reference time is the middle of the sequence."""
    times = _times_us(config)
    return ((times - times[-1] // 2) * 1e-6).astype(np.float32)


def _events(key: Array, film: Film, camera: Camera, config: DatasetConfig) -> Events:
    """Events from the first kept frame to just before the last."""
    times, length = _times_us(config), block_length(config)
    blocks = (times[first : first + length] for first in range(0, len(times), length))
    parts = simulate_stream(key, film, blocks, camera, model=config.model, full_scale=255)
    return Events.concatenate([part.slice(0, int(times[-1])) for part in parts])


def _at_mean(values: watch.Parameters, gain: float) -> dict[str, np.ndarray]:
    """The fields by name, noise rates times `gain`."""
    values = watch.with_noise(values, gain)
    return {f.name: np.asarray(getattr(values, f.name)) for f in dataclasses.fields(values)}


_draw_camera = jax.jit(watch.draw_camera, static_argnames=("prior", "shape"))


@functools.partial(jax.jit, static_argnames="shape")
def _flows(scene: Scene, instants: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Flow (T-1, 2, H, W) and visibility (T-1, H, W) between consecutive instants (T,)."""
    return jax.lax.map(lambda pair: optical_flow(scene, *pair, shape),
                       (instants[:-1], instants[1:]))


def _bank(key: Array, config: DatasetConfig, *, test: bool) -> TextureBank:
    """The textures of one sequence."""
    k_photos, k_draw = jax.random.split(key)
    chosen: list[np.ndarray] = []
    if config.photos:
        known = [p for i, p in enumerate(_photos()) if (i % TEST_PHOTO == 0) == test]
        picks = jax.random.randint(k_photos, (config.photos,), 0, len(known))
        chosen = [known[i] for i in picks.tolist()]
    return make_bank(
        k_draw, config.textures, chosen, config.texture_px, config.cutout_px, crops=1)


@functools.cache
def _photos() -> tuple[np.ndarray, ...]:
    return tuple(load_photos().values())
