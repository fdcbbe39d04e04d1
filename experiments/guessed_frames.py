"""Thresholds measured against frames that a network made of the events themselves: how wrong?

    python -m experiments.guessed_frames --weights e2vid-small --out results/guessed_frames

Hidden cameras are estimated twice, with the frames that they saw and with reconstructed ones in
their place; recordings given by --recordings likewise, where the first estimate is the reference.
Writes guessed_frames.json and .md: the ratio of estimate and truth, as the root mean square of its
logarithm, beside that of the constant in the middle of the prior.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from evflow import Recording, read_recording
from evflow.downstream import Trained, load_network, with_reconstructed_frames
from evflow.estimation.pipeline import estimate_camera
from evflow.process.terminal import bar
from evflow.scenes import make_bank
from evflow.scenes.config import SceneConfig
from experiments.shared.cameras import Protocol, hidden_recording
from experiments.shared.common import begin, conclude, run_script

THETAS = ("theta_on", "theta_off")
PROTOCOL = Protocol(
    scene=SceneConfig(speed_px_s=(40.0, 250.0), contrast=(0.4, 1.0), static_fraction=0.0),
    frame_ms=30, intervals=24)


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure cameras by frames that were made from their events."""

    out: Path
    """Folder for the results."""
    weights: str = "e2vid-small"
    """The network: a released name, a .safetensors path, or a published checkpoint."""
    cameras: int = 12
    """Hidden cameras, of thresholds .1 to .5."""
    recordings: tuple[Path, ...] = ()
    """Real ones with frames, beside them."""
    seed: int = 0


def main(options: Options) -> dict[str, Any]:
    begin(options, "guessed_frames")
    trained = load_network(options.weights)
    k_bank, k_data = jax.random.split(jax.random.key(1000 + options.seed))
    bank = make_bank(k_bank, 32, photos=False)
    rows: list[dict[str, Any]] = []
    with bar("cameras") as progress:
        for i in range(options.cameras):
            hidden = hidden_recording(jax.random.fold_in(k_data, i), bank, PROTOCOL)
            truth = {name: float(getattr(hidden.nominal, name)) for name in THETAS}
            rows.append({"camera": f"hidden {i}", **compared(hidden.recording, trained, truth)})
            progress(i + 1, options.cameras)
    for path in options.recordings:
        rows.append({"camera": path.stem, **compared(read_recording(path), trained, None)})
    result = {"cameras": rows, **figures(rows[:options.cameras])}
    conclude(options, "guessed_frames", result, table(result))
    return result


def compared(
    recording: Recording, trained: Trained, truth: dict[str, float] | None
) -> dict[str, dict[str, float]]:
    """Thresholds by the frames that are there ("seen") and by made ones ("made"), beside the
    truth, which of a real recording is the former."""
    bare = Recording.of_events(recording.events)
    seen, made = (
        {name: float(getattr(estimate_camera(r).summary, name)) for name in THETAS}
        for r in (recording, with_reconstructed_frames(bare, trained)))
    return {"truth": seen if truth is None else truth, "seen": seen, "made": made}


def figures(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Root mean square of the log ratio to the truth, and the correlation of the logarithms, over
    both polarities of all cameras."""
    if not rows:
        return {}
    truth, seen, made = (np.log([[r[kind][n] for n in THETAS] for r in rows]).ravel()
                         for kind in ("truth", "seen", "made"))
    low, high = PROTOCOL.prior.theta
    constant = np.log(0.5 * (low + high))
    rms = {f"rms_log_{name}": float(np.sqrt(np.mean((value - truth) ** 2)))
           for name, value in (("seen", seen), ("made", made), ("constant", constant))}
    centred = made - np.mean(made - truth)
    return rms | {"bias_log_made": float(np.mean(made - truth)),
                  "rms_log_made_unbiased": float(np.sqrt(np.mean((centred - truth) ** 2))),
                  "correlation_made": float(np.corrcoef(truth, made)[0, 1])}


def table(result: dict[str, Any]) -> str:
    """Markdown, a row a camera, and the figures."""
    lines = ["| camera | θ ON / OFF | by its frames | by made frames |", "|---|---|---|---|"]
    for row in result["cameras"]:
        cells = (" / ".join(f"{row[kind][n]:.3f}" for n in THETAS)
                 for kind in ("truth", "seen", "made"))
        lines.append(f"| {row['camera']} | {' | '.join(cells)} |")
    figures = ", ".join(f"{k} {v:.3f}" for k, v in result.items() if k != "cameras")
    return "\n".join((*lines, "", figures))


if __name__ == "__main__":
    run_script(main, Options, __doc__)
