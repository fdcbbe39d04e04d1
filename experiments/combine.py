"""Put weights together from runs that trained different parts of the network.

    python -m experiments.combine runs/flow/weights.safetensors \
        --summary runs/summary/weights.safetensors --out both.safetensors
    python -m experiments.combine default --pixels calibrated.safetensors --out new.safetensors
    python -m experiments.combine default --pixels one.safetensors two.safetensors \
        --out mean.safetensors

The first weights give every part but those of an option's: `--summary` the summary, without which
fusion and signal, fitted to another one's answers, fall away; `--pixels` encoder, flow and spread,
which the refinement never asks. Of several runs from one start their mean is taken, which wanders
less than each of them (Izmailov et al. 2018). The card keeps the cards of all.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from evflow.commands.writing import need_absent, need_suffix
from evflow.errors import EvflowDataError
from evflow.network.weights import model_card, save_weights
from experiments.shared.common import estimator, run_script

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
    pixels: tuple[str, ...] = ()
    """Weights that give encoder, flow and spread: of several their mean."""
    overwrite: bool = False


def main(options: Options) -> None:
    if options.summary is None and not options.pixels:
        raise EvflowDataError("EV020", "neither --summary nor --pixels was given.",
                              "Name the weights whose part is to be taken over.")
    need_suffix(options.out, ".safetensors")
    need_absent(options.out, options.overwrite)
    name, net = estimator(options.weights)
    card = cards(options.weights)
    if options.pixels:
        given = [{part: taken(w, name)[part] for part in PIXELS if part in net}
                 for w in options.pixels]
        if len({str(jax.tree.map(np.shape, one)) for one in given}) > 1:
            raise EvflowDataError("EV018", f"{', '.join(options.pixels)} are networks of several "
                                  "sizes.", "Average weights of one.")
        net = net | jax.tree.map(lambda *leaves: np.mean(leaves, 0), *given)
        *others, last = (part_card(w, "pixels") for w in options.pixels)
        card = card | {"pixels": last | ({"mean_with": others} if others else {})}
        card.pop("calibration", None)  # of the pixels before
    if options.summary is not None:
        net = {part: v for part, v in net.items() if part not in AFTER_SUMMARY}
        net |= {"summary": taken(options.summary, name, "summary")["summary"]}
        card = {part: v for part, v in card.items() if part not in AFTER_SUMMARY}
        card |= {"summary": part_card(options.summary, "summary")}
    save_weights(options.out, {name: net}, card, overwrite=options.overwrite)


def taken(weights: str, name: str, *parts: str) -> dict[str, Any]:
    """The network in `weights`, of the architecture `name`, with the parts that are needed."""
    other, net = estimator(weights, *parts)
    if other != name:
        raise EvflowDataError("EV018", f"{weights} holds a network {other!r}, not {name!r}.",
                              "Combine networks of one architecture.")
    return net


def cards(weights: str) -> dict[str, Any]:
    """The card of `weights` by parts; a single run's is that of the pixels' parts."""
    card = model_card(weights)
    return card if "pixels" in card else {"pixels": card}


def part_card(weights: str, part: str) -> dict[str, Any]:
    """The card of a part of `weights`; a single run's is that of all its parts."""
    card = model_card(weights)
    return card.get(part, card)


if __name__ == "__main__":
    run_script(main, Options, __doc__)
