"""Train EventGAN (paper, Tables V and VI) on simulated windows, and score the events it generates.

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
from typing import Any, Literal

import jax

from evflow.baselines.eventgan import GANS, init_state, run_step
from evflow.network.weights import save_weights
from evflow.process.provenance import provenance
from evflow.report import plots
from evflow.scenes import make_bank
from evflow.training.config import as_dict
from evflow.training.loop import train
from evflow.training.options import RunOptions
from experiments.shared.common import at_least, run_script, write_result, write_text
from experiments.shared.eventgan_scores import held_out, measure, picture, table

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
    write_result(options.out / "eventgan.json", result,
                 as_dict(config) | {"scenes": options.scenes})
    picture(list(itertools.islice(held_out(params, config), SHOWN)), options.out / "eventgan.png")
    text = table(result)
    print(text)
    write_text(options.out / "eventgan.md", text)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)
