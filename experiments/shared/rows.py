"""Measurements of many hidden recordings, stacked, and saved in a file to resume from."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.many import Setup, enough, scores

Row = dict[str, np.ndarray]
Rows = dict[str, np.ndarray]  # the same, stacked

OFTEN = 50  # recordings from one saving to the next


def collected(
    row: Callable[[Any, Hidden, Protocol], Row | None], setup: Setup,
    protocols: Sequence[Protocol], workers: int, path: Path | None, origin: str, least: int = 1,
) -> Rows:
    """Rows of one recording of each protocol, stacked, without those that are None. path: file to
    save them in, and to resume from if it holds rows of the same origin (weights, seed). Raises as
    `saved_rows`, and EV017 with fewer rows than `least`."""
    found: list[Row] = []
    begin = 0
    if path and path.exists():
        begin, found = saved_rows(path, origin, len(protocols))
    jobs = list(enumerate(protocols))[begin:]
    for i, made in enumerate(scores(row, setup, jobs, workers, "recordings"), begin + 1):
        if made is not None:
            found.append(made)
        if path and (i % OFTEN == 0 or i == len(protocols)):
            with atomic_write(path, overwrite=True) as t, open(t, "wb") as f:
                np.savez(f, allow_pickle=False, next=i, origin=origin, **stack(found))
    return stack(enough(found, least))


def saved_rows(path: Path, origin: str, most: int) -> tuple[int, list[Row]]:
    """Number of finished recordings, and their rows. Raises EV009 where the file holds none, EV013
    where they are of other weights, another seed, or more recordings than `most`."""
    try:
        with open(path, "rb") as file, np.load(file) as saved:
            kept = dict(saved)
        begin, seen = int(kept.pop("next")), str(kept.pop("origin"))
    except (ValueError, KeyError, OSError, zipfile.BadZipFile) as e:
        raise EvflowDataError("EV009", f"{path} holds no rows of this script ({e}).",
                              "Choose another --rows.") from e
    if seen != origin:
        raise EvflowDataError("EV013", f"{path} holds rows of other weights or of another seed.",
                              "Choose another --rows.")
    if begin > most:
        raise EvflowDataError("EV013", f"{path} holds rows of {begin} recordings, not {most}.",
                              f"Pass --recordings {begin}, or choose another --rows.")
    return begin, [dict(zip(kept, r, strict=True)) for r in zip(*kept.values(), strict=True)]


def stack(rows: Sequence[Row]) -> Rows:
    return {k: np.stack([r[k] for r in rows]) for k in (rows[0] if rows else ())}
