"""Train EventGAN (paper, Tables V and VI) on simulated windows, and measure what it makes.

    python -m experiments.train_eventgan --preset small --out runs/eventgan --max-seconds 1200

Writes checkpoints, metrics.jsonl, generator.safetensors and, on held-out scenes, eventgan.json, .md
and .png: events per polarity relative to the simulator's, |value| where two simulations of the
camera are both silent, the per-pixel correlation with a simulation beside that of two simulations,
and what they look like.
Ctrl-C (or SIGTERM) saves a checkpoint and stops; the same command goes on, bit for bit.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from evflow.baselines.eventgan import GANS, GanConfig, generate, init_state, run_step
from evflow.downstream.tensor import signed
from evflow.light.log_maps import lin_log_inverse
from evflow.network.weights import save_weights
from evflow.process.provenance import provenance
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes import make_bank
from evflow.training.config import as_dict
from evflow.training.loop import train
from evflow.training.options import RunOptions
from experiments.shared.common import at_least, run_script, write_result, write_text
from experiments.shared.generated import Row, Windows, compare, figures, scene_of, simulated

Array = jax.Array

HELD_OUT = 4_000_037  # seed of scenes, textures and cameras never trained on
COLUMNS = ("on", "off", "empty", "correlation", "two simulations", "relative")
SHOWN = 8  # scenes in the picture


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(RunOptions):
    """Train EventGAN."""

    preset: Literal["published", "small", "small paired", "debug"] = "small"
    steps: int | None = None
    """Number of steps (default: the preset's)."""
    scenes: int = 40
    """Held-out scenes to measure on."""


def main(options: Options) -> dict[str, Any]:
    """One run; returns the figures on held-out scenes."""
    at_least(1, scenes=options.scenes, steps=options.steps, save_every=options.save_every)
    plots.require()
    config = dataclasses.replace(GANS[options.preset], seed=options.seed)
    if options.steps is not None:
        config = dataclasses.replace(config, steps=options.steps)
    bank = make_bank(jax.random.fold_in(jax.random.key(config.seed), 7), config.data.textures)
    state = train(lambda: (lambda state: run_step(state, bank, config), init_state(config)),
                  config, options).completed()
    params = state.params["generator"]
    result = measure(params, config, options.scenes) | {"steps": int(state.step)}
    card = {"preset": options.preset, "steps": int(state.step), "seed": config.seed,
            "figures": result, "config": as_dict(config), **provenance()}
    save_weights(options.out / "generator.safetensors", params, card, overwrite=True)
    write_result(options.out / "eventgan.json", result, as_dict(config))
    picture(list(itertools.islice(held_out(params, config), SHOWN)), options.out / "eventgan.png")
    text = table(result)
    print(text)
    write_text(options.out / "eventgan.md", text)
    return result


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


if __name__ == "__main__":
    run_script(main, Options, __doc__)
