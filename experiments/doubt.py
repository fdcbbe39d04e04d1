"""Fit how far the thresholds may be off, on simulated cameras as they are.

    python -m experiments.doubt evflow/weights/default.safetensors --out doubted.safetensors

Each hidden camera (of fifteen, eight as they may be: ideal, slow, blind for a while after an event,
noisy, with exposed, offset and noisy frames; four of the fusion's training; three DVS-Voltmeter's,
or seen for 5 s) is measured; the size of its error is regressed on what the estimate shows of
itself (evflow/estimation/refine/doubt.py), separately for cameras that are found ideal and others.
Cross-validation over recordings gives the figures of the model card and the factor of the std.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from evflow.errors import EvflowDataError
from evflow.estimation.refine.doubt import NEEDED
from evflow.network.weights import model_card, weights_hash
from experiments.shared.cameras import Hidden, Protocol, draw_protocol
from experiments.shared.common import at_least, run_script
from experiments.shared.doubt_fit import FOLDS, cross_validated, figures_of, fit, flat
from experiments.shared.many import Setup
from experiments.shared.real_cameras import draw_other, draw_real
from experiments.shared.refinement import undoubted
from experiments.shared.rows import Rows, collected
from experiments.shared.weight_parts import begin_fit, save_part

KINDS = (draw_protocol,) * 4 + (draw_real,) * 8 + (draw_other,) * 3
Kind = Literal["ideal", "other"]
COVERED = 0.74  # by one std: tails are heavy, and 1.96 of them are to hold more than nine in ten


@dataclasses.dataclass(frozen=True)
class Options:
    """Fit how far the thresholds may be off."""

    weights: tyro.conf.Positional[Path]
    out: Path
    recordings: int = 600
    workers: int = 1
    """Processes that simulate side by side."""
    seed: int = 5_000_011
    """Apart from training's and the fusion's."""
    rows: Path | None = None
    """Where to keep the signs, to resume an interrupted run from."""
    kinds: tuple[Kind, ...] = ("ideal", "other")
    """Which maps to fit: of cameras found ideal, of others. One left out stays as it is."""
    overwrite: bool = False


def drawn(seed: int, number: int) -> Protocol:
    """What the recording of that number is like."""
    return KINDS[number % len(KINDS)](np.random.default_rng((seed, number)))


def row(params: Any, hidden: Hidden, _protocol: Protocol) -> dict[str, np.ndarray] | None:
    """Signs (2, F), error of log theta (2,) and its std so far; None where too little happens."""
    made = undoubted(params, hidden.recording)
    if made is None:
        return None
    signs, summary, std = made
    truth, found, error = (
        np.array([float(getattr(s, f"theta_{p}")) for p in ("on", "off")])
        for s in (hidden.nominal, summary, std))
    return {"signs": signs, "left": np.log(truth / found), "before": error / found}


def main(options: Options) -> dict[str, float]:
    at_least(FOLDS, recordings=options.recordings)
    at_least(1, workers=options.workers)
    name, net = begin_fit(options, "summary")
    origin = f"{options.seed} {weights_hash(options.weights)}"
    protocols = [drawn(options.seed, i) for i in range(options.recordings)]
    setup = Setup(str(options.weights), options.seed, photos=True)
    rows = collected(row, setup, protocols, options.workers, options.rows, origin)
    needed = rows["signs"][:, 0, NEEDED] > 0
    of_kind = {kind: {k: v[needed == (kind == "other")] for k, v in rows.items()}
               for kind in options.kinds}
    for kind, some in of_kind.items():
        if (count := len(some["left"])) < FOLDS:
            raise EvflowDataError(
                "EV017", f"of {len(needed)} cameras that were measured, {count} count as {kind}.",
                f"{FOLDS} are needed: more --recordings, or leave --kinds {kind} out.")
    made, card = (dict(of.get("doubt", {})) for of in (net, model_card(options.weights)))
    figures: dict[str, float] = {}
    for kind, some in of_kind.items():
        made[kind], of = fitted(some)
        card[kind] = {"recordings": options.recordings, "seed": options.seed, "figures": of}
        figures |= {f"{kind}/{k}": v for k, v in of.items()}
    print("\n".join(f"{k:26s} {v:.4f}" for k, v in figures.items()))
    save_part(options, name, net, {"doubt": made}, {"doubt": card})
    return figures


def fitted(rows: Rows) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """The map of these cameras, and its figures by cross-validation."""
    both, std = flat(rows), cross_validated(rows)
    widen = float(np.quantile(np.abs(both["left"]) / std, COVERED))
    figures = {"recordings": len(rows["left"]),
               "median": float(np.median(np.abs(both["left"]))),
               **figures_of(both["left"], both["before"], "before"),
               **figures_of(both["left"], std * widen, "after")}
    return {**fit(both["signs"], both["left"], both["before"]), "widen": np.array(widen)}, figures


if __name__ == "__main__":
    run_script(main, Options, __doc__)
