"""A camera measured piece by piece, while it is recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.estimation.extent import Extent, covered_s
from evflow.estimation.finish import estimate
from evflow.estimation.front_end import (
    FrontEnd,
    agree,
    find_front_end,
    find_timing,
    with_dead_time,
)
from evflow.estimation.pipeline import check_options
from evflow.estimation.refine import Stretch, cut
from evflow.estimation.refine.frame_exposure import with_exposures
from evflow.estimation.refine.frame_timing import Timing
from evflow.estimation.refine.stretches import most_simulated, spread
from evflow.estimation.result import CameraEstimate
from evflow.estimation.state import State, add, thinned
from evflow.network import api
from evflow.network.summary import pooling_parts
from evflow.network.weights import load_weights
from evflow.notes import Note
from evflow.recordings import dense
from evflow.recordings.repeats import ends_stale, without_repeats
from evflow.recordings.windows import condensed, plan_windows
from evflow.types import Recording


class CameraEstimator:
    """Measure a camera while it records: add pieces of a recording, ask for the estimate so far.

    Only sums and a bounded number of pieces are kept: memory is bounded by the size of the sensor.
    The photoreceptor and the frames' offset and exposure are measured from the first pieces, and
    again from the busiest when these have twice the events. If they differ, what is kept is read
    again, and `.extent` says how much that is. If one recording is added whole, the estimate equals
    `estimate_camera(recording, effort="full")`.

    Args:
        params: of `load_weights`; None loads the released ones. The paper's network, which sees
            pixels separately, cannot be used.
        refine: as in `estimate_camera`.
        pixel: as in `estimate_camera`.
        min_window_us: as in `estimate_camera`.

    Raises:
        EvflowDataError: EV018 (weights without a summary), EV020 (an unknown option).

    Example:
        >>> estimator = ef.CameraEstimator()
        >>> for piece in pieces:  # `Recording`s of a second, say
        ...     estimator.add(piece)
        >>> estimator.estimate().save("camera.npz")
    """

    FIRST = 8  # stretches to collect before anything is measured, and the busiest that are kept
    AGAIN = 2.0  # times the events, at which the front end is measured again
    KEPT = 32  # stretches whose quiet time is counted
    NOTES = 20  # notes on pieces that are kept

    def __init__(
        self, params: api.Params | None = None, *, refine: Literal["auto", "off"] = "auto",
        pixel: Literal["measured", "ideal"] = "measured", min_window_us: int = 40_000,
    ) -> None:
        check_options(refine=(refine, ("auto", "off")), pixel=(pixel, ("measured", "ideal")))
        self._params = load_weights() if params is None else params
        pooling_parts(self._params)  # EV018
        self._refine, self._min_us = refine, min_window_us
        self._is_measured = pixel == "measured"
        self._state: State | None = None
        self._waiting: tuple[Stretch, ...] = ()
        self._busiest: tuple[Stretch, ...] = ()
        self._measured = 0  # events of the busiest when the front end was measured
        self._notes: tuple[Note, ...] = ()
        self._size: tuple[int, int] | None = None
        self._white = 0  # of uint16 frames
        self._stale_us: int | None = None  # time of the last piece's last frame, if that repeats
        self._seconds, self._left_s, self._apart = 0.0, 0.0, 1
        self._stretches, self._left = 0, 0
        self._frames = 0  # used of earlier pieces, whose last is the next one's first

    def add(self, piece: Recording) -> int:
        """Read one more piece of the recording.

        Args:
            piece: events and at least two frames around them, from the same camera. Its last frame
                is the next piece's first. Of frames less than 10 ms apart every nth is used, and
                repeated ones are left out, as in `estimate_camera`; where a piece ends with one, so
                is the next piece's time up to its second frame.

        Returns:
            How many usable windows between frames it had; 0 for a piece in which nothing happens,
            which is left out.

        Raises:
            EvflowDataError: EV011 (fewer than two frames), EV012 (frames and events do not
                overlap), EV003 (uint16 frames with a higher white than those before), EV015
                (another size), EV020 (not a `Recording`). Earlier pieces are kept.
        """
        need(piece, Recording, "a piece", "For a path: evflow.read_recording(path).")
        if self._size not in (None, piece.events.size):
            raise EvflowDataError("EV015", f"a piece of {piece.events.size} pixels after "
                                  f"{self._size}.", "Add pieces of one camera only.")
        if piece.has_frames and not len(piece.events):
            return 0
        piece = self._as_bright(piece)
        white, stale_us = piece.full_scale, ends_stale(piece)
        if piece.has_frames and piece.frame_times[0] == self._stale_us:
            piece = dataclasses.replace(
                piece, frames=piece.frames[1:], frame_times=piece.frame_times[1:])
            if len(piece.frames) == 1:
                self._stale_us = stale_us
                return 0
        piece, given = dense.thinned(without_repeats(piece)), piece.notes
        plan = plan_windows(piece, self._min_us)  # refuses pieces, of which nothing is kept
        self._stale_us = stale_us
        if piece.frames.dtype == np.uint16:
            self._white = white
        skipped = tuple(s.moved(self._frames) for s in plan.skipped)
        self._frames += len(piece.frames) - 1
        told = {note.code for note in self._notes}
        self._notes += tuple(n for n in piece.notes[len(given):] if n.code not in told)
        self._notes = tuple(dict.fromkeys((*self._notes, *condensed(skipped))))[:self.NOTES]
        stretches = cut(piece, plan, path=self._refine == "auto", first=self._size is None)
        self._size = piece.events.size
        self._stretches += len(stretches)
        self._seconds += covered_s(s.span_us for s in stretches)
        self._busiest = tuple(
            sorted((*self._busiest, *stretches), key=_events, reverse=True)[:self.FIRST])
        if self._state is None:
            self._waiting += stretches
            if len(self._waiting) >= self.FIRST:
                self._measured = sum(map(_events, self._busiest))
                self._state = self._begun()
                self._waiting = ()
        else:
            for stretch in with_exposures(stretches, self._state.front_end.timing.exposure):
                self._state = self._next(self._state, stretch)
            if sum(map(_events, self._busiest)) > self.AGAIN * self._measured:
                self._state = self._again(self._state)
        return len(plan.pairs)

    def estimate(self) -> CameraEstimate:
        """Estimate the camera from everything that was added.

        Returns:
            As from `estimate_camera`; more pieces can be added afterwards, and whether it was
            called changes nothing of later estimates.

        Raises:
            EvflowDataError: EV017 (no usable window was added yet).
        """
        state = self._state
        if state is None and self._waiting:
            state = self._begun()
        if state is None:
            raise EvflowDataError(
                "EV017", "no usable window was added"
                + "".join(f" ({note})" for note in self._notes[:3]) + ".",
                "Add pieces with frames, in which something moves.")
        extent = Extent(self._seconds - self._left_s, self._seconds,
                        self._stretches - self._left, self._stretches, again=self._left > 0)
        return estimate(state, extent=extent, before=self._notes)

    def _as_bright(self, piece: Recording) -> Recording:
        """The piece with the white of those before; EV003 if it has a higher one."""
        if piece.frames.dtype != np.uint16 or not piece.has_frames:
            return piece
        white = self._white or piece.full_scale
        if piece.full_scale > white:
            raise EvflowDataError(
                "EV003", f"a piece whose frames are on 0..{piece.full_scale}, after pieces on "
                f"0..{white}.", "A piece shows only how bright its own frames are: give all of "
                f"them the camera's white, Recording(..., full_scale={piece.full_scale}).")
        return dataclasses.replace(piece, full_scale=white)

    def _again(self, state: State) -> State:
        """The state, or where its front end is not that of the busiest stretches, a new one of the
        stretches that are kept."""
        self._measured = sum(map(_events, self._busiest))
        timing = find_timing(self._busiest, measured=self._is_measured)
        before = state.front_end.timing.exposure
        timing = timing if timing.exposure.seconds else timing._replace(exposure=before)
        kept = {_place(s): s for s in (*state.read, *self._busiest)}
        stretches = with_exposures([kept[place] for place in sorted(kept)], timing.exposure, before)
        busiest = {_place(s) for s in self._busiest}
        front_end = self._front_end([s for s in stretches if _place(s) in busiest], timing)
        if agree(state.front_end, front_end):
            settled = with_dead_time(state.front_end, front_end)
            timing = timing._replace(exposure=before)
            return dataclasses.replace(
                state, front_end=dataclasses.replace(settled, timing=timing))
        self._left = self._stretches - len(stretches)
        self._left_s = self._seconds - covered_s(s.span_us for s in stretches)
        return self._read(stretches, front_end)

    def _begun(self) -> State:
        """The state of the stretches that wait."""
        timing = find_timing(self._waiting, measured=self._is_measured)
        stretches = with_exposures(self._waiting, timing.exposure)
        return self._read(stretches, self._front_end(stretches, timing))

    def _front_end(self, stretches: Sequence[Stretch], timing: Timing) -> FrontEnd:
        return find_front_end(stretches, timing, measured=self._is_measured)

    def _read(self, stretches: tuple[Stretch, ...], front_end: FrontEnd) -> State:
        """The state of some stretches."""
        state = State(self._params, front_end)
        most = most_simulated(stretches[0].recording.events.size)
        simulated = spread([len(s.run) for s in stretches], most)
        for i, stretch in enumerate(stretches):
            state = add(state, stretch, simulate=i in simulated)
        self._apart = max(1, len(stretches) // most)
        return state

    def _next(self, state: State, stretch: Stretch) -> State:
        """The state with a further stretch; every second simulated stretch is dropped when there
        are too many, so that they stay spread over the time."""
        most = most_simulated(stretch.recording.events.size)
        length = max((len(c.dt_s) for c in state.chunks), default=0)
        wanted = len(stretch.run) >= length > 0 and len(state.parts) % self._apart == 0
        if wanted and len(state.chunks) >= most:
            self._apart *= 2
        return add(thinned(state, most if wanted else most + 1, self.KEPT), stretch,
                   simulate=wanted)


def _place(stretch: Stretch) -> tuple[tuple[int, int], int]:
    """What a stretch shares with itself under another exposure: its span, and the piece."""
    return stretch.span_us, id(stretch.recording.events)


def _events(stretch: Stretch) -> int:
    """Number of a stretch's events."""
    return len(stretch.recording.events.slice(*stretch.span_us))
