"""The inverse direction against the simulator (paper, Fig. 16): the same scenes and cameras.

    python -m experiments.generate --preset full --out out/generate

A code is made from the video alone; events are generated for the camera, for cameras with
thresholds halved and doubled (both polarities, ON or OFF alone), and for cameras in which the
thresholds of single pixels change while the summary stays. Reported per variant: events per
polarity relative to the simulator's, |value| where neither of two simulations fires, and the
per-pixel correlation with a simulation relative to that between two of them. The simulated cameras
have been running, but for the last rows: pixels whose memory is at the window's first frame, as at
the start of a simulation, which the inverse direction does not know of. `auroc`: how well
`log_prob` at the true code (the video and the camera's summary) tells events of a camera within
the prior, N(summary, mismatch), from those of one whose thresholds are doubled or halved, scene by
scene: how often it is higher, and how often it is nearer to its mean over a few more simulations
at the code. As of any density of sparse data, fewer events are likelier ones, so that only the
second, a test of typicality (Nalisnick et al. 2019), can tell doubled thresholds.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from evflow import code_from_video, generate, load_weights, log_prob
from evflow.camera import CameraPrior
from evflow.network.api import Params
from evflow.process.terminal import bar
from evflow.scenes import TextureBank, make_bank
from experiments.shared.common import at_least, begin, conclude, run_script
from experiments.shared.generated import Row, Windows, compare, figures, scene_of, simulated
from experiments.shared.generated_cameras import CHANGED, variants
from experiments.shared.generated_pages import separation, table

Array = jax.Array

LEAST_S, LEAST_SIDE = 1e-3, 16  # of a window
REFERENCES = 4  # simulations whose mean log_prob is taken as typical


@dataclasses.dataclass(frozen=True)
class Options:
    """Compare generated with simulated events."""

    weights: str = "default"
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/generate")
    seed: int = 4_000_037
    scenes: int | None = None
    """Number of scenes (default: the preset's)."""
    prior: CameraPrior = CameraPrior(theta=(0.12, 0.3))
    """Halved and doubled, its thresholds stay inside those of the training."""
    window_s: float = 0.05
    shape: tuple[int, int] = (64, 64)


def compared(
    params: Params, key: Array, bank: TextureBank, options: Options
) -> tuple[dict[str, Row], dict[str, list[float]]]:
    """Of one scene: the sums of every variant, and log_prob of simulations at the true code."""
    k_scene, k_pixels, k_made, k_one, k_two, k_typical = jax.random.split(key, 6)
    frames, camera = scene_of(
        k_scene, bank, Windows(options.prior, options.window_s, options.shape))
    changes = jnp.moveaxis(jnp.diff(frames[::4], axis=0), 0, -1)
    code = code_from_video(params, changes, camera, window_s=options.window_s,
                           intensity=0.5 * (frames[0] + frames[-1]))

    def likely(*seen: Array) -> list[float]:
        return [float(log_prob(params, voxels, code).mean()) for voxels in seen]

    rows = {}
    typical = likely(*(simulated(k, frames, camera, options.window_s)
                       for k in jax.random.split(k_typical, REFERENCES)))
    scores = {"reference": [float(np.mean(typical))]}
    for name, (other, where) in variants(k_pixels, camera).items():
        one, two = (simulated(k, frames, other, options.window_s) for k in (k_one, k_two))
        # Single pixels leave the medians alone, so that both give the same summary.
        made = generate(params, k_made, other, code)
        rows[name] = compare(made, one, two, where)
        if name in ("as it is", *CHANGED):
            scores[name] = likely(one, two)
            one, two = (simulated(k, frames, other, options.window_s, 0.0) for k in (k_one, k_two))
            rows[f"{name}, from the first frame"] = compare(made, one, two, where)
    return rows, scores


def main(options: Options) -> dict[str, Any]:
    begin(options, "generate")
    at_least(LEAST_S, window_s=options.window_s)
    at_least(LEAST_SIDE, shape=min(options.shape))
    params = load_weights(options.weights)
    scenes = options.scenes or {"debug": 4, "full": 100}[options.preset]
    k_bank, k_data = jax.random.split(jax.random.key(options.seed))
    bank = make_bank(k_bank, 96, photos=False)
    found = []
    with bar("scenes") as progress:
        for i in range(scenes):
            found.append(compared(params, jax.random.fold_in(k_data, i), bank, options))
            progress(i + 1, scenes)
    rows, scores = zip(*found, strict=True)
    names = sorted(rows[0], key=lambda name: "first frame" in name)  # these last
    result: dict[str, Any] = {name: figures(jax.tree.map(
        lambda *sums: np.sum(sums, 0), *(row[name] for row in rows))) for name in names}
    result["auroc"] = separation({name: np.array([s[name] for s in scores]) for name in scores[0]})
    conclude(options, "generate", result, table(result))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)
