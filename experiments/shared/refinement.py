"""Shared by the fits of the refinement: its inputs, and the coverage of its intervals."""

from __future__ import annotations

from typing import Any, NamedTuple

from evflow import Recording
from evflow.camera import Summary
from evflow.estimation.finish import starting
from evflow.estimation.front_end import FrontEnd
from evflow.estimation.pipeline import read_whole
from evflow.estimation.refine import Chunk, Refined, refine_summary
from evflow.recordings.windows import plan_windows

COVERED = 0.7  # by one std: a little more than 68 %, as the tails are heavier than a Gaussian's


class Begun(NamedTuple):
    """A recording before its refinement: the chunks, the camera's summary so far and its std."""

    chunks: list[Chunk]
    summary: Summary
    std: Summary
    front_end: FrontEnd

    def stepped(self) -> Refined:
        """The summary after the Gauss-Newton steps, and the fusion's features."""
        seen = self.front_end
        return refine_summary(self.chunks, self.summary, self.std,
                              found=seen.found, noise_dn=seen.noise_dn, blur_s=seen.blur_s)


def begun(params: Any, recording: Recording) -> Begun | None:
    """A recording up to its refinement; None with too few events, or no path between frames."""
    if len(recording.events) < 10 or not plan_windows(recording).pairs:
        return None
    state = read_whole(recording, params)
    if state.quiet is None:
        return None
    start = starting(state)
    return Begun(list(start.chunks), start.summary, start.std, state.front_end)
