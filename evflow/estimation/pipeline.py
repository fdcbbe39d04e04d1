"""Whole recordings: stretches -> a state -> the camera.

The windows are pooled: their `Stats` add up to the network's summary. The motion between frames is
followed stretch by stretch (refine/): some stretches are simulated to refine the summary, and a
regression on all of them gives each pixel's thresholds. The flow is not run. Only without a path
between the frames (refine="off", or frames too small for optical flow) does the flow estimate every
pixel of every window, and the windows are fused by their precision. Noise rates come from the quiet
time in either case. A pixel without information gets the camera's summary, with a wide std. Of a
long recording only a part is read (reading.py).
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from evflow import io
from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.estimation.extent import Extent, covered_s
from evflow.estimation.finish import Stage, estimate
from evflow.estimation.front_end import find_front_end, find_timing
from evflow.estimation.halves import FirstPart, divided
from evflow.estimation.reading import BATCH, BUDGETS, EFFORTS, Effort, Order, gain, ordered
from evflow.estimation.refine import Stretch, cut, pixel_posterior
from evflow.estimation.refine.frame_exposure import with_exposures
from evflow.estimation.result import CameraEstimate
from evflow.estimation.state import State, add, read_stretch, summary_so_far
from evflow.estimation.static import estimate_noise
from evflow.estimation.unpooled import WINDOW_US, estimate_unpooled
from evflow.files.spool import SOME, on_disk
from evflow.network import api
from evflow.network.architecture import config_of
from evflow.network.weights import load_weights
from evflow.recordings.dense import thinned
from evflow.recordings.repeats import without_repeats
from evflow.recordings.stillness import stands_still
from evflow.recordings.windows import WindowPlan, iter_windows, left_out, plan_windows
from evflow.types import Recording, release

Progress = Callable[[int, int], None]
Until = Callable[[Summary, Summary], bool]


def estimate_camera(
    recording_or_path: Recording | str | os.PathLike, params: api.Params | None = None, *,
    refine: Literal["auto", "off"] = "auto", pixel: Literal["measured", "ideal"] = "measured",
    effort: Effort = "normal", min_window_us: int = 40_000, progress: Progress | None = None,
    until: Until | None = None,
) -> CameraEstimate:
    """Measure a camera, pixel by pixel, from a recording with frames.

    For a static scene, or without frames, only the noise is measured. Common faults of recordings
    are not looked for: call `check(recording).raise_if_failed()` first.

    Args:
        recording_or_path: events and frames on one clock, or the path of a file that holds them.
        params: of `load_weights`; None loads the released ones. For the paper's network, which sees
            pixels separately, the maps are the mean over windows, which are shorter (25 ms at
            least), and standard deviations are NaN.
        refine: "auto" corrects the network's estimate by simulation (error of theta .022 to .010).
        pixel: "measured" measures the photoreceptor, and the frames' offset and exposure (unless
            the recording has one, or `recordings.adjust.exposed(recording, 0)` leaves the blur);
            "ideal" assumes ideal pixels and frames.
        effort: how much is read. "normal": of a long recording, stretches spread over it, until the
            errors stop shrinking or a minute's work is done (DAVIS346); "quick": a third of that;
            "full": everything. `.extent` of the result says how much was read, and what more would
            bring. A short recording is read whole.
        min_window_us: minimum length of a window in microseconds; windows run from frame to frame.
        progress: progress(done, total) is called after every window and stretch.
        until: until(summary, std) is called after every stretch with the camera's summary so far
            and its standard deviation, before refinement; if it returns True, reading stops.

    Returns:
        The maps, their standard deviations, the camera's summary, and what to know about them.

    Raises:
        EvflowDataError: EV001 (no events), EV011 (no frames, and the scene moves), EV012 (no
            overlap in time), EV017 (too little), EV018 (weights), EV020; also `read_recording`'s.

    Example:
        >>> ef.estimate_camera("flight.h5").save("camera.npz")
    """
    return measure(recording_or_path, params, refine=refine, pixel=pixel, effort=effort,
                   min_window_us=min_window_us, progress=progress, until=until).found


@dataclasses.dataclass(frozen=True, eq=False)
class Measured:
    """found: the camera. first: what was computed from the recording's first part, to be tested on
    the rest; None if nothing was read of it, or the recording is too short to divide."""

    found: CameraEstimate
    first: FirstPart | None = None


def measure(
    recording_or_path: Recording | str | os.PathLike, params: api.Params | None = None, *,
    refine: Literal["auto", "off"] = "auto", pixel: Literal["measured", "ideal"] = "measured",
    effort: Effort = "normal", min_window_us: int = 40_000, progress: Progress | None = None,
    until: Until | None = None, stage: Stage = lambda _: None,
) -> Measured:
    """`estimate_camera`, with what a report needs. stage(name) is called when one begins."""
    check_options(refine=(refine, ("auto", "off")), pixel=(pixel, ("measured", "ideal")),
                  effort=(effort, EFFORTS))
    for name, call in (("progress", progress), ("until", until)):
        if call is not None and not callable(call):
            raise EvflowDataError("EV020", f"{name}={call!r}.", "It is a function, or None.")
    recording = recording_or_path
    if not isinstance(recording, Recording):
        stage("reading the file")
        with on_disk(SOME):
            recording = io.read_recording(recording)
    recording = thinned(without_repeats(recording))
    if not recording.has_frames or stands_still(recording):
        stage("counting noise")
        return Measured(estimate_noise(recording, alone=False))
    params = load_weights() if params is None else params
    pools = config_of(params).pool
    min_window_us = min_window_us if pools else min(min_window_us, WINDOW_US)
    plan = plan_windows(recording, min_window_us)
    iter_windows(recording, min_window_us, plan)  # EV017 where there is none
    if not pools:
        return Measured(_unpooled(recording, plan, params, progress, stage))
    stretches = cut(recording, plan, path=refine == "auto")
    order = ordered(stretches, effort)
    release(recording)
    stage("looking for the photoreceptor")
    measured = pixel == "measured"
    timing = find_timing(_used(stretches, order), measured=measured)
    stretches = with_exposures(stretches, timing.exposure)
    used = _used(stretches, order)
    state = State(params, find_front_end(used, timing, measured=measured))
    counter = ProgressCounter(used, progress)
    stage("reading stretches")
    division = divided(stretches)
    state, early, extent = _read(state, stretches, order, effort, until, counter,
                                 division.first if division else range(0))
    left = [n for n in recording.notes if n.code in ("frames.repeated", "frames.dense")]
    found = estimate(state, extent=extent, before=left_out(recording, plan), after=left,
                     advance=counter.advance, stage=stage)
    counter.finish()
    first = FirstPart(early, tuple(used), division.rest) if division and early.read else None
    return Measured(found, first)


def _used(stretches: Sequence[Stretch], order: Order) -> list[Stretch]:
    """Those that are read, in time order."""
    return [stretches[i] for i in sorted(order.numbers)]


def _unpooled(
    recording: Recording, plan: WindowPlan, params: api.Params, progress: Progress | None,
    stage: Stage,
) -> CameraEstimate:
    """`estimate_unpooled`, with its progress."""
    stage("estimating window by window")
    done = itertools.count(1)

    def advance() -> None:
        if progress:
            progress(next(done), len(plan.pairs))

    return estimate_unpooled(recording, iter_windows(recording, plan=plan), params,
                             before=left_out(recording, plan), advance=advance)


def read_whole(recording: Recording, params: api.Params) -> State:
    """All usable windows of a recording with frames. Raises EV017 if there are none."""
    plan = plan_windows(recording)
    iter_windows(recording, plan=plan)
    stretches = cut(recording, plan)
    timing = find_timing(stretches, measured=True)
    stretches = with_exposures(stretches, timing.exposure)
    state = State(params, find_front_end(stretches, timing, measured=True))
    simulated = ordered(stretches, "full").simulated
    for i, stretch in enumerate(stretches):
        state = add(state, stretch, simulate=i in simulated)
    return state


def check_options(**options: tuple[str, Sequence[str]]) -> None:
    """Raise EV020 for a value that is not one of the known ones."""
    for name, (value, known) in options.items():
        if value not in known:
            raise EvflowDataError("EV020", f"{name}={value!r}.", f"Choose from {tuple(known)}.")


class ProgressCounter:
    """Counts finished work for `progress`: windows and stretches that are read, and windows that
    are read again; if reading stops early, the rest is counted at once."""

    def __init__(self, stretches: Sequence[Stretch], progress: Progress | None) -> None:
        windows = sum(len(s.windows) for s in stretches)
        paths = sum(bool(s.run) for s in stretches)
        self.done, self.total = 0, windows * (2 if paths else 3) + paths
        self.progress = progress

    def advance(self) -> None:
        self.done += 1
        if self.progress:
            self.progress(self.done, self.total)

    def finish(self) -> None:
        if self.progress and self.done < self.total:
            self.progress(self.total, self.total)


def _read(
    state: State, stretches: Sequence[Stretch], order: Order, effort: Effort,
    until: Until | None, counter: ProgressCounter, first: range,
) -> tuple[State, State, Extent]:
    """The state after the ordered stretches, the state after those of the first part, and how much
    was read."""
    partial, early = len(order.numbers) < len(stretches), state
    history: list[tuple[int, float]] = []
    read: list[int] = []
    ended = False
    for i in order.numbers:
        one = read_stretch(state, stretches[i], simulate=i in order.simulated,
                           every=order.every, advance=counter.advance)
        state, early = state + one, early + one if i in first else early
        del one  # maps of the whole sensor
        read.append(i)
        ended = until is not None and until(*summary_so_far(state))
        if ended:
            break
        if partial and state.evidence is not None and len(read) % BATCH == 0:
            history.append((len(read), _variance(state)))
            if order.simulated <= set(read) and gain(history) < BUDGETS[effort].enough:
                break
    if partial and state.evidence is not None and history and history[-1][0] < len(read):
        history.append((len(read), _variance(state)))
    spans = [s.span_us for s in stretches]
    return state, early, Extent(
        covered_s(spans[i] for i in read), covered_s(spans), len(read), len(stretches),
        gain(history), ended and len(read) < len(order.numbers))


def _variance(state: State) -> float:
    """Median variance of the pixels' thresholds so far."""
    assert state.evidence is not None
    return float(np.median(pixel_posterior(state.evidence, summary_so_far(state)[0])[1] ** 2))
