"""Whole recordings: stretches -> a state -> the camera.

The windows are pooled: their `Stats` add up to the network's summary. What is between the frames
is looked at stretch by stretch (refine/): some are simulated, to refine the summary, and the
regression on all of them gives each pixel's thresholds. The flow is not run. Only without a path
between the frames (refine="off", or frames too small for optical flow) the flow estimates every
pixel of every window, and the windows are fused by their precision. Noise rates are those of the
quiet time, either way. A pixel that says nothing keeps the camera's summary, with a wide std.
Of a long recording a part is read (reading.py).
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
from evflow.estimation.extent import Extent
from evflow.estimation.halves import First, divided
from evflow.estimation.reading import BATCH, BUDGETS, EFFORTS, Effort, Order, gain, ordered
from evflow.estimation.refine import Stretch, cut, pixel_posterior
from evflow.estimation.result import CameraEstimate
from evflow.estimation.state import Stage, State, add, estimate, glance, look, looked_through
from evflow.estimation.static import estimate_noise
from evflow.estimation.unpooled import WINDOW_US, estimate_unpooled
from evflow.files.spool import SOME, on_disk
from evflow.network import api
from evflow.network.architecture import config_of
from evflow.network.weights import load_weights
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

    Of a scene that stands still, or without frames, the noise alone is measured. What usually goes
    wrong with a recording is not looked for here: `check(recording).raise_if_failed()` before.

    Args:
        recording_or_path: events and frames on one clock, or the path of a file that holds them.
        params: of `load_weights`; None loads the released ones. Of the paper's network, which sees
            pixels alone, the maps are the mean of its windows', which are shorter (25 ms at least),
            and standard deviations NaN.
        refine: "auto" corrects the network's estimate by simulation (error of theta .022 to .011).
        pixel: "measured" looks for the photoreceptor and for what frames do not show; "ideal" takes
            pixels and frames at their word.
        effort: how much is read. "normal": of a long recording stretches that are spread over it,
            until the errors stop shrinking or as many are read as take a minute for a DAVIS346;
            "quick": a third of that; "full": everything. `.extent` of the result says how much it
            was, and what more would bring. A short recording is read whole.
        min_window_us: windows run from frame to frame until at least this long, microseconds.
        progress: progress(done, total) is called after every window and stretch.
        until: until(summary, std) is called after every stretch with the camera's summary so far
            and its standard deviation, before refinement; where it returns True, no more is read.

    Returns:
        The maps, their standard deviations, the camera's summary, and what to know about them.

    Raises:
        EvflowDataError: EV001 (no events), EV011 (no frames, and no scene at rest), EV012 (no
            overlap in time), EV017 (too little), EV018 (weights), EV020; also `read_recording`'s.

    Example:
        >>> ef.estimate_camera("flight.h5").save("camera.npz")
    """
    return measure(recording_or_path, params, refine=refine, pixel=pixel, effort=effort,
                   min_window_us=min_window_us, progress=progress, until=until).found


@dataclasses.dataclass(frozen=True, eq=False)
class Measured:
    """found: the camera. first: what was made of the recording's first part, to be tried on the
    rest; None where nothing was read of it, or the recording is too short to be divided."""

    found: CameraEstimate
    first: First | None = None


def measure(
    recording_or_path: Recording | str | os.PathLike, params: api.Params | None = None, *,
    refine: Literal["auto", "off"] = "auto", pixel: Literal["measured", "ideal"] = "measured",
    effort: Effort = "normal", min_window_us: int = 40_000, progress: Progress | None = None,
    until: Until | None = None, stage: Stage = lambda _: None,
) -> Measured:
    """`estimate_camera`, with what a report takes up. stage(name) is called when one begins."""
    check_options(refine=(refine, ("auto", "off")), pixel=(pixel, ("measured", "ideal")),
                  effort=(effort, EFFORTS))
    recording = recording_or_path
    if not isinstance(recording, Recording):
        stage("reading the file")
        with on_disk(SOME):
            recording = io.read_recording(recording)
    recording = without_repeats(recording)
    if not recording.has_frames or stands_still(recording):
        stage("counting noise")
        return Measured(estimate_noise(recording))
    params = load_weights() if params is None else params
    pools = config_of(params).pool
    min_window_us = min_window_us if pools else min(min_window_us, WINDOW_US)
    plan = plan_windows(recording, min_window_us)
    iter_windows(recording, min_window_us, plan)  # EV017 where there is none
    if not pools:
        return Measured(_unpooled(recording, plan, params, progress, stage))
    stretches = cut(recording, plan, path=refine == "auto")
    order = ordered(stretches, effort)
    used = [stretches[i] for i in sorted(order.numbers)]
    release(recording)
    stage("looking for the photoreceptor")
    state = State(params, looked_through(used, measured=pixel == "measured"))
    steps = Steps(used, progress)
    stage("reading stretches")
    division = divided(stretches)
    state, early, extent = _read(state, stretches, order, effort, until, steps,
                                 division.first if division else range(0))
    repeated = [note for note in recording.notes if note.code == "frames.repeated"]
    found = estimate(state, extent=extent, before=left_out(recording, plan), after=repeated,
                     advance=steps.advance, stage=stage)
    steps.finish()
    first = First(early, tuple(used), division.rest) if division and early.read else None
    return Measured(found, first)


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
    """All of a recording with frames that can be used. Raises EV017 where there is none."""
    plan = plan_windows(recording)
    iter_windows(recording, plan=plan)
    stretches = cut(recording, plan)
    state = State(params, looked_through(stretches, measured=True))
    simulated = ordered(stretches, "full").simulated
    for i, stretch in enumerate(stretches):
        state = add(state, stretch, simulate=i in simulated)
    return state


def check_options(**options: tuple[str, Sequence[str]]) -> None:
    """EV020 for a value that is none of those known."""
    for name, (value, known) in options.items():
        if value not in known:
            raise EvflowDataError("EV020", f"{name}={value!r}.", f"Choose from {tuple(known)}.")


class Steps:
    """Counts what is done for `progress`: windows and stretches that are read, and windows that
    are read again; where reading ends early, the rest at once."""

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
    until: Until | None, steps: Steps, first: range,
) -> tuple[State, State, Extent]:
    """The state with the stretches of the order, that with those of them in the first part, and
    how much they are."""
    partial, early = len(order.numbers) < len(stretches), state
    history: list[tuple[int, float]] = []
    read: list[int] = []
    ended = False
    for i in order.numbers:
        seen = look(state, stretches[i], simulate=i in order.simulated, every=order.every,
                    advance=steps.advance)
        state, early = state + seen, early + seen if i in first else early
        del seen  # maps of the whole sensor
        read.append(i)
        ended = until is not None and until(*glance(state))
        if ended:
            break
        if partial and state.evidence is not None and len(read) % BATCH == 0:
            history.append((len(read), _variance(state)))
            if order.simulated <= set(read) and gain(history) < BUDGETS[effort].enough:
                break
    if partial and state.evidence is not None and history and history[-1][0] < len(read):
        history.append((len(read), _variance(state)))
    spans = np.array([s.span_us for s in stretches])
    seconds = np.diff(spans, axis=1)[:, 0] * 1e-6
    return state, early, Extent(float(seconds[read].sum()), float(seconds.sum()), len(read),
                                len(stretches), gain(history),
                                ended and len(read) < len(order.numbers))


def _variance(state: State) -> float:
    """Median variance of the pixels' thresholds so far."""
    assert state.evidence is not None
    return float(np.median(pixel_posterior(state.evidence, glance(state)[0])[1] ** 2))
