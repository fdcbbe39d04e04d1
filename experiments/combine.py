"""Put weights together from runs that trained different parts of the network.

    python -m experiments.combine runs/flow/weights.safetensors \
        --summary runs/summary/weights.safetensors --out both.safetensors
    python -m experiments.combine default --pixels calibrated.safetensors --out new.safetensors

The first weights give every part but those of an option's: `--summary` the summary, without which
fusion and signal, fitted to another one's answers, fall away; `--pixels` encoder, flow and spread,
which the refinement never asks. The card keeps the cards of all.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from evflow import load_weights
from evflow.errors import EvflowDataError
from evflow.weights import model_card, save_weights

PIXELS = ("encoder", "flow", "spread")
AFTER_SUMMARY = ("fusion", "signal")  # fitted to what the summary says


@dataclasses.dataclass(frozen=True)
class Options:
    """Combine parts of trained networks."""

    weights: tyro.conf.Positional[str]
    """Weights (a name or a file) that give all other parts."""
    out: Path
    summary: str | None = None
    """Weights that give the summary."""
    pixels: str | None = None
    """Weights that give encoder, flow and spread."""
    overwrite: bool = False


def main(options: Options) -> None:
    if options.summary is None and options.pixels is None:
        raise EvflowDataError("EV020", "neither --summary nor --pixels was given.",
                              "Name the weights whose part is to be taken over.")
    (name, net), = load_weights(options.weights).items()
    card = cards(options.weights)
    if options.pixels is not None:
        net = net | {part: taken(options.pixels, name)[part] for part in PIXELS}
        card = card | {"pixels": model_card(options.pixels)}
        card.pop("calibration", None)  # of the pixels before
    if options.summary is not None:
        net = {part: v for part, v in net.items() if part not in AFTER_SUMMARY}
        net |= {"summary": taken(options.summary, name)["summary"]}
        card = card | {"summary": model_card(options.summary)}
    save_weights(options.out, {name: net}, card, overwrite=options.overwrite)


def taken(weights: str, name: str) -> dict[str, Any]:
    """The network in `weights`, of the architecture `name`."""
    (other, net), = load_weights(weights).items()
    if other != name:
        raise EvflowDataError("EV018", f"{weights} holds a network {other!r}, not {name!r}.",
                              "Combine networks of one architecture.")
    return net


def cards(weights: str) -> dict[str, Any]:
    """The card of `weights` by parts; a single run's is that of the pixels' parts."""
    card = model_card(weights)
    return card if "pixels" in card else {"pixels": card}


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
