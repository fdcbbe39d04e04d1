"""The folder of an EVIMO2v2 sequence of one event camera (better-flow/evimo): dataset_events_t.npy
(N, 1) s, dataset_events_xy.npy (N, 2), dataset_events_p.npy (N, 1).

Its Samsung camera stores polarity the other way round than its Prophesee cameras: if a folder in
the path names samsung_mono, polarity is inverted so that ON is brighter, and a note says so. Depth,
masks, poses (pickles) and the frames of another camera are not read.
"""

from __future__ import annotations

from pathlib import Path

from evflow.checks import Size
from evflow.files.arrays import mapped
from evflow.files.spool import Spool
from evflow.io.decode import tables
from evflow.io.decode.stream import gather
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Events, Recording

NAME = "evimo2"
EXTENSIONS: tuple[str, ...] = ("",)

SIZES: dict[str, Size] = {
    "samsung_mono": (640, 480), "left_camera": (640, 480), "right_camera": (640, 480)}


def sniff(path: Path, head: bytes) -> bool:
    return path.is_dir() and (path / "dataset_events_t.npy").is_file()


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV009 (damaged), EV016 (a file is absent) and what `stream.gather` raises."""
    t, p = (mapped(path / f"dataset_events_{name}.npy", (None,)) for name in ("t", "p"))
    xy = mapped(path / "dataset_events_xy.npy", (None, 2))
    n = tables.same_length(path, {"t": t, "p": p, "xy": xy})
    camera = next((part for part in reversed(path.resolve().parts) if part in SIZES), None)
    events, _, notes = gather(
        path, tables.blocks(n, lambda part: (xy[part, 0], xy[part, 1], t[part], p[part])), hints,
        SIZES.get(camera or ""), "s" if t.dtype.kind == "f" else "us")
    if camera != "samsung_mono":
        return Recording.of_events(events, notes)
    turned = Note("events.turned",
                  "polarity was inverted: EVIMO2's Samsung camera stores brighter as 0")
    return Recording.of_events(_turned(events), (turned, *notes))


def _turned(events: Events) -> Events:
    """The events with ON and OFF exchanged, in blocks, as p may be memory-mapped."""
    on = Spool(bool)
    for first in range(0, len(events), tables.ROWS):
        on.append(~events.p[first : first + tables.ROWS])
    return Events.unchecked(events.x, events.y, events.t, on.array(), events.size)
