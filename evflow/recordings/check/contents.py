"""Rules on the events: both polarities, enough of them, and not from a few pixels only."""

from __future__ import annotations

import numpy as np

from evflow.notes import why_no_frames
from evflow.recordings.check.findings import Finding
from evflow.recordings.faulty_pixels import MOVING_FACTOR, hot_among_neighbours
from evflow.types import Recording

LEAST_EVENTS = 1_000  # with this many, a single polarity is no accident
ONE_SHARE = 0.99
VALID_EVENTS = 3  # fewer say next to nothing about a pixel
ACTIVE_SHARE = 0.05  # of the pixels should have this many
HOT_SHARE = 0.05  # of the events


def contents(recording: Recording) -> list[Finding]:
    """EV001 (no events), EV011 (no frames), EV022 (polarity lost), EV017 (few events), EV033
    (hot pixels)."""
    events = recording.events
    if not len(events):
        return [Finding("EV001", "error", "the recording has no events.",
                        "Check --start and --stop, and that the camera was recording.")]
    counts = events.count_map()
    found = [] if recording.has_frames else [Finding(
        "EV011", "warning", "the recording has events but no frames"
        f"{why_no_frames(recording.notes)}: thresholds cannot be measured without intensity.",
        "Provide frames, --frames DIR --timestamps FILE, or let a network guess them (evflow "
        "estimate --reconstruct); for a static scene the noise alone can be estimated.")]
    return [*found, *_one_polarity(counts), *_few(counts), *_hot(counts.sum(0))]


def _one_polarity(counts: np.ndarray) -> list[Finding]:
    on, off = (int(n) for n in counts.sum((1, 2), dtype=np.int64))
    share, name = max((on / (on + off), "ON"), (off / (on + off), "OFF"))
    if on + off < LEAST_EVENTS or share <= ONE_SHARE:
        return []
    return [Finding(
        "EV022", "error", f"{share:.1%} of {on + off:,} events are {name}: polarity was probably "
        "lost in a conversion (-1 becomes True as bool, 255 as uint8).",
        "Export it again with signed integers, or bool.")]


def _few(counts: np.ndarray) -> list[Finding]:
    active = float((counts.sum(0) >= VALID_EVENTS).mean())
    if active >= ACTIVE_SHARE:
        return []
    return [Finding(
        "EV017", "warning", f"only {active:.1%} of the pixels have {VALID_EVENTS} or more events: "
        "elsewhere the maps show the camera's summary.", "Record more motion and texture.")]


def _hot(counts: np.ndarray) -> list[Finding]:
    hot = hot_among_neighbours(counts)
    share = float(counts[hot].sum()) / float(counts.sum())
    if share <= HOT_SHARE:
        return []
    y, x = np.unravel_index(int(np.argmax(np.where(hot, counts, 0))), counts.shape)
    return [Finding(
        "EV033", "note", f"{hot.sum():,} pixels ({hot.mean():.2%}) send {share:.0%} of the events, "
        f"each {MOVING_FACTOR:g} times as many as its neighbours; the busiest is x={x}, y={y} "
        f"({counts[y, x]:,}): hot pixels, or very low thresholds.",
        "An estimate lists hot pixels in camera.json and leaves them out of its summary.")]
