"""A trained generator on held-out scenes: scores, picture and table."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.baselines.eventgan import GanConfig, generate
from evflow.downstream.tensor import signed
from evflow.light.log_maps import lin_log_inverse
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes import make_bank
from experiments.shared.generated import Row, Windows, compare, figures, scene_of, simulated
from experiments.shared.network_figures import HELD_OUT

Array = jax.Array
COLUMNS = ("on", "off", "empty", "correlation", "two simulations", "relative")


@dataclasses.dataclass(frozen=True)
class Scene:
    """A held-out window. frames (2, H, W) in DN at its ends; made: the generator's voxels
    (H, W, 2*bins), one, two: those of two simulations of a camera."""

    frames: Array
    made: Array
    one: Array
    two: Array


def held_out(params: dict[str, Any], config: GanConfig) -> Iterator[Scene]:
    """Scenes, textures and cameras never trained on, without end."""
    low, high = config.data.window_s
    windows = Windows(config.data.prior, math.sqrt(low * high))
    k_bank, k_data = jax.random.split(jax.random.key(HELD_OUT))
    bank = make_bank(k_bank, 48, photos=False)
    run_generator = jax.jit(generate)
    for i in itertools.count():
        k_scene, k_one, k_two = jax.random.split(jax.random.fold_in(k_data, i), 3)
        video, camera = scene_of(k_scene, bank, windows)
        one, two = (simulated(k, video, camera, windows.window_s) for k in (k_one, k_two))
        frames = lin_log_inverse(video[jnp.array([0, -1])])
        yield Scene(frames, run_generator(params, *frames), one, two)


def measure(params: dict[str, Any], config: GanConfig, scenes: int) -> dict[str, Any]:
    """Generated voxels of held-out windows against two simulations of the camera that made them,
    and the mean of all generated counts against that of all simulated."""
    total: Row = {}
    with bar("scenes") as progress:
        for i, seen in enumerate(itertools.islice(held_out(params, config), scenes)):
            everywhere = jnp.ones(seen.frames.shape[1:], bool)
            row = compare(seen.made, seen.one, seen.two, everywhere)
            total = jax.tree.map(np.add, total, row) if total else row
            progress(i + 1, scenes)
    return figures(total)


def picture(scenes: list[Scene], path: Path) -> None:
    """A column each: the second frame, ON less OFF of a simulation, and of the generator."""
    figure = plots.new_figure(1.4 * len(scenes) + 0.5, 4.4)
    axes = figure.subplots(3, len(scenes), squeeze=False)
    for line, label in zip(axes, ("frame", "simulated", "generated"), strict=True):
        line[0].set_ylabel(label)
    for column, scene in zip(axes.T, scenes, strict=True):
        simulated, generated = (np.asarray(signed(v).sum(-1)) for v in (scene.one, scene.made))
        most = max(1.0, float(np.percentile(np.abs(simulated), 99.5)))
        column[0].imshow(scene.frames[1], cmap="gray", vmin=0, vmax=255)
        for axis, events in zip(column[1:], (simulated, generated), strict=True):
            axis.imshow(events, cmap="RdBu_r", vmin=-most, vmax=most)
        for axis in column:
            axis.set_xticks([])
            axis.set_yticks([])
    plots.save_figure(figure, path)


def table(result: dict[str, Any]) -> str:
    """Markdown, one row."""
    cells = " | ".join(f"{result[name]:.3f}" for name in COLUMNS)
    return "\n".join((
        "| steps | events ON, generated / simulated | OFF | mean \\|value\\| of empty pixels | "
        "correlation with a simulation | of two simulations | ratio |",
        "|" + "---|" * 7, f"| {result['steps']} | {cells} |"))
