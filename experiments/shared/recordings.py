"""Real recordings with frames: those a script is given, or takes where none is named."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from evflow import Recording, read_recording
from evflow.errors import EvflowDataError
from experiments.shared.common import slug

HELD = ("ijrr_slider_depth", "newton_cradle_davis346.aedat4")


def held_recordings() -> list[Path]:
    """Those of HELD that lie in `held_folder`."""
    return [path for name in HELD if (path := held_folder() / name).exists()]


def held_folder() -> Path:
    """$EVFLOW_DATA/data/recordings; a folder that does not exist where that is not set."""
    return Path(os.environ.get("EVFLOW_DATA") or "absent") / "data/recordings"


def distinct(paths: Sequence[Path], name: Callable[[Path], str] = lambda path: slug(path.stem)
             ) -> Sequence[Path]:
    """The paths; EV020 where two recordings have one name."""
    names = [name(path) for path in paths]
    if twice := {n for n in names if names.count(n) > 1}:
        raise EvflowDataError("EV020", f"more than one recording is called {sorted(twice)}.",
                              "Rename a file: it is by its name that a recording is known.")
    return paths


def real_recordings(
    paths: Sequence[Path], span_s: tuple[float, float] | None, most: int | None
) -> Iterator[tuple[str, Recording]]:
    """(name, recording) of these paths, or of at most so many `held_recordings` without any. Raises
    as `distinct`."""
    for path in distinct(paths) or held_recordings()[:most]:
        yield path.stem, cut(read_recording(path), span_s)


def cut(recording: Recording, span_s: tuple[float, float] | None) -> Recording:
    """The part between two instants, in seconds after the first frame."""
    if span_s is None or not recording.has_frames:
        return recording
    begin, end = (int(recording.frame_times[0] + 1e6 * s) for s in span_s)
    first, last = np.searchsorted(recording.frame_times, [begin, end])
    return dataclasses.replace(
        recording, events=recording.events.slice(begin, end),
        frames=recording.frames[first:last], frame_times=recording.frame_times[first:last])
