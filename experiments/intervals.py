"""Calibrate the intervals of the camera's summary, everything else frozen.

    python -m experiments.intervals told.safetensors --out default.safetensors

The std that the fusion learns is that of the recordings it was fitted to, and noise told from
signal and drawn to Eq. 12 changes it again. Here whole estimates of recordings that nothing was
fitted to are compared with the truth: std -> exp(level) std^power (of log theta, log eta), the
power by the likelihood, the level so that intervals of 68 % hold `COVERED`. Five-fold
cross-validation gives the figures of the model card.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro

from evflow import estimate_camera, load_weights
from evflow.camera import PARAMETERS
from evflow.weights import model_card, save_weights
from experiments.cameras import Hidden, Protocol, draw_protocol
from experiments.fuse import FOLDS, Row, Rows, gathered
from experiments.many import Setup

POWERS = np.linspace(0.4, 1.6, 121)
DEGREES = 10.0  # of Student's t
COVERED = 0.69  # by one std: a little more than 68 %, as the tails are heavier than a Gaussian's


@dataclasses.dataclass(frozen=True)
class Options:
    """Calibrate the intervals of the camera's summary."""

    weights: tyro.conf.Positional[Path]
    out: Path
    recordings: int = 2000
    workers: int = 1
    """Processes that simulate side by side."""
    seed: int = 9_000_011
    """Apart from training's, the fusion's and the signal's."""
    rows: Path | None = None
    """Where to keep the estimates, to resume an interrupted run from."""
    overwrite: bool = False


def row(params: Any, hidden: Hidden, _protocol: Protocol) -> Row | None:
    """Error and std (4,) of log theta and log eta, as estimated; None where nothing fired."""
    if len(hidden.recording.events) < 10:
        return None
    plain = {name: {**net, "intervals": None} for name, net in params.items()}
    found = estimate_camera(hidden.recording, plain)
    guess, std, true = (np.array([float(getattr(s, name)) for name in PARAMETERS])
                        for s in (found.summary, found.summary_std, hidden.nominal))
    return {"error": np.log(guess / np.maximum(true, 1e-3)), "std": std / guess,
            "signal": hidden.signal_events()}


def fit(error: np.ndarray, std: np.ndarray) -> tuple[float, float]:
    """(level, power) of one parameter, from errors and std (N,) of log values."""
    best, found = np.inf, (0.0, 1.0)
    for power in POWERS:
        away = np.abs(error) / std**power
        level = np.log(np.quantile(away, COVERED))
        # Student's t: a few recordings say nothing and must not decide alone.
        heavy = 0.5 * (DEGREES + 1) * np.log1p((away / np.exp(level)) ** 2 / DEGREES)
        loss = float((level + power * np.log(std) + heavy).mean())
        if loss < best:
            best, found = loss, (float(level), float(power))
    return found


def cross_validated(rows: Rows) -> np.ndarray:
    """Errors (N, 4) in units of a std that was calibrated on other recordings."""
    fold = np.arange(len(rows["error"])) % FOLDS
    away = np.zeros_like(rows["error"])
    for f in range(FOLDS):
        rest, held = fold != f, fold == f
        for i in range(away.shape[1]):
            level, power = fit(rows["error"][rest, i], rows["std"][rest, i])
            away[held, i] = np.abs(rows["error"][held, i]) / (
                np.exp(level) * rows["std"][held, i] ** power)
    return away


def main(options: Options) -> dict[str, Any]:
    (name, net), = load_weights(options.weights).items()
    setup = Setup(str(options.weights), options.seed, photos=True)
    jobs = [(i, draw_protocol(np.random.default_rng((options.seed, i))))
            for i in range(options.recordings)]
    rows = gathered(row, setup, jobs, options.workers, options.rows)
    fitted = [fit(rows["error"][:, i], rows["std"][:, i]) for i in range(len(PARAMETERS))]
    figures: dict[str, Any] = {"recordings": len(rows["error"])}
    before, after = np.abs(rows["error"]) / rows["std"], cross_validated(rows)
    for i, parameter in enumerate(PARAMETERS):
        figures |= {f"level/{parameter}": fitted[i][0], f"power/{parameter}": fitted[i][1]}
        for label, away in (("before", before), ("after", after)):
            figures[f"{label}_68/{parameter}"] = float((away[:, i] < 1).mean())
            figures[f"{label}_95/{parameter}"] = float((away[:, i] < 1.96).mean())
    print("\n".join(f"{k:24s} {v:.4f}" for k, v in figures.items()))
    level, power = (jnp.asarray(column, jnp.float32) for column in zip(*fitted, strict=True))
    card = model_card(options.weights) | {"intervals": {
        "recordings": options.recordings, "seed": options.seed, "figures": figures}}
    save_weights(options.out, {name: {**net, "intervals": {"level": level, "power": power}}}, card,
                 overwrite=options.overwrite)
    return figures


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
