"""Events whose time goes back: the probable cause, and what `--late` does about them.

Late events follow events of a later time, as when packets were overtaken. If a few events are ahead
of everything after them, those few are wrong. If time goes back for good, another clock begins.
`dropped` leaves out the fewest events such that the rest are ordered, which separates the three
cases as far as it looks ahead; `order` sorts; a `Joint` appends one clock to the other.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Iterable, Iterator

import numpy as np

from evflow.checks import RESET_US
from evflow.io.decode.chunk import Chunk, joined
from evflow.notes import Note

LOOK = 1 << 16  # events examined after the first that goes back
WRAPS = 1 << 32, 1 << 31  # us: where times of 32 bits, or 31 and a sign, begin anew
NEAR_WRAP = 1 / 64  # of it: a step back that is smaller by no more than this is a wrap
SAWS, SAW = 3, 0.25  # falls that make a sawtooth; how near to its ends, as a share of its height
MOST_LATE = 0.1  # share of events out of order, above which they are no late ones
SURE = 64  # events, which by chance are in order of their pixel or polarity in no recording
FEW = 16  # at most this many events ahead of all later ones count as wrong


def back_at(t: np.ndarray, last: float | None = None) -> int:
    """Index of the first of t (N,) that is smaller than its predecessor (initially `last`); else
    N."""
    if last is not None and len(t) and t[0] < last:
        return 0
    back = t[1:] < t[:-1]
    return int(np.argmax(back)) + 1 if back.any() else len(t)


def ahead_of(t: np.ndarray, i: int) -> int:
    """How many events directly before t[i], where time first goes back, are ahead of all later
    ones; 0 if event i itself is late."""
    ahead = i - int(np.searchsorted(t[:i], t[i], "right"))
    behind = int(np.count_nonzero(t[i : i + LOOK] < t[i - 1])) if i else 0
    return ahead if ahead <= FEW and ahead < behind else 0


def sorted_by(chunk: Chunk) -> str:
    """"pixel" or "polarity" if the events, SURE or more, are in that order; else ""."""
    if len(chunk.t) < SURE:
        return ""
    for rank, name in ((chunk.p, "polarity"), (chunk.x, "pixel"), (chunk.y, "pixel")):
        for one, other in itertools.permutations((rank[1:], rank[:-1])):
            if (one >= other).all() and rank[0] != rank[-1]:
                return name
    return ""


def advice(
    t: np.ndarray, i: int, before: int, turns: tuple[int, ...] = (), join: bool = False,
    by: str = "",
) -> str:
    """What it means that t[i] is smaller than `before`, its predecessor, and what to do. turns:
    after how many us the stored numbers begin anew, beside `WRAPS`; join: whether clocks are
    joined, of which this is none; by: as of `sorted_by`."""
    if by:
        return (f"The events are in order of their {by}, and not of time. Sort them: --late sort "
                "(late='sort')")
    step = before - int(t[i])
    lasting = step > RESET_US and not (t[i : i + LOOK] >= before).any()
    if step <= RESET_US and _turn(step, turns):
        return ("The stored integers begin anew, as they have too few bits: write them as 64-bit "
                "ones, np.unwrap(t.astype(np.int64), period=2**bits)")
    near = t[max(i - LOOK, 0) : i + LOOK]
    late = len(near) - len(longest(near))
    if late > MOST_LATE * len(near) and not (join or lasting or _sawtooth(t)):
        return ("The events are not in order of time: newest first, or by pixel? Sort them: "
                "--late sort (late='sort'). Two recordings, one behind the other? Write each "
                "to a file of its own")
    if ahead := ahead_of(t, i):
        return (f"The {ahead} events before it are ahead of all later ones: damaged times? Leave "
                "them out: --late drop (late='drop')")
    if _sawtooth(t):
        return ("Times begin anew again and again: are they relative to their packet or frame? Add "
                "the time at which each of these begins; sorting would mix them")
    if lasting:
        if _turn(step, (*WRAPS, *turns)):
            return ("Times of 32 bits that begin anew? Write them as 64-bit integers, or continue "
                    "them, without frames: --late join (late='join')")
        return ("A camera reset, or two recordings joined? Read one after the other: --late join "
                "(late='join')")
    if join:
        return (f"--late join takes a step back of more than {RESET_US / 1e6:g} s for another "
                f"clock, and this is one of {step / 1e6:.3g} s. Short recordings that were joined? "
                "Write each to a file of its own. Packets that were overtaken? --late drop, or "
                "--late sort")
    return ("Packets that were overtaken? Leave late events out: --late drop (late='drop'), or "
            "sort them in: --late sort")


def _sawtooth(t: np.ndarray) -> bool:
    """Whether times rise from near their least to near their largest and fall back, repeatedly."""
    low, high = int(t.min()), int(t.max())
    at = np.flatnonzero(t[1:] < t[:-1]) + 1
    near = SAW * (high - low)
    return len(at) >= SAWS and bool(
        (t[at] - low <= near).all() and (high - t[at - 1] <= near).all())


def _turn(step: int, turns: tuple[int, ...] = WRAPS) -> int:
    """The wrap-around that explains a step back in us, 0 if none does."""
    return next((turn for turn in turns if 0 <= turn - step <= NEAR_WRAP * turn), 0)


def begin(t: np.ndarray, start: int) -> int:
    """Index of the first of t (N,) at or after `start`, ignoring single events that are ahead."""
    if back_at(t) == len(t):
        return int(np.searchsorted(t, start))
    reached = np.concatenate([[0], (t >= start).astype(np.int8), [0]])
    firsts, ends = (np.flatnonzero(np.diff(reached) == step) for step in (1, -1))
    lasting = (ends - firsts > FEW) | (ends == len(t))
    return int(firsts[np.argmax(lasting)]) if lasting.any() else len(t)


class Dropped:
    """Chunks without the fewest events, among `LOOK`, whose removal leaves the rest ordered; count:
    how many of `seen` were removed."""

    def __init__(self, chunks: Iterable[Chunk]) -> None:
        self.chunks, self.count, self.seen = chunks, 0, 0
        self._last: float | None = None

    def __iter__(self) -> Iterator[Chunk]:
        held: list[Chunk] = []
        for chunk in self.chunks:
            if not len(chunk.t):
                continue
            if held:
                block, n = joined([*held, chunk]), sum(len(part.t) for part in held)
                if len(block.t) < LOOK and back_at(block.t, self._last) < len(block.t):
                    held.append(chunk)
                    continue
                kept = self._kept(block.t)
                yield self._released(block, kept[kept < n], n)
            held = [chunk]
        if held:
            block = joined(held)
            yield self._released(block, self._kept(block.t), len(block.t))

    def _kept(self, t: np.ndarray) -> np.ndarray:
        if t.dtype.kind == "f" and np.isnan(t).any():  # reported by whatever reads them
            return np.arange(len(t))
        return longest(t, self._last)

    def _released(self, block: Chunk, kept: np.ndarray, of: int) -> Chunk:
        self.seen += of
        self.count += of - len(kept)
        if len(kept):
            self._last = block.t[kept[-1]]
        return block.only(kept)

    def notes(self) -> tuple[Note, ...]:
        if not self.count:
            return ()
        many = (": so many are not late, but never were in order; --late sort keeps them"
                if self.count > MOST_LATE * self.seen else "")
        return (Note("events.late", f"{self.count:,} of {self.seen:,} events whose time goes back, "
                     f"or lies ahead of what follows, were left out (--late drop){many}"),)


def longest(t: np.ndarray, least: float | None = None) -> np.ndarray:
    """Indices of a longest non-decreasing subsequence of t (N,) with no value below `least`.

    A time that is no smaller than all before and no larger than all after always belongs to it:
    only the stretches between such times are searched.
    """
    if back_at(t, least) == len(t):
        return np.arange(len(t))
    at = np.arange(len(t)) if least is None else np.flatnonzero(t >= least)
    t = t[at]
    if not len(t):
        return at
    before = np.maximum.accumulate(t)
    after = np.minimum.accumulate(t[::-1])[::-1]
    fixed = (t == before) & (t == after)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], fixed, [True]]).astype(np.int8)))
    parts = [np.flatnonzero(fixed)]
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        parts.append(first + _longest(t[first:end].tolist()))
    return at[np.sort(np.concatenate(parts))]


def _longest(values: list[float]) -> np.ndarray:
    """The same by patience sorting: tops[k] ends the lowest subsequence of length k + 1."""
    tops: list[float] = []
    places: list[int] = []
    previous = [-1] * len(values)
    for i, value in enumerate(values):
        k = bisect_right(tops, value)
        previous[i] = places[k - 1] if k else -1
        if k == len(tops):
            tops.append(value)
            places.append(i)
        else:
            tops[k], places[k] = value, i
    run, i = [], places[-1]
    while i >= 0:
        run.append(i)
        i = previous[i]
    return np.array(run[::-1])


class Joint:
    """Joins clocks: where time goes back further than a late packet would, everything after it is
    shifted to continue the previous clock; a wrap-around is undone exactly. count: how often."""

    def __init__(self) -> None:
        self.count = 0
        self._last: int | None = None
        self._shift = 0

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Times (N,) int64 us that continue those of earlier calls."""
        if not len(t):
            return t
        steps = np.diff(t, prepend=t[0] if self._last is None else self._last)
        self._last = int(t[-1])
        reset = steps < -RESET_US
        if not reset.any():
            return t + self._shift
        gone = np.where(reset, -steps, 0)
        for i in np.flatnonzero(reset):
            gone[i] = _turn(int(gone[i])) or gone[i]
        shift = self._shift + np.cumsum(gone)
        self._shift, self.count = int(shift[-1]), self.count + int(reset.sum())
        return t + shift

    def notes(self) -> tuple[Note, ...]:
        if not self.count:
            return ()
        return (Note("events.late", f"the clock restarted {self.count:,} times; later events "
                     "continue the earlier clock (--late join)"),)


class Lateness:
    """How many events came late, and by how much at most, while they are collected for sorting.
    disorder: the first row that is out of order."""

    def __init__(self) -> None:
        self.count, self.most_us = 0, 0
        self._last: int | None = None

    def see(self, t: np.ndarray) -> None:
        highest = np.maximum.accumulate(
            t if self._last is None else np.maximum(t, self._last))
        late = highest - t
        if late.any():
            self.count += int(np.count_nonzero(late))
            self.most_us = max(self.most_us, int(late.max()))
        self._last = int(highest[-1])

    def order(self, t: np.ndarray) -> np.ndarray | None:
        """Indices that sort t; None if it is sorted."""
        return np.argsort(t, kind="stable") if self.count else None

    def notes(self) -> tuple[Note, ...]:
        if not self.count:
            return ()
        return (Note("events.late", f"{self.count:,} events that came up to "
                     f"{self.most_us / 1e3:,.3f} ms late were sorted in (--late sort)"),)
