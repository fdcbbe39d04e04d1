"""Accuracy of the weights on held-out simulated cameras, beside the constant prior.

    python -m experiments.evaluate --preset debug
    python -m experiments.evaluate --preset full

Protocol: 64x64 pixels, 200 ms rendered at 960 fps, procedural textures never trained on, windows
of 50 ms between 8-bit frames, θ ~ U(.1, .5) per polarity, noise by Eq. 12. Scored is the camera's
summary (|summary - θ|) over sequences with at least 200 events of the polarity; `mae_sequence` is
the paper's footnote 1 (map against the sequence's value), `mae_pixel` the map against each
pixel's own value. The paper reports .023 / .022 (θ) and .045 / .027 (η, Table VIII).
"""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from evflow import estimate, finish, load_weights, summarize
from evflow.batch import Batch, sample_batch
from evflow.camera import CameraPrior, SensorModel
from evflow.config import TrainConfig
from evflow.progress import bar
from evflow.scenes import make_bank
from experiments.common import write_result

NAMES = ("theta_on", "theta_off", "eta_on", "eta_off")
PAPER = {"theta_on": 0.023, "theta_off": 0.022, "eta_on": 0.045, "eta_off": 0.027}
CONSTANT = {"theta_on": 0.3, "theta_off": 0.3, "eta_on": 0.114, "eta_off": 0.114}
ENOUGH = 200  # events of a polarity


@dataclasses.dataclass(frozen=True)
class Options:
    """Evaluate weights on held-out simulated cameras."""

    weights: str = "default"
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/evaluate")
    seed: int = 1_000_003
    """Far from any training seed: other textures, scenes and cameras."""


def protocol(mismatch: float) -> TrainConfig:
    """8 sequences a batch, each four windows of 50 ms rendered in 48 steps (960 fps)."""
    return TrainConfig(
        prior=CameraPrior(mismatch=(mismatch, mismatch)),
        sensors=(SensorModel(eta_intensity=True),),
        scenes=8, cameras=1, windows=4, window_s=(0.05, 0.05), steps_per_window=48)


def score(params: Any, batch: Batch) -> dict[str, np.ndarray]:
    """Errors of each sequence, each (B,)."""
    count, windows = batch.dlogI.shape[:2]
    window_s = jnp.broadcast_to(batch.window_s[:, None], (count, windows))
    stats = summarize(params, batch.voxels, batch.dlogI, window_s=window_s,
                      intensity=batch.intensity)
    pooled = jax.tree.map(lambda a: a.sum(1), stats)
    seen, std = finish(params, pooled)
    known = jax.tree.map(lambda a: a[:, None], seen)
    maps = estimate(params, batch.voxels, batch.dlogI, window_s=window_s,
                    intensity=batch.intensity, summary=known)
    errors = {"events_on": pooled.events_on, "events_off": pooled.events_off}
    for name in NAMES:
        true, pixels = getattr(batch.nominal, name), getattr(batch.camera, name)
        guess, found = getattr(seen, name), getattr(maps, name)
        errors |= {
            f"summary/{name}": jnp.abs(guess - true),
            f"inside/{name}": (jnp.abs(guess - true) < getattr(std, name)).astype(jnp.float32),
            f"constant/{name}": jnp.abs(CONSTANT[name] - true),
            f"mae_sequence/{name}": jnp.abs(found - true[:, None, None, None]).mean((1, 2, 3)),
            f"mae_pixel/{name}": jnp.abs(found - pixels[:, None]).mean((1, 2, 3)),
            f"constant_truth/{name}": jnp.abs(true[:, None, None] - pixels).mean((1, 2)),
        }
    return {k: np.asarray(v) for k, v in errors.items()}


def evaluate(params: Any, mismatch: float, sequences: int, seed: int) -> dict[str, Any]:
    """Mean errors over the sequences with enough events, per parameter."""
    config = protocol(mismatch)
    k_bank, k_data = jax.random.split(jax.random.key(seed))
    bank = make_bank(k_bank, 96, photos=False)
    sample = jax.jit(partial(sample_batch, bank=bank, config=config))
    batches = -(-sequences // config.scenes)
    parts = []
    with bar(f"mismatch {mismatch}") as progress:
        for i in range(batches):
            parts.append(score(params, sample(jax.random.fold_in(k_data, i))))
            progress(i + 1, batches)
    errors = {k: np.concatenate([p[k] for p in parts])[:sequences] for k in parts[0]}
    result: dict[str, Any] = {}
    for name in NAMES:
        polarity = name.split("_")[1]
        used = errors[f"events_{polarity}"] >= ENOUGH
        result[name] = {"sequences": int(used.sum())}
        for key in ("summary", "constant", "inside", "mae_sequence", "mae_pixel",
                    "constant_truth"):
            result[name][key] = float(errors[f"{key}/{name}"][used].mean())
        spread = errors[f"summary/{name}"][used].std() / np.sqrt(max(1, used.sum()))
        result[name]["summary_ci95"] = float(1.96 * spread)
    return result


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown: ours beside the constant prior and the paper."""
    lines = ["| mismatch | parameter | sequences | \\|summary - true\\| | constant prior | paper "
             "| mae_sequence | mae_pixel | constant truth | within 1 std |", "|" + "---|" * 10]
    for preset, rows in results.items():
        for name, r in rows.items():
            lines.append(
                f"| {preset} | {name} | {r['sequences']} | {r['summary']:.4f} ± "
                f"{r['summary_ci95']:.4f} | {r['constant']:.4f} | {PAPER[name]:.3f} | "
                f"{r['mae_sequence']:.4f} | {r['mae_pixel']:.4f} | {r['constant_truth']:.4f} | "
                f"{r['inside']:.0%} |")
    return "\n".join(lines)


def main(options: Options) -> dict[str, dict[str, Any]]:
    params = load_weights(options.weights)
    sequences = {"debug": 16, "full": 320}[options.preset]
    results = {f"{m:.2f}": evaluate(params, m, sequences, options.seed) for m in (0.03, 0.15)}
    text = table(results)
    print(text)
    write_result(options.out / "evaluate.json", results, dataclasses.asdict(options))
    (options.out / "evaluate.md").write_text(text + "\n")
    return results


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
