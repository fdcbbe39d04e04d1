"""What the fits of the refinement share: where it starts, and how wide its intervals are made."""

from __future__ import annotations

from typing import Any

from evflow import Recording, finish
from evflow.camera import Summary
from evflow.estimation.pipeline import read_whole
from evflow.estimation.pooled import pool_recording
from evflow.estimation.refine import Chunk, refinement_chunks
from evflow.estimation.state import refine
from evflow.recordings.windows import plan_windows

COVERED = 0.7  # by one std: a little more than 68 %, as the tails are heavier than a Gaussian's


def undoubted(params: Any, recording: Recording) -> tuple[Any, Summary, Summary] | None:
    """What refine/doubt.py goes by, and the summary and its std without it; None where too little
    happens."""
    if len(recording.events) < 10 or not plan_windows(recording).pairs:
        return None
    refined = refine(read_whole(recording, params))
    return None if refined.signs is None else (refined.signs, refined.summary, refined.std)


def before_refinement(
    params: Any, recording: Recording
) -> tuple[list[Chunk], Summary, Summary] | None:
    """What the refinement starts from: chunks, the network's summary and its std; None where
    nothing fired."""
    if len(recording.events) < 10:
        return None
    plan = plan_windows(recording)
    if not plan.pairs:
        return None
    stats, _ = pool_recording(params, recording)
    return refinement_chunks(recording, plan.pairs), *finish(params, stats)
