"""Small banks and scenes for the tests of the scenes' rooms."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from helpers.compilation import often

from evflow.scenes import (
    Layer,
    Scene,
    SceneConfig,
    TextureBank,
    Trajectory,
    make_bank,
    render,
    sample_scene,
)

SHAPE = (24, 32)
TIMES = jnp.linspace(-0.05, 0.05, 6)


@functools.cache
def bank() -> TextureBank:
    """12 procedural and 16 photographic textures, drawn once."""
    return small_bank(jax.random.key(0))


def small_bank(key: jax.Array, procedural: int = 12, photos: Any = True) -> TextureBank:
    return make_bank(key, procedural, photos, size=64, cutout_size=64, crops=1)


@functools.partial(jax.jit, static_argnames=("config", "shape"))
def _draw(keys: jax.Array, bank: TextureBank, config: SceneConfig, shape: tuple[int, int]) -> Scene:
    return jax.vmap(lambda key: sample_scene(key, bank, config, shape))(keys)


def draw(seed: int, config: SceneConfig | None = None, shape: tuple[int, int] = SHAPE) -> Scene:
    """64 scenes on a leading axis. Few configs are used: each compiles anew, a second or so."""
    return _draw(jax.random.split(jax.random.key(seed), 64), bank(), config or SceneConfig(), shape)


@functools.partial(jax.jit, static_argnames="shape", compiler_options=often())
def show(scenes: Scene, times: jax.Array, shape: tuple[int, int] = SHAPE) -> jax.Array:
    """Frames (N, T, H, W) of a batch of scenes."""
    return jax.vmap(lambda s: render(s, times, shape))(scenes)


def pair(scene: Scene, first: float = 0.0, second: float = 0.0) -> jax.Array:
    """Two frames (2, H, W) of one scene: the same program for every test."""
    return render(scene, jnp.array([first, second]), SHAPE)


def path(position: tuple[float, float], **motion: Any) -> Trajectory:
    """A trajectory at rest, but for `motion`."""
    rest = dict.fromkeys(("angle", "spin", "scale_rate", "shake_hz", "shake_phase"), 0.0)
    rest |= {"velocity": (0.0, 0.0), "shake": (0.0, 0.0)} | motion
    return Trajectory(jnp.array(position), **{k: jnp.array(v) for k, v in rest.items()})


def plain_scene(texture: jax.Array, trajectory: Trajectory, zoom: float = 1.0,
                cutout: jax.Array | None = None) -> Scene:
    """A background anchored at its texel (20, 20), and maybe one resting cut-out (2, S, S) at
    pixel (16, 12); contrast 1 and gamma 1, so that DN = 255 value."""
    one, half = jnp.float32(1.0), jnp.float32(0.5)
    back = Layer(texture[None], jnp.array([20.0, 20.0]), jnp.float32(zoom), half, one, trajectory)
    planes = jnp.zeros((2, 9, 9)) if cutout is None else cutout
    middle = jnp.full((2,), (planes.shape[-1] - 1) / 2, jnp.float32)
    fore = Layer(planes, middle, one, half, one, path((16.0, 12.0)))
    fores = jax.tree.map(lambda leaf: leaf[None], fore)
    present = jnp.array([0.0 if cutout is None else 1.0])
    return Scene(back, fores, jnp.array([planes.shape[-1] / 2]), present, one)


def square(x: float, y: float, side: float) -> list[float]:
    return [x, y, x + side, y, x + side, y + side, x, y + side]


def write_coco(folder: Path, annotations: list[dict[str, Any]]) -> Path:
    """A json of one picture of 60x40, whose bright square is 20 px wide at (10, 12)."""
    folder.mkdir(exist_ok=True)
    picture = np.random.default_rng(0).integers(0, 60, (40, 60), np.uint8)
    picture[12:32, 10:30] += 180
    cv2.imwrite(str(folder / "a.png"), picture)
    data = {"images": [{"id": 7, "file_name": "a.png", "width": 60, "height": 40}],
            "categories": [{"id": 1, "name": "square"}],
            "annotations": [{"id": i, "image_id": 7, "category_id": 1, "area": 400, **a}
                            for i, a in enumerate(annotations)]}
    path = folder / "a.json"
    path.write_text(json.dumps(data))
    return path
