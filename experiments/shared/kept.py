"""Rows of a long run, by name, kept in a file so that an interrupted run is gone on with."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_text
from evflow.process.terminal import bar

Row = dict[str, Any]  # JSON-ready


def resumed(
    path: Path | None, of: Sequence[Any], names: Sequence[str],
    make: Callable[[list[int]], Iterable[Row]], title: str,
) -> list[Row]:
    """A row for each name, in order.

    path: where they are kept, and read from where it holds some `of` the same (seed, weights, ...),
    JSON-ready; make(left): rows of those numbers of `names` that are not there, in order. Raises
    EV009 where the file holds no rows, EV013 where they are of something else.
    """
    rows = kept(path, of)
    left = [i for i, name in enumerate(names) if name not in rows]
    with bar(title) as progress:
        for done, (i, row) in enumerate(zip(left, make(left), strict=True), 1):
            rows[names[i]] = row
            if path is not None:
                atomic_text(path, json.dumps({"of": of, "rows": rows}), overwrite=True)
            progress(len(names) - len(left) + done, len(names))
    return [rows[name] for name in names]


def kept(path: Path | None, of: Sequence[Any]) -> dict[str, Row]:
    """Rows by name that are in a file, none where there is no such file. Raises as `resumed`."""
    if path is None or not path.exists():
        return {}
    try:
        held = json.loads(path.read_text())
        was, rows = held["of"], dict(held["rows"])
    except (ValueError, KeyError, TypeError, OSError) as e:
        raise EvflowDataError("EV009", f"{path} holds no rows of this script ({e}).",
                              "Choose another --rows.") from e
    if was != json.loads(json.dumps(list(of))):
        raise EvflowDataError("EV013", f"{path} holds rows of other options ({was}).",
                              "Choose another --rows.")
    return rows
