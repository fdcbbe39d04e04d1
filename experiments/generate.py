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

from evflow import Camera, code_from_video, generate, load_weights, log_prob
from evflow.camera import THETA_MIN, CameraPrior
from evflow.network.api import Params
from evflow.process.terminal import bar
from evflow.scenes import TextureBank, make_bank
from experiments.shared.common import begin, conclude, run_script
from experiments.shared.generated import Row, Windows, compare, figures, scene_of, simulated

Array = jax.Array

SCALES = {  # of theta_on, theta_off
    "as it is": (1.0, 1.0), "halved": (0.5, 0.5), "doubled": (2.0, 2.0),
    "ON halved": (0.5, 1.0), "ON doubled": (2.0, 1.0),
    "OFF halved": (1.0, 0.5), "OFF doubled": (1.0, 2.0)}
CHANGED = ("halved", "doubled")  # which log_prob is to tell from the camera as it is
REFERENCES = 4  # simulations whose mean log_prob is what is typical
SINGLE_PIXELS = 0.1  # share of pixels whose thresholds change at an unchanged summary


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


def scaled(camera: Camera, on: Array | float, off: Array | float) -> Camera:
    return dataclasses.replace(camera, theta_on=jnp.maximum(camera.theta_on * on, THETA_MIN),
                               theta_off=jnp.maximum(camera.theta_off * off, THETA_MIN))


def variants(key: Array, camera: Camera) -> dict[str, tuple[Camera, Array]]:
    """Cameras to compare, and the pixels (H, W) that count."""
    everywhere = jnp.ones(camera.shape, bool)
    found = {name: (scaled(camera, *scale), everywhere) for name, scale in SCALES.items()}
    some = jax.random.bernoulli(key, SINGLE_PIXELS, camera.shape)
    for name, scale in (("single pixels halved", 0.5), ("single pixels doubled", 2.0)):
        factor = jnp.where(some, scale, 1.0)
        found[name] = scaled(camera, factor, factor), some
    return found


def auroc(inside: np.ndarray, outside: np.ndarray) -> float:
    """How often a draw of `inside` (scenes, n) exceeds one of `outside` of the same scene; equal
    ones, as of a scene that stands still, count half."""
    apart = inside[:, :, None] - outside[:, None, :]
    return float((0.5 * (1.0 + np.sign(apart))).mean())


def separation(scores: dict[str, np.ndarray]) -> dict[str, float]:
    """AUROC of log_prob, and of its nearness to the reference, for each change of thresholds."""
    near = {name: -np.abs(row - scores["reference"]) for name, row in scores.items()}
    return {f"{name}, by {kind}": auroc(found["as it is"], found[name])
            for name in CHANGED
            for kind, found in (("height", scores), ("typicality", near))}


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


def table(result: dict[str, Any]) -> str:
    names = ("on", "off", "empty", "correlation", "two simulations", "relative")
    lines = ["| camera | events ON, generated / simulated | OFF | mean \\|value\\| of empty pixels "
             "| correlation with a simulation | of two simulations | ratio |", "|" + "---|" * 7]
    for name, row in result.items():
        if name != "auroc":
            lines.append(f"| {name} | " + " | ".join(f"{row[k]:.3f}" for k in names) + " |")
    lines += ["", "AUROC of log_prob: " + "; ".join(
        f"{k} {v:.2f}" for k, v in result["auroc"].items())]
    return "\n".join(lines)


if __name__ == "__main__":
    run_script(main, Options, __doc__)
