"""What has been read of a camera so far, as a value: `add` returns it with one more stretch.

A `State` consists of sums over what was read (maps of evidence) and the few stretches that are
simulated. Only its references to what was read grow; `thinned` bounds them. finish.py estimates the
camera from it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from evflow.camera import Summary
from evflow.estimation import drift, maps
from evflow.estimation.front_end import FrontEnd
from evflow.estimation.pooled import pooled_pixels, window_counts, window_stats
from evflow.estimation.refine import Chunk, PixelEvidence, Stretch, make_chunk, simulated_part
from evflow.estimation.refine.chunk import without_evidence
from evflow.estimation.refine.path import STEPS, of_place
from evflow.estimation.refine.stretches import spread
from evflow.network import api
from evflow.process.memory import give_back
from evflow.recordings.faulty_pixels import hot_in_stretch
from evflow.recordings.windows import window_at
from evflow.types import Window, release

Array = np.ndarray
Advance = Callable[[], None]


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """params: of the network. stats, sent (2, H, W), n_shown (H, W), evidence, quiet (4, H, W):
    sums over all that was read; pooled: (2, H, W) events that are in stats; chunks: stretches to
    simulate; read: stretches whose quiet time is counted at the end; windows, seconds: amounts
    read; parts: of each stretch, what drift.py compares."""

    params: api.Params
    front_end: FrontEnd
    stats: api.Stats | None = None
    sent: Array = dataclasses.field(default_factory=lambda: np.zeros((2, 1, 1)))
    pooled: Array = dataclasses.field(default_factory=lambda: np.zeros((2, 1, 1)))
    n_shown: Array = dataclasses.field(default_factory=lambda: np.zeros(()))
    evidence: PixelEvidence | None = None
    quiet: Array | None = None
    chunks: tuple[Chunk, ...] = ()
    read: tuple[Stretch, ...] = ()
    windows: int = 0
    seconds: float = 0.0
    parts: tuple[drift.Part, ...] = ()

    @property
    def n_events(self) -> Array:
        """(H, W) events of both polarities."""
        return np.asarray(self.sent.sum(0))

    def __add__(self, more: State) -> State:
        """The sum of this and of what was read after it, with the same front end."""
        def total(one: Any, other: Any) -> Any:
            return other if one is None else one if other is None else one + other

        return dataclasses.replace(self, **{
            field.name: total(getattr(self, field.name), getattr(more, field.name))
            for field in dataclasses.fields(self) if field.name not in ("params", "front_end")})


def add(
    state: State, stretch: Stretch, *, simulate: bool, every: int = 1,
    advance: Advance = lambda: None,
) -> State:
    """The state with one more stretch; arguments as for `read_stretch`."""
    return state + read_stretch(state, stretch, simulate=simulate, every=every, advance=advance)


def read_stretch(
    state: State, stretch: Stretch, *, simulate: bool, every: int = 1,
    advance: Advance = lambda: None,
) -> State:
    """The state of a single stretch, read with the front end of `state`.

    Args:
        state: for its params and front end.
        stretch: to read.
        simulate: whether the refinement simulates it.
        every: which of its windows are pooled: 1, all; 2, every second one.
        advance: called after every window, and after the stretch.
    """
    give_back()
    front_end, stats, n_shown = state.front_end, None, np.zeros(())
    sent, pooled = np.zeros((2, 1, 1)), np.zeros((2, 1, 1))
    for number, window in enumerate(windows_of([stretch])):
        counts, shown = window_counts(window)
        if number % every == 0:
            counted = pooled_pixels(window, front_end.faulty)
            more = window_stats(state.params, window, front_end.seen_by, counted)
            stats = more if stats is None else stats + more
            pooled = pooled + counts * counted
        sent, n_shown = sent + counts, n_shown + shown
        advance()
    read = State(
        state.params, state.front_end, stats, sent, pooled, n_shown, read=(stretch,),
        windows=len(stretch.windows), seconds=1e-6 * (stretch.span_us[1] - stretch.span_us[0]))
    if not stretch.run:
        return read
    give_back()
    read = add_path(read, stretch, simulate=simulate)
    release(stretch.recording)
    give_back()
    advance()
    return read


def add_path(state: State, stretch: Stretch, *, simulate: bool) -> State:
    """The state with the evidence from the path between a stretch's frames, without windows."""
    place, seen_by = (stretch.recording, stretch.run), state.front_end.seen_by
    chunk = make_chunk(*place, STEPS, seen_by, state.front_end.noise_dn, first=stretch.first,
                       film=state.front_end.films.pop(of_place(*place), None))
    kept = simulated_part(chunk, place, seen_by) if simulate else None
    hot = hot_in_stretch(chunk.quiet, np.asarray(chunk.recorded.counts).sum((0, 1)),
                         float(chunk.dt_s.sum()))
    added = State(state.params, state.front_end, evidence=chunk.evidence, quiet=chunk.quiet,
                  chunks=(without_evidence(kept),) if kept else (),
                  parts=(drift.part(stretch.span_us, chunk.evidence.without(hot)),))
    del chunk  # a film of the whole sensor
    return state + added


def with_a_chunk(state: State) -> State:
    """The state with one of its longest stretches to simulate where there is a path and none of
    those chosen was read before reading ended."""
    if state.quiet is None or state.chunks:
        return state
    stretch = state.read[spread([len(s.run) for s in state.read], 1)[0]]
    place, seen_by = (stretch.recording, stretch.run), state.front_end.seen_by
    chunk = make_chunk(*place, STEPS, seen_by, state.front_end.noise_dn, first=stretch.first)
    kept = without_evidence(simulated_part(chunk, place, seen_by))
    return dataclasses.replace(state, chunks=(kept,))


def summary_so_far(state: State) -> tuple[Summary, Summary]:
    """The camera's summary so far and its std, before any refinement; takes no time."""
    assert state.stats is not None
    summary, std = api.finish(state.params, state.stats)
    found = state.front_end.found
    if found is not None and not state.front_end.seen_by.ideal and state.evidence is not None:
        summary, std = maps.regressed(summary, std, found)
    return summary, std


def windows_of(stretches: Sequence[Stretch]) -> Iterator[Window]:
    """The windows of stretches, whose memory is released as they pass."""
    for stretch in stretches:
        for number, pair in stretch.windows:
            yield window_at(stretch.recording, pair, number)
        release(stretch.recording)


def thinned(state: State, chunks: int, read: int) -> State:
    """The state with every second simulated stretch dropped if there are `chunks` of them, and
    likewise for the stretches whose quiet time is counted, `read`."""
    return dataclasses.replace(
        state, chunks=state.chunks[::2] if 1 < chunks <= len(state.chunks) else state.chunks,
        read=state.read[::2] if len(state.read) >= read else state.read)
