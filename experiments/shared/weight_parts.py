"""Scripts that fit one part of an estimator's weights: their checks, and how the part is saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from evflow.commands.writing import need_absent, need_suffix
from evflow.errors import EvflowDataError
from evflow.network.weights import model_card, save_weights
from experiments.shared.common import at_least, estimator


class FitOptions(Protocol):
    """Options of such a script."""

    @property
    def weights(self) -> Path: ...
    @property
    def out(self) -> Path: ...
    @property
    def overwrite(self) -> bool: ...
    @property
    def seed(self) -> int: ...


def begin_fit(options: FitOptions, *parts: str) -> tuple[str, dict[str, Any]]:
    """The architecture's name and the network in `options.weights`. Raises EV020 for a
    negative seed, EV020 or EV013 where `options.out` cannot be written, EV018 where the weights
    lack one of the parts."""
    at_least(0, seed=options.seed)
    need_suffix(options.out, ".safetensors")
    need_absent(options.out, options.overwrite)
    return estimator(options.weights, *parts)


def seeds_before(options: FitOptions, part: str) -> list[int]:
    """Seeds of the recordings that this part of the weights has learnt from. Raises EV020 where
    `options.seed` is one of them: cross-validation would judge it by what it has seen."""
    card = model_card(options.weights).get(part, {})
    seeds = card.get("seeds", [card["seed"]] if "seed" in card else [])
    if options.seed in seeds:
        raise EvflowDataError(
            "EV020", f"the {part} of {options.weights} has learnt from recordings of seed "
            f"{options.seed} before.", "Give another --seed, so that its errors are those on "
            "cameras it has not seen.")
    return seeds


def save_part(
    options: FitOptions, name: str, net: dict[str, Any], part: dict[str, Any], card: dict[str, Any]
) -> None:
    """Write the network with one part replaced; `card` is added to the model card."""
    save_weights(options.out, {name: {**net, **part}}, model_card(options.weights) | card,
                 overwrite=options.overwrite)
