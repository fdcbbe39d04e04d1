"""Exposures of frames, where a file holds them: as begin and end of each in place of its middle, or
as a number under a name with a unit (`exposure_us`, `exposure_time_ms`).

One number stands for all frames, the median. Times that are both begin and end, negative numbers
and NaN say nothing, and what is longer than the interval between frames is not believed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable
from typing import Any, NamedTuple

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode.columns import BRACKETS, UNIT
from evflow.io.decode.units import UNITS_US, written_unit
from evflow.notes import Note

KEY = "exposure_us"  # name under which it is written
LONGEST = 1.05  # an exposure lasts at most the interval between frames; times are rounded
NAMES = re.compile(r"(?:^|_)exposures?(?:_?times?|_?durations?)?$")  # without the unit
ENDS = re.compile(r"start|begin"), re.compile(r"end|stop")  # of an exposure, in a name
NEAR = 0.1  # of an exposure: times that differ by less are the same, rounded
NOTED, BLURRED = "frames.exposure", "frames.blur"
FOREVER_US = 2.0**62
TICKS = 1e6  # larger whole numbers are hardly ms: 17 minutes


class Stamps(NamedTuple):
    """What a file says of when its frames were taken.

    times: (T,) in the file's unit, mid-exposure if it holds begin and end; length: of the exposure
    in that unit; stated_us: of the exposure, under a name with a unit. 0 if they are unknown.
    notes: what was assumed.
    """

    times: np.ndarray
    length: float = 0.0
    stated_us: int = 0
    notes: tuple[Note, ...] = ()

    def exposure_us(self, unit: str) -> int:
        """The exposure, with times in this unit; 0 if it is unknown."""
        return self.stated_us or _whole(self.length * UNITS_US[unit])


def mid_exposure(times: np.ndarray, where: object) -> Stamps:
    """The stamps of exposures whose begin and end are (T, 2), EV008 if they cannot be that; others
    as they are, without axes of length 1."""
    if times.ndim != 2 or times.shape[1] != 2:
        return Stamps(times.ravel() if times.size == max(times.shape, default=0) else times)
    if (found := middle(*times.T)) is None:
        raise EvflowDataError(
            "EV008", f"{where} holds two columns, which are not begin and end of exposures: "
            f"{times[0].tolist()}, ...", "Keep one time per frame.", where=where)
    return found


def middle(begin: np.ndarray, end: np.ndarray) -> Stamps | None:
    """The stamps of exposures with this begin and end (T,); None if they are something else."""
    if (end < begin).any() or (end[:-1] > begin[1:]).any():
        return None
    if all(map(_are_ticks, (begin, end))):
        begin, end = begin.astype(np.int64), end.astype(np.int64)
    lengths = end - begin
    times = (begin + lengths // 2 if begin.dtype == end.dtype == np.int64 else
             begin + 0.5 * lengths)
    return Stamps(times, float(np.median(lengths)) if len(lengths) else 0.0)


def _are_ticks(times: np.ndarray) -> bool:
    """Whether times are counts of a clock, whose middle is one too: integers, or whole floats that
    are too large for s or ms."""
    last = float(np.abs(times).max(initial=0))
    return last < FOREVER_US and (times.dtype.kind in "iu" or (
        last > TICKS and bool((times % 1 == 0).all())))


def ends_of(names: Collection[str]) -> list[str]:
    """The names of the begin and the end of exposures; none if there is not one of each."""
    found = [name for word in ENDS for name in names if word.search(name.lower())]
    return found if len(set(found)) == len(found) == 2 else []


def beside_times(
    clock: str, times: np.ndarray, names: Collection[str], get: Callable[[str], Any]
) -> Stamps | None:
    """The stamps of exposures whose begin and end stand beside times (T,), which are either of
    them, their middle, or another clock's, with a note.

    clock: what the times are called; get(name): the array or column of a name. None if there are no
    begin and end: they are named exposures, or the times lie at or between them.
    """
    if not (pair := ends_of(names)):
        return None
    begin, end = (np.asarray(get(name)) for name in pair)
    numbers = all(a.dtype.kind in "iuf" and a.shape == times.shape and a.ndim == 1
                  for a in (times, begin, end))
    found = middle(begin, end) if numbers else None
    if found is None or not found.length > 0:
        return None
    if any((np.abs(times - at) <= NEAR * found.length).all() for at in (begin, found.times, end)):
        return found
    return found._replace(notes=(Note(
        "frames.clock", f"frames are at the middle of {' and '.join(pair)}; {clock} differs from "
        "all three and was not used"),)) if all("expos" in name.lower() for name in pair) else None


def names_exposure(name: str) -> bool:
    """Whether an array, attribute or column of this name holds lengths of exposures."""
    bare = BRACKETS.sub("", name.rpartition("/")[2].lower()).strip().replace(" ", "_")
    return bool(NAMES.search(UNIT.sub("", bare)))


def stated(names: Iterable[str], get: Callable[[str], Any]) -> int:
    """The exposure in us that one of these names states: a number, or one per frame, with its unit
    in the name. 0 if there is none, or several. get(name): its value."""
    fit = [name for name in names if names_exposure(name) and written_unit(name) != "auto"]
    numbers = np.asarray(get(fit[0]) if len(fit) == 1 else ())
    if numbers.dtype.kind not in "iuf" or not numbers.size:
        return 0
    return _whole(float(np.median(numbers)) * UNITS_US[written_unit(fit[0])])


def stated_by(*arrays: Any) -> int:
    """The exposure in us that an attribute of one of these data sets states; 0 if there is none."""
    return next((us for array in arrays if (attributes := getattr(array, "attrs", ())) and (
        us := stated(attributes, attributes.__getitem__))), 0)


def _whole(exposure_us: float) -> int:
    """It, rounded; 0 if it is none."""
    return round(exposure_us) if 0 < exposure_us < FOREVER_US else 0


def believed(exposure_us: int, times_us: np.ndarray) -> tuple[int, tuple[Note, ...]]:
    """An exposure that a file states for frames at these times (T,); 0 and a note if it is longer
    than the interval between them."""
    gap = float(np.median(np.diff(np.sort(times_us)))) if len(times_us) > 1 else np.inf
    if exposure_us <= LONGEST * gap:
        return exposure_us, ()
    return 0, (Note(NOTED, f"the file states an exposure of {exposure_us / 1e3:g} ms, longer than "
                    f"the {gap / 1e3:g} ms between frames: it is not used (--exposure-ms: the "
                    "right one)"),)


def exposed_note(exposure_us: int, said_by: str = "as the file says") -> Note:
    """That frames have an exposure, and what follows."""
    return Note(NOTED, f"frames are exposed for {exposure_us / 1e3:g} ms, {said_by}: "
                "estimate and simulate take out the blur of what moves by half a pixel or more "
                "in that time (--exposure-ms 0: they leave it)")


def noted(notes: Iterable[Note], exposure_us: int, said_by: str = "") -> tuple[Note, ...]:
    """The notes with this exposure in place of the one they name; without any if it is 0."""
    said = (exposed_note(exposure_us, said_by),) if exposure_us else ()
    return (*(note for note in notes if note.code not in (NOTED, BLURRED)), *said)


def given_exposure(
    exposure_ms: float, times_us: Iterable[int], notes: Iterable[Note]
) -> tuple[int, tuple[Note, ...]]:
    """The exposure in us of frames at these times that a user gives, and the notes with it in place
    of what a file says; EV020 if it is negative, or longer than the interval between frames."""
    gaps = np.diff(list(times_us))
    length = float(np.median(gaps)) * 1e-3 if len(gaps) else np.inf
    if not 0 <= exposure_ms < np.inf or exposure_ms > LONGEST * length:
        raise EvflowDataError(
            "EV020", f"an exposure of {exposure_ms:g} ms" + (
                f", where frames are {length:g} ms apart." if exposure_ms > 0 else "."),
            "Give milliseconds (--exposure-ms), at most the interval between frames; 0 if the "
            "exposure is to be ignored.")
    exposure_us = round(exposure_ms * 1e3)
    left = () if exposure_us else (Note(BLURRED, "the blur of the frames' exposure, if they have "
                                        "any, is left in them (--exposure-ms 0)"),)
    return exposure_us, (*noted(notes, exposure_us, "as was given"), *left)
