"""A score for each of many hidden recordings, in one process or several side by side."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar

import jax

from evflow import load_weights
from evflow.errors import EvflowDataError
from evflow.process.terminal import bar
from evflow.process.workers import worker_pool
from evflow.scenes import make_bank, own_bank
from evflow.training.config import PRESETS
from experiments.shared.cameras import Hidden, Protocol, hidden_recording

Result = TypeVar("Result")
Score = Callable[[Any, Hidden, Protocol], Result]  # params, recording, what it is like


@dataclasses.dataclass(frozen=True)
class Setup:
    """Settings common to all recordings. photos: whether scenes also show the training's
    photographs; images: a folder or COCO json of pictures to show instead."""

    weights: str
    seed: int
    photos: bool = False
    images: str | None = None


_SHARED: dict[str, Any] = {}


def prepare(setup: Setup) -> None:
    """Load the weights and make the textures, once a process."""
    if _SHARED.get("setup") == setup:
        return
    params = load_weights(setup.weights)  # the name may be wrong, and textures take seconds
    k_bank, k_data = jax.random.split(jax.random.key(setup.seed))
    bank = (own_bank(k_bank, setup.images) if setup.images is not None
            else make_bank(k_bank, PRESETS["default"].textures, photos=setup.photos))
    _SHARED.update(setup=setup, params=params, bank=bank, key=k_data)


def one(score: Score[Result], job: tuple[int, Protocol]) -> Result:
    number, protocol = job
    key = jax.random.fold_in(_SHARED["key"], number)
    return score(_SHARED["params"], hidden_recording(key, _SHARED["bank"], protocol), protocol)


def scores(
    score: Score[Result], setup: Setup, jobs: Sequence[tuple[int, Protocol]], workers: int,
    title: str,
) -> Iterator[Result]:
    """score(params, hidden, protocol) for each job (number, protocol), in order. A recording
    follows from the seed, its number and its protocol alone."""
    with bar(title) as progress:
        for done, result in enumerate(made(score, setup, jobs, workers), 1):
            progress(done, len(jobs))
            yield result


def study(
    score: Score[Result | None], setup: Setup, protocols: Sequence[Protocol], workers: int,
    title: str,
) -> list[Result]:
    """`scores` of one recording of each protocol, numbered from 0; without those that are None
    (insufficient recordings)."""
    rows = scores(score, setup, list(enumerate(protocols)), workers, title)
    return [row for row in rows if row is not None]


def enough(rows: list[Result], least: int = 1) -> list[Result]:
    """The rows of a study; EV017 where there are fewer than so many."""
    if len(rows) < least:
        raise EvflowDataError(
            "EV017", f"{len(rows)} of the recordings had enough events; it takes {least}.",
            "Take more --recordings, or another --seed.")
    return rows


def made(
    score: Score[Result], setup: Setup, jobs: Sequence[tuple[int, Protocol]], workers: int
) -> Iterator[Result]:
    """`scores` without a bar."""
    if workers == 1:
        prepare(setup)
        yield from map(partial(one, score), jobs)
        return
    prepare(setup)  # what cannot be loaded is told here, not by the death of a worker
    with worker_pool(workers, prepare, setup) as pool:
        yield from pool.map(partial(one, score), jobs)
