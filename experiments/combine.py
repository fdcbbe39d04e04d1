"""Put released weights together from runs that trained different parts of the network.

    python -m experiments.combine runs/flow/weights.safetensors \
        --summary runs/summary/weights.safetensors --out both.safetensors

The first file gives every part but those named by an option; the card keeps both cards.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from evflow import load_weights
from evflow.weights import model_card, save_weights


@dataclasses.dataclass(frozen=True)
class Options:
    """Combine parts of two trained networks."""

    weights: tyro.conf.Positional[str]
    """Weights (a name or a file) that give all parts but the summary."""
    summary: Path
    """Weights that give the summary."""
    out: Path
    overwrite: bool = False


def main(options: Options) -> None:
    (name, net), = load_weights(options.weights).items()
    (_, other), = load_weights(options.summary).items()
    parts = {k: v for k, v in net.items() if k != "fusion"} | {"summary": other["summary"]}
    card = {"pixels": model_card(options.weights), "summary": model_card(options.summary)}
    save_weights(options.out, {name: parts}, card, overwrite=options.overwrite)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
