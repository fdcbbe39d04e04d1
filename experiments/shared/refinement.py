"""Shared by the fits of the refinement: its inputs, and the coverage of its intervals."""

from __future__ import annotations

from typing import Any

from evflow import Recording, finish
from evflow.camera import Summary
from evflow.estimation.finish import refine
from evflow.estimation.pipeline import read_whole
from evflow.estimation.pooled import pool_recording
from evflow.estimation.refine import Chunk, refinement_chunks
from evflow.recordings.windows import plan_windows

COVERED = 0.7  # by one std: a little more than 68 %, as the tails are heavier than a Gaussian's


def undoubted(params: Any, recording: Recording) -> tuple[Any, Summary, Summary] | None:
    """The signs of refine/doubt.py, and the summary and its std before it is applied; None with too
    few events."""
    if len(recording.events) < 10 or not plan_windows(recording).pairs:
        return None
    refined = refine(read_whole(recording, params))
    return None if refined.signs is None else (refined.signs, refined.summary, refined.std)


def before_refinement(
    params: Any, recording: Recording
) -> tuple[list[Chunk], Summary, Summary] | None:
    """Inputs of the refinement: chunks, the network's summary and its std; None without events."""
    if len(recording.events) < 10:
        return None
    plan = plan_windows(recording)
    if not plan.pairs:
        return None
    stats, _ = pool_recording(params, recording)
    return refinement_chunks(recording, plan.pairs), *finish(params, stats)
