"""Separation by log_prob, and the table of `generate`."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.shared.generated_cameras import CHANGED


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
