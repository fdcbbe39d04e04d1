"""Times of external events: from the triggers of a recording, or from a text file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.limits import read_whole
from evflow.io.decode import prophesee
from evflow.io.decode.text import HEAD, is_float
from evflow.io.decode.units import UNITS_US, shared_unit
from evflow.io.formats import aedat4, evt2, evt3, evt21
from evflow.io.formats.ros import ros1, ros2
from evflow.io.images.frames import existing
from evflow.types import Events

MAX_BYTES = 1 << 26  # of text: some four million instants
READERS = {"EVT2": evt2.triggers, "EVT2.1": evt21.triggers, "EVT3": evt3.triggers}
EXPECTED = ("Expected a text file with one time per line, on the clock of the events, or Prophesee "
            "RAW, AEDAT 4 or a ROS bag (evt3) with trigger events.")


def read_triggers(path: Path, events: Events, topic: str | None = None) -> np.ndarray:
    """Times (N,) int64 us: edges of external signals in a recording, or the first number of each
    line of a text file, in the unit in which they lie within the events' span.

    topic: whose events' triggers to read from a bag or AEDAT 4 of several cameras. Raises EV001
    (none), EV008 (neither), EV012 (outside the events in any unit), EV016.
    """
    found = _recorded(path, topic)
    if found is not None:
        if not len(found):
            raise EvflowDataError("EV001", f"{path} holds no trigger events.", EXPECTED, where=path)
        return found
    words = _first_words(path)
    times = np.array([float(word) for word in words])
    if not len(times):
        raise EvflowDataError("EV001", f"{path} holds no times.", EXPECTED, where=path)
    if not np.isfinite(times).all():
        raise EvflowDataError("EV007", f"{path} holds times that are not finite.", where=path)
    native = "s" if any("." in word for word in words) else "us"
    unit = shared_unit(times, events.t, [native, *(u for u in UNITS_US if u != native)])
    if unit is None:
        raise EvflowDataError(
            "EV012", f"the times of {path}, {times.min():g} to {times.max():g}, lie outside the "
            f"events, {events.t[0]} to {events.t[-1]} us, in any unit.",
            "Give them on the clock of the events.", where=path)
    return np.rint(times * UNITS_US[unit]).astype(np.int64)


def _recorded(path: Path, topic: str | None) -> np.ndarray | None:
    """Times of the triggers in a recording; None for files of other kinds."""
    head = b""
    if not existing(path).is_dir():
        with open(path, "rb") as opened:
            head = opened.read(HEAD)
    for bag in (ros1, ros2):
        if bag.sniff(path, head):
            return bag.triggers(path, topic)
    if aedat4.sniff(path, head):
        return aedat4.triggers(path, topic)
    known = prophesee.sniffed(path, head)
    if not known:
        return None
    return READERS[known](path) if known in READERS else np.zeros(0, np.int64)


def _first_words(path: Path) -> list[str]:
    """The numbers that lines begin with, as written; EV008 where one begins with something else."""
    found = []
    for number, line in enumerate(read_whole(path, MAX_BYTES).decode("utf-8", "replace")
                                  .splitlines(), 1):
        words = re.split(r"[\s,;]+", line.partition("#")[0].strip())
        if words == [""]:
            continue
        if is_float(words[0]):
            found.append(words[0])
        elif number > 1:  # the first line may name the columns
            raise EvflowDataError("EV008", f"line {number} of {path} begins with {words[0]!r}.",
                                  EXPECTED, where=path)
    return found
