"""Ablations at equal budget: losses (Table VIII), flow steps (Fig. 14), the paper's network.

    python -m experiments.ablate losses --preset full --rows rows.json
    python -m experiments.ablate steps --preset full --rows steps.json
    python -m experiments.ablate networks --preset full --rows networks.json

Nothing of the camera is handed over: the paper's network sees one pixel's window, ours (in
`networks`) its own estimate from the window. Cameras, scenes and noise are the paper's (Eq. 12).
Each variant has the learning rate, of `variants.RATES`, at which it is best with a seed and
held-out cameras of their own: the middle three are tried, then the next one as long as it is
better. Then all are trained with the same seeds on the same scenes, and scored on cameras that
neither saw. The table states how large a difference to the first variant so many seeds show.

Weights of the first seed are kept beside the table: `see_better --estimators` asks what networks
see that are trained on what they estimate (Tables VII and IX).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import tyro

from evflow.process.devices import compiled_quickly
from evflow.scenes import make_bank
from evflow.training.config import TrainConfig
from experiments.shared import variants
from experiments.shared.ablate_pages import CONSTANT, draw, table
from experiments.shared.ablated import Study, base_config, chosen
from experiments.shared.common import at_least, begin, conclude, run_script, slug
from experiments.shared.kept import resumed
from experiments.shared.variants import Row

TUNED, TUNING, HELD = 7_000_029, 8_100_037, 8_000_009  # seeds: tuning's own, its cameras, the score


@dataclasses.dataclass(frozen=True)
class Options:
    """Train variants at equal budget and compare them."""

    study: tyro.conf.Positional[Study]
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/ablate")
    seed: int = 0
    seeds: int | None = None
    """Trainings of each variant (default: the preset's)."""
    steps: int | None = None
    """Training steps of each (default: the preset's)."""
    batches: int = 20
    """Held-out batches to score on."""
    rows: Path | None = None
    """Where scores are kept, to go on from when interrupted."""


def main(options: Options) -> dict[str, Any]:
    """Tune, train and score the variants; returns the figures of each."""
    at_least(1, seeds=options.seeds, steps=options.steps)
    options = dataclasses.replace(options, out=options.out / options.study)
    begin(options, "ablate")
    small = options.preset == "debug"
    base = base_config(options.steps or (4 if small else 600), small)
    names = chosen(options.study, base)
    if small:
        names = dict(list(names.items())[-2:])
    k_train, k_held = jax.random.split(jax.random.key(options.seed + 9_000_011))
    banks = make_bank(k_train, base.textures), make_bank(k_held, base.textures, photos=False)
    seeds = range(options.seed, options.seed + (options.seeds or (1 if small else 3)))
    with compiled_quickly(small):
        result = {CONSTANT: variants.constant_row(base, *banks, (TUNING, HELD), options.batches)}
        for name, config in names.items():
            result[name] = compared(name, config, banks, list(seeds), options)
    conclude(options, "ablate", result, table(result, base.steps))
    draw(result, options.out / "ablate.png")
    return result


def compared(name: str, config: TrainConfig, banks: Any, seeds: list[int], options: Options) -> Row:
    """A variant's rate, and its scores by seed at that rate."""
    trainer = variants.Trainer(config, banks[0])
    errors = variants.make_errors(config, banks[1])

    def rows(jobs: list[tuple[int, float]], held: int) -> list[Row]:
        def made(left: list[int]) -> Iterator[Row]:
            for seed, rate in (jobs[i] for i in left):
                params, seconds = trainer.trained(seed, rate)
                net, = params.values()
                yield variants.score(errors, net, held, options.batches) | {"seconds": seconds}
                if seed == seeds[0]:
                    variants.save_estimator(
                        options.out / f"{slug(name)}.safetensors", params, config)

        of = [options.study, options.seed, config.steps, options.batches, options.preset]
        return resumed(options.rows, of, [f"{name}, seed {s}, rate {r:g}" for s, r in jobs], made,
                       name)

    def tuned(rate: float) -> float:
        row, = rows([(TUNED + options.seed, rate)], TUNING)
        return variants.error_of(row)

    rate = 1.0 if options.preset == "debug" else variants.best_rate(tuned)
    found = rows([(seed, rate) for seed in seeds], HELD)
    if not (weights := options.out / f"{slug(name)}.safetensors").exists():
        print(f"{weights} is not written: its scores are those kept in {options.rows}")
    return {"rate": rate, "seeds": found}


if __name__ == "__main__":
    run_script(main, Options, __doc__)
