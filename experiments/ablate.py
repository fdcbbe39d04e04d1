"""Ablations at equal budget: losses (Table VIII), flow steps (Fig. 14), the paper's network.

    python -m experiments.ablate losses --preset full --rows rows.json
    python -m experiments.ablate steps --preset full --rows steps.json
    python -m experiments.ablate networks --preset full --rows networks.json

Nothing of the camera is handed over: the paper's network sees one pixel's window, ours (in
`networks`) what it makes of the window itself. Cameras, scenes and noise are the paper's (Eq. 12).
Each variant has the learning rate, of RATES, at which it is best with a seed and held-out cameras
of their own; then all are trained with the same seeds on the same scenes, and scored on cameras
that neither saw. The table states how large a difference to the first variant so many seeds show.

Weights of the first seed are kept beside the table: `see_better --estimators` asks what networks
see that are trained on what they estimate (Tables VII and IX).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro

from evflow.network.config import ModelConfig
from evflow.process.devices import compiled_quickly
from evflow.report import plots
from evflow.scenes import make_bank
from evflow.training.config import PARTS, PRESETS, LossConfig, TrainConfig
from experiments.shared import variants
from experiments.shared.common import at_least, begin, conclude, markdown, run_script, slug
from experiments.shared.images import mean_ci
from experiments.shared.kept import resumed
from experiments.shared.variants import NAMES, Row

Study = Literal["losses", "steps", "networks"]
FLOW_STEPS = (8, 12, 16, 20, 24)
RATES = (0.3, 1.0, 3.0)  # times the preset's, 1e-3 (flow 5e-4)
TUNED, TUNING, HELD = 7_000_029, 8_100_037, 8_000_009  # seeds: tuning's own, its cameras, the score
CONSTANT = "constant"
HEADS = ("variant", "theta, sequence", "paper", "eta, sequence", "paper", "theta, pixel",
         "to the first, theta", "shows from", "events made / true", "log p(z) + log det", "rate",
         "seconds")
PAPER = {  # Table VIII: theta_on, theta_off, eta_on, eta_off
    "L_P": (0.074, 0.064, 0.038, 0.046), "L_P + L_F + L_F'": (0.055, 0.075, 0.037, 0.054),
    "L_P + L_E": (0.037, 0.073, 0.054, 0.048),
    "L_P + L_F + L_F' + L_E": (0.032, 0.046, 0.066, 0.065),
    "the same, weights adapted": (0.018, 0.024, 0.045, 0.027)}


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


def base_config(steps: int, small: bool) -> TrainConfig:
    """The paper's network and cameras, in crops that a core trains eight times as fast."""
    config = dataclasses.replace(
        PRESETS["paper"], crop=32, block=(8, 8), scenes=2 if small else 8, cameras=2, steps=steps,
        warmup=min(100, steps // 5), textures=16 if small else 192)
    if not small:
        return config
    flow = dataclasses.replace(config.model.flow, steps=2)
    return dataclasses.replace(config, model=dataclasses.replace(config.model, flow=flow),
                               steps_per_window=16)


def chosen(study: Study, base: TrainConfig) -> dict[str, TrainConfig]:
    """Training configurations by name, the one that the others are compared to first."""
    def losses(**changes: Any) -> TrainConfig:
        return dataclasses.replace(base, loss=dataclasses.replace(base.loss, **changes))

    def steps(k: int) -> TrainConfig:
        return dataclasses.replace(base, model=dataclasses.replace(
            base.model, flow=dataclasses.replace(base.model.flow, steps=k)))

    if study == "losses":
        plain = {"adaptive": False}
        return {"L_P": losses(flow=0.0, inverse_flow=0.0, event=0.0, **plain),
                "L_P + L_F": losses(inverse_flow=0.0, event=0.0, **plain),
                "L_P + L_F + L_F'": losses(event=0.0, **plain),
                "L_P + L_E": losses(flow=0.0, inverse_flow=0.0, **plain),
                "L_P + L_F + L_F' + L_E": losses(**plain),
                "the same, weights adapted": base}
    if study == "steps":
        return {f"{k} steps": steps(k) for k in FLOW_STEPS}
    ours = ModelConfig()
    ours = dataclasses.replace(ours, flow=dataclasses.replace(
        ours.flow, steps=base.model.flow.steps))
    return {"paper": base, "default": dataclasses.replace(
        base, model=ours, loss=LossConfig(), parts=PARTS)}


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

    rates = RATES[1:2] if options.preset == "debug" else RATES
    tuned = rows([(TUNED + options.seed, rate) for rate in rates], TUNING)
    rate = rates[int(np.argmin([sum(loss(row)) for row in tuned]))]
    return {"rate": rate, "seeds": rows([(seed, rate) for seed in seeds], HELD)}


def loss(row: Row) -> list[float]:
    """What a rate is chosen by: errors of the sequence; one that diverged is never chosen."""
    return [np.nan_to_num(row[f"sequence/{name}"], nan=np.inf) for name in NAMES]


def theta(row: Row) -> float:
    """Mean of the two thresholds' errors."""
    return float(np.mean([row["sequence/theta_on"], row["sequence/theta_off"]]))


def table(result: dict[str, Row], steps: int) -> str:
    """ON / OFF means over seeds, the paper's figures beside ours; "shows from": the half-width of
    the difference's 95 % interval."""
    def pair(rows: list[Row], kind: str, parameter: str) -> str:
        return " / ".join(f"{np.mean([r[f'{kind}/{parameter}_{p}'] for r in rows]):.3f}"
                          for p in ("on", "off"))

    first = next(name for name in result if name != CONSTANT)
    cells = []
    for name, found in result.items():
        rows = [found] if name == CONSTANT else found["seeds"]
        on, off, eta_on, eta_off = PAPER.get(name, (np.nan,) * 4)
        more = [""] * 6
        if name != CONSTANT:
            apart, wide = mean_ci(np.array([theta(a) - theta(b) for a, b in zip(
                rows, result[first]["seeds"], strict=True)]))
            more = [*(["", ""] if name == first else [f"{apart:+.4f}", f"{wide:.4f}"]),
                    f"{np.median([r['events'] for r in rows]):.3g}",
                    f"{np.mean([r['log p(z)'] for r in rows]):.1f}", f"{found['rate']:g}",
                    f"{np.mean([r['seconds'] for r in rows]):.0f}"]
        cells.append([name, pair(rows, "sequence", "theta"), f"{on:.3f} / {off:.3f}",
                      pair(rows, "sequence", "eta"), f"{eta_on:.3f} / {eta_off:.3f}",
                      pair(rows, "pixel", "theta"), *more])
    text = f"{steps} training steps each.\n\n" + markdown(HEADS, cells)
    return text.replace("nan / nan", "")


def draw(result: dict[str, Row], path: Path) -> None:
    """Errors of every seed, the constant's as a line (Fig. 14, of thresholds and noise)."""
    figure = plots.new_figure(8, 3.2)
    names = [name for name in result if name != CONSTANT]
    for k, (parameter, letter) in enumerate((("theta", "θ"), ("eta", "η")), 1):
        axis = figure.add_subplot(1, 2, k)
        for side, marker in (("on", "o"), ("off", "s")):
            at = f"sequence/{parameter}_{side}"
            points = [(i, row[at]) for i, name in enumerate(names)
                      for row in result[name]["seeds"]]
            line, = axis.plot(*zip(*points, strict=True), marker, markersize=4,
                              label=side.upper())
            axis.axhline(result[CONSTANT][at], color=line.get_color(), linestyle=":")
        axis.set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=7)
        axis.set(ylim=(0, None), ylabel=f"|{letter} − of the sequence|")
        axis.legend(frameon=False, fontsize=8, title="dotted: constant", title_fontsize=7)
    plots.save_figure(figure, path)


if __name__ == "__main__":
    run_script(main, Options, __doc__)
