"""Ablations at equal budget: losses (Table VIII), flow steps (Fig. 14), the paper's network.

    python -m experiments.ablate losses --preset full
    python -m experiments.ablate steps --preset full
    python -m experiments.ablate networks --preset full

Every variant trains its per-pixel parts on the same scenes, from the same seed, for the same
number of steps; the camera's summary is given (the true one and a little noise), as it is not the
subject. Scored on held-out cameras: the map against the sequence's value (the paper's measure) and
against each pixel's own, the events that the inverse direction makes relative to the simulator's,
and the likelihood of events (in nats, of the flow, where it has one).

Each variant's weights, with the released summary, are kept beside the table: `see_better
--estimators` asks what networks see that are trained on what they estimate (Tables VII and IX).
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from evflow.network import architecture, flow
from evflow.network.coordinates import squash, unsquash_summary
from evflow.network.weights import load_weights, save_weights
from evflow.process.devices import compiled_quickly
from evflow.process.provenance import provenance
from evflow.process.terminal import bar
from evflow.scenes import TextureBank, make_bank
from evflow.training.batch import sample_batch
from evflow.training.config import PRESETS, TrainConfig, as_dict
from evflow.training.objective import cut_block
from evflow.training.step import init_state, make_run_step, optimiser
from experiments.shared.common import (
    begin,
    run_script,
    slug,
    write_result,
    write_text,
)

Array = jax.Array
Study = Literal["losses", "steps", "networks"]
NAMES = ("theta_on", "theta_off", "eta_on", "eta_off")
FLOW_STEPS = (8, 12, 16, 20, 24)
PAPER = {  # Table VIII: theta_on, theta_off, eta_on, eta_off
    "L_P": (0.074, 0.064, 0.038, 0.046), "L_P + L_F": (0.055, 0.075, 0.037, 0.054),
    "L_P + L_E": (0.037, 0.073, 0.054, 0.048), "L_P + L_F + L_E": (0.032, 0.046, 0.066, 0.065),
    "the same, weights adapted": (0.018, 0.024, 0.045, 0.027)}


@dataclasses.dataclass(frozen=True)
class Options:
    """Train variants at equal budget and compare them."""

    study: tyro.conf.Positional[Study]
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/ablate")
    seed: int = 0
    steps: int | None = None
    """Training steps of each variant (default: the preset's)."""
    batches: int = 20
    """Held-out batches to score on."""


def variants(study: Study, base: TrainConfig) -> dict[str, TrainConfig]:
    """Training configurations by name."""
    def losses(**changes: Any) -> TrainConfig:
        return dataclasses.replace(base, loss=dataclasses.replace(base.loss, **changes))

    def steps(k: int) -> TrainConfig:
        return dataclasses.replace(base, model=dataclasses.replace(
            base.model, flow=dataclasses.replace(base.model.flow, steps=k)))

    if study == "losses":
        return {"L_P": losses(flow=0.0, event=0.0, adaptive=False),
                "L_P + L_F": losses(event=0.0, adaptive=False),
                "L_P + L_E": losses(flow=0.0, adaptive=False),
                "L_P + L_F + L_E": losses(adaptive=False),
                "the same, weights adapted": base}
    if study == "steps":
        return {f"{k} steps": steps(k) for k in FLOW_STEPS}
    paper = PRESETS["paper"]
    return {"default": base, "paper": dataclasses.replace(
        base, model=paper.model, loss=paper.loss, learning_rate=paper.learning_rate,
        flow_rate=paper.flow_rate)}


def train(config: TrainConfig, bank: TextureBank, title: str) -> tuple[dict[str, Any], float]:
    """Averaged parameters after config.steps, and the seconds that took, compilation aside."""
    tx = optimiser(config)
    name = "paper" if config.model.code == "feature" else "default"
    state = init_state(config, tx, bank, name)
    step = jax.jit(make_run_step(config, tx), donate_argnums=0)
    started = time.monotonic()
    with bar(title) as progress:
        for i in range(config.steps):
            state, metrics = step(state, bank)
            if i % 20 == 0:
                jax.block_until_ready(metrics)
            if i == 0:
                started = time.monotonic()
            progress(i + 1, config.steps)
    jax.block_until_ready(state.step)
    return state.average, time.monotonic() - started


def score(
    params: dict[str, Any], config: TrainConfig, bank: TextureBank, options: Options
) -> dict[str, float]:
    """Errors on held-out cameras."""
    net = next(iter(params.values()))
    model = config.model

    @jax.jit
    def errors(key: Array) -> dict[str, Array]:
        k_batch, k_block, k_noise, k_z = jax.random.split(key, 4)
        batch = sample_batch(k_batch, bank, config)
        block = cut_block(k_block, batch, config)
        known = unsquash_summary(batch.nominal)
        noise = config.summary_noise * jax.random.normal(k_noise, known.shape)
        y6 = architecture.over_pixels(known + noise, block.dlogI.shape)
        changes, _ = architecture.encode_changes(
            model, net, block.voxels, block.dlogI, block.context, y6)
        u = architecture.condition(model, changes, block.context, y6)
        centre = architecture.centre(model, y6)
        y, z, log_det = flow.forward(net["flow"], block.voxels, u, model.flow)
        made, _ = flow.inverse(net["flow"], block.y - centre, jax.random.normal(k_z, z.shape), u,
                               model.flow)
        seen, true = squash(y + centre, model.output), squash(block.y, model.output)
        fired = block.voxels.sum(-1) > 0
        likelihood = architecture.log_normal(z, 0.0, jnp.ones(())).sum(-1) + log_det
        found = {"events": made.sum() / block.voxels.sum(), "log p(z)": likelihood.mean()}
        for name in NAMES:
            off = jnp.abs(getattr(seen, name) - getattr(true, name))
            from_sequence = jnp.abs(
                getattr(seen, name) - getattr(batch.nominal, name)[:, None, None])
            found |= {f"pixel/{name}": off.mean(), f"sequence/{name}": from_sequence.mean(),
                      f"fired/{name}": (off * fired).sum() / fired.sum()}
        return found

    keys = jax.random.split(jax.random.key(options.seed + 8_000_009), options.batches)
    rows = [jax.device_get(errors(key)) for key in keys]
    return {k: float(np.median([r[k] for r in rows]) if k == "events" else
                     np.mean([r[k] for r in rows])) for k in rows[0]}


def main(options: Options) -> dict[str, Any]:
    """Train and score the variants; returns the figures of each."""
    begin(dataclasses.replace(options, out=options.out / options.study), "ablate")
    small = options.preset == "debug"
    base = dataclasses.replace(
        PRESETS["pixels"], seed=options.seed, steps=options.steps or (4 if small else 400))
    if small:
        base = dataclasses.replace(base, scenes=2, textures=16)
    chosen = variants(options.study, base)
    if small:
        chosen = dict(list(chosen.items())[-2:])
    k_train, k_held = jax.random.split(jax.random.key(options.seed + 9_000_011))
    bank = make_bank(k_train, base.textures)
    held = make_bank(k_held, base.textures, photos=False)
    out = options.out / options.study
    result: dict[str, Any] = {}
    for name, config in chosen.items():
        with compiled_quickly(small):
            params, seconds = train(config, bank, name)
            result[name] = {**score(params, config, held, options), "seconds": seconds}
        save_estimator(out / f"{slug(name)}.safetensors", params, config)
    text = table(result, base.steps)
    print(text)
    write_result(out / "ablate.json", result, dataclasses.asdict(options))
    write_text(out / "ablate.md", text)
    return result


def save_estimator(path: Path, params: dict[str, Any], config: TrainConfig) -> None:
    """Keep a variant as weights that estimate: its own summary was never trained."""
    (name, net), = params.items()
    if config.model.pool:
        net = net | {"summary": load_weights()["default"]["summary"]}
    save_weights(path, {name: net}, {"config": as_dict(config), **provenance()}, overwrite=True)


def table(result: dict[str, Any], steps: int) -> str:
    """Markdown: theta_on / theta_off, then eta_on / eta_off, the paper's figures beside ours."""
    def pair(row: dict[str, float], kind: str, parameter: str) -> str:
        return " / ".join(f"{row[f'{kind}/{parameter}_{p}']:.3f}" for p in ("on", "off"))

    lines = [f"{steps} training steps each.", "",
             "| variant | theta, sequence | paper | eta, sequence | paper | theta, pixel | theta, "
             "pixels that fired | events made / true | log p(z) + log det | seconds |",
             "|" + "---|" * 10]
    for name, row in result.items():
        on, off, eta_on, eta_off = PAPER.get(name, (np.nan,) * 4)
        lines.append(
            f"| {name} | {pair(row, 'sequence', 'theta')} | {on:.3f} / {off:.3f} | "
            f"{pair(row, 'sequence', 'eta')} | {eta_on:.3f} / {eta_off:.3f} | "
            f"{pair(row, 'pixel', 'theta')} | {pair(row, 'fired', 'theta')} | "
            f"{row['events']:.3g} | {row['log p(z)']:.1f} | {row['seconds']:.0f} |")
    return "\n".join(lines).replace("nan / nan", "–")


if __name__ == "__main__":
    run_script(main, Options, __doc__)
