"""Windows: the pieces of a recording between two frames, from which a camera is estimated.

A window runs from one frame to the first that is at least `min_us` later; the next begins where it
ends. Only windows covered by the events are used, and none across a gap in them or a dropped or
faulty frame: there the path of brightness is unknown for too long, or wrong; and none in which the
event rate stands at a ceiling, where events are missing.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import weakref
from collections.abc import Iterator

import numpy as np

from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.io.decode.units import too_large
from evflow.notes import Note, why_no_frames
from evflow.recordings.ceiling import rate_ceiling
from evflow.recordings.gaps import event_gaps
from evflow.recordings.glitches import faulty_frames
from evflow.types import Recording, Window

MIN_US = 40_000  # two frames of a 50 Hz camera, one of a DAVIS346 at 25 Hz
EDGE_US = 5_000  # events may begin or end this far inside the first or last frame: the first event
# comes only when brightness has changed by a threshold
EDGE_EVENTS = 10  # or this many of the local intervals between events
BEYOND = 0.1  # share of the recording's time with events before the first or after the last frame
NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?")
MOST_WINDOWS = 10_000_000  # four days of 33 ms; a clock that jumps to Unix time makes 5e10
CAPPED = 0.05  # share of a window's time at a ceiling of the event rate
DROPPED = 3.0  # a frame interval of more than this many medians means missing frames


@dataclasses.dataclass(frozen=True)
class Skipped:
    """A window that is left out, between frames first and last, and why; its `str` is a
    sentence."""

    first: int
    last: int
    why: str

    def __str__(self) -> str:
        return f"{self.frames}: {self.why}"

    @property
    def frames(self) -> str:
        return f"frames {self.first}-{self.last}"

    def moved(self, frames: int) -> Skipped:
        """The same, of a recording that begins with so many frames more."""
        return Skipped(self.first + frames, self.last + frames, self.why)


@dataclasses.dataclass(frozen=True)
class WindowPlan:
    """pairs: (first, last) frame of each window. skipped: windows that are left out."""

    pairs: tuple[tuple[int, int], ...]
    skipped: tuple[Skipped, ...]


def plan_windows(recording: Recording, min_us: int = MIN_US) -> WindowPlan:
    """Choose the windows of a recording; nothing is cut yet.

    Raises EV001 (no events), EV011 (fewer than two frames), EV012 (frames and events do not
    overlap), EV020 (min_us < 1).
    """
    if not isinstance(min_us, int | np.integer) or min_us < 1:
        raise EvflowDataError("EV020", f"min_us={min_us}.",
                              "Give a whole number of microseconds, 1 or more.")
    need(recording, Recording, "recording", "For a path: evflow.read_recording(path).")
    check_overlap(recording)
    times = recording.frame_times
    start, stop = covered_us(recording)
    obstacles = _obstacles(recording, start, stop)
    pairs: list[tuple[int, int]] = []
    skipped: list[Skipped] = []
    first = 0
    while (last := int(np.searchsorted(times, times[first] + min_us))) < len(times):
        if found := obstacles.between(first, last):
            why, following = found
        elif times[first] < start or times[last] > stop:
            why = "not covered by the events"
            following = first + 1 if times[first] < start else last
        else:
            why, following = "", last
            pairs.append((first, last))
        if why:
            skipped.append(Skipped(first, last, why))
        first = following
    return WindowPlan(tuple(pairs), tuple(skipped))


@dataclasses.dataclass(frozen=True, eq=False)
class _Obstacles:
    """What no window may cross. times: of the frames; late: (N,) intervals with missing frames;
    silent: (M, 2) us, begin and end of gaps in the events; capped: (M, 2) us, of times at a ceiling
    of `capped_per_s` events; glitches, steps: from `faulty_frames`."""

    times: np.ndarray
    late: np.ndarray
    silent: np.ndarray
    capped: np.ndarray
    capped_per_s: float
    glitches: dict[int, str]
    steps: dict[int, str]

    def between(self, first: int, last: int) -> tuple[str, int] | None:
        """What is wrong between two frames, and the frame to continue from."""
        dropped = self.late[(self.late >= first) & (self.late < last)]
        if len(dropped):
            i = int(dropped[0])
            lost_ms = (self.times[i + 1] - self.times[i]) / 1e3
            return f"no frame for {lost_ms:.1f} ms (dropped?)", i + 1
        begin, end = self.silent.T
        silent = self.silent[(begin < self.times[last]) & (end > self.times[first])]
        if len(silent):
            return (f"no events for {np.ptp(silent[0]) / 1e3:.1f} ms (lost packets, or a static "
                    "scene?)"), last
        at_ceiling = self._capped_before(last) - self._capped_before(first)
        if at_ceiling > CAPPED * (self.times[last] - self.times[first]):
            return (f"the event rate stands at a ceiling of {self.capped_per_s:,.0f} events/s "
                    "(readout or rate control?), where events are lost"), last
        faults = [(i, why) for i, why in self.glitches.items() if first <= i <= last] + [
            (i, why) for i, why in self.steps.items() if first <= i < last]
        if faults:
            return faults[0][1], max(i for i, _ in faults) + 1
        return None


    @functools.cached_property
    def _capped_us(self) -> np.ndarray:
        """(M + 1,) us at the ceiling before each span, and in all."""
        return np.concatenate([[0], np.cumsum(np.diff(self.capped).ravel())])

    def _capped_before(self, frame: int) -> int:
        """us at the ceiling before a frame; spans are in order and apart."""
        time = self.times[frame]
        k = int(np.searchsorted(self.capped[:, 0], time))
        over = max(int(self.capped[k - 1, 1] - time), 0) if k else 0
        return int(self._capped_us[k]) - over


_KNOWN: weakref.WeakKeyDictionary[Recording, _Obstacles] = weakref.WeakKeyDictionary()


def _obstacles(recording: Recording, start: int, stop: int) -> _Obstacles:
    """Searched once per recording, which cannot change: it needs a pass over all events."""
    if recording not in _KNOWN:
        _KNOWN[recording] = _look(recording, start, stop)
    return _KNOWN[recording]


def _look(recording: Recording, start: int, stop: int) -> _Obstacles:
    times, t = recording.frame_times, recording.events.t
    late = np.flatnonzero(np.diff(times) > DROPPED * np.median(np.diff(times)))
    gaps, ceiling = event_gaps(t), rate_ceiling(t)
    capped = ceiling.spans if ceiling else np.zeros((0, 2), np.int64)
    return _Obstacles(times, late, np.stack([t[gaps], t[gaps + 1]], -1), capped,
                      ceiling.per_s if ceiling else 0.0, *faulty_frames(recording, start, stop))


def iter_windows(
    recording: Recording, min_us: int = MIN_US, plan: WindowPlan | None = None
) -> Iterator[Window]:
    """The windows of a recording from which a camera is estimated, in time order.

    A window runs from one frame to the first that is at least min_us later. Windows that the events
    do not cover, or that contain a gap in the events or a dropped or faulty frame, are left out.

    Args:
        recording: events and frames on one clock.
        min_us: shortest window, integer microseconds.
        plan: from `plan_windows`; None makes it.

    Returns:
        An iterator over the windows; their events are views. Errors are raised by the call.

    Raises:
        EvflowDataError: EV001 (no events), EV011 (fewer than two frames), EV012 (frames and events
            do not overlap), EV017 (no usable window), EV020 (min_us, or not a `Recording`).

    Example:
        >>> for window in ef.iter_windows(ef.read_recording("flight.h5")):
        ...     dlogI = ef.delta_log_intensity(window.frame0, window.frame1)
    """
    plan = plan_windows(recording, min_us) if plan is None else plan
    if not plan.pairs:
        why = "; ".join(map(str, plan.skipped[:3])) or "the frames span less than that"
        raise EvflowDataError(
            "EV017", f"no window of {min_us / 1e3:g} ms or more is usable ({why}).",
            "Record longer, or use shorter windows (min_us, --window-ms).")
    return (window_at(recording, pair, index) for index, pair in enumerate(plan.pairs))


def condensed(skipped: tuple[Skipped, ...]) -> tuple[Note, ...]:
    """Notes on skipped windows, one per reason: reasons that differ only in a number are merged
    into a range."""
    reasons: dict[str, list[Skipped]] = {}
    for window in skipped:
        reasons.setdefault(NUMBER.sub("#", window.why, count=1), []).append(window)
    return tuple(Note(
        "windows.skipped", f"{of[0].frames} skipped: {of[0].why}" if len(of) == 1 else
        f"{len(of)} windows skipped ({of[0].frames} to {of[-1].frames}): {_spanned(of)}")
        for of in reasons.values())


def _spanned(of: list[Skipped]) -> str:
    """The reason for windows whose reasons differ in at most one number."""
    numbers = [found[0] for window in of if (found := NUMBER.search(window.why))]
    low, high = (pick(numbers, key=float) if numbers else "" for pick in (min, max))
    return of[0].why if low == high else NUMBER.sub(f"{low} to {high}", of[0].why, count=1)


def left_out(recording: Recording, plan: WindowPlan) -> tuple[Note, ...]:
    """Notes on what no window contains: skipped windows, and events before the first frame or after
    the last, if there are many."""
    t, times = recording.events.t, recording.frame_times
    whole = max(int(t[-1]) - int(t[0]), 1)
    sides = ((int(times[0]) - int(t[0]), "before the first frame"),
             (int(t[-1]) - int(times[-1]), "after the last frame"))
    return (*condensed(plan.skipped), *(Note(
        "windows.beyond", f"{us * 1e-6:.2f} of {whole * 1e-6:.2f} s of events come {where} and "
        "are not used, as no frame shows what moved") for us, where in sides
        if us > max(BEYOND * whole, 1.5 * float(np.median(np.diff(times))))))


def window_at(recording: Recording, pair: tuple[int, int], index: int) -> Window:
    """The window between a pair of frames (first, last)."""
    t0, t1 = (int(recording.frame_times[i]) for i in pair)
    frame0, frame1 = (recording.frame_dn(i) for i in pair)
    return Window(recording.events.slice(t0, t1), frame0, frame1, t0, t1, index)


def covered_us(recording: Recording) -> tuple[int, int]:
    """The time range of the events, widened by `EDGE_US` or a few local intervals between events: a
    slow scene has its first event some time after the camera started."""
    t = recording.events.t
    if len(t) < 2:
        return int(t[0]) - EDGE_US, int(t[-1]) + EDGE_US
    first, last = (EDGE_EVENTS * int(np.median(np.diff(part))) for part in (t[:100], t[-100:]))
    return int(t[0]) - max(EDGE_US, first), int(t[-1]) + max(EDGE_US, last)


def check_overlap(recording: Recording) -> None:
    """EV001 (no events), EV011 (fewer than two frames), EV012 (no common time)."""
    t, times = recording.events.t, recording.frame_times
    if len(t) == 0:
        raise EvflowDataError("EV001", "the recording has no events.")
    if len(times) < 2:
        raise EvflowDataError(
            "EV011", f"the recording has {'one frame' if len(times) else 'no frames'}"
            f"{why_no_frames(recording.notes)}; a window lies between two.",
            "Thresholds are measured against intensity: record or add frames. Of a static scene "
            "noise is measured without: --protocol static.")
    start, stop = covered_us(recording)
    if times[-1] <= start or times[0] >= stop:
        large = too_large(times, t)
        raise EvflowDataError(
            "EV012", f"events cover {t[0]:,}..{t[-1]:,} us but frames {times[0]:,}.."
            f"{times[-1]:,} us.",
            f"Frame times are {large} the events': one of both was read in a wrong unit. Pass "
            "--time-unit for times in the recording, --timestamps-unit for those of --frames."
            if large else
            "Are both on one clock and in one unit? If they begin together, --frames-offset-ms "
            f"{(int(t[0]) - int(times[0])) / 1e3:.3f}; in another unit, --time-unit.")


def need_few_windows(t: np.ndarray, window_us: int) -> int:
    """Number of whole windows of a length in event times t (N,); EV026 beyond 10 million."""
    windows = (int(t[-1]) - int(t[0])) // window_us
    if windows > MOST_WINDOWS:
        raise EvflowDataError(
            "EV026", f"events from {t[0]:,} to {t[-1]:,} us, {windows:,} windows of "
            f"{window_us:,} us.", "Does the clock jump (read the parts separately: --start, "
            "--stop), or is the time unit wrong (--time-unit)?")
    return windows
