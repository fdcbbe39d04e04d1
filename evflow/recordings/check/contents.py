"""Rules on the events: both polarities, enough of them, each once, and not from a few pixels
only."""

from __future__ import annotations

import itertools

import numpy as np

from evflow.notes import why_no_frames
from evflow.recordings.check.findings import Finding
from evflow.recordings.faulty_pixels import MOVING_FACTOR, hot_among_neighbours
from evflow.types import Events, Recording

LEAST_EVENTS = 1_000  # with this many, a single polarity is no accident
ONE_SHARE = 0.99
VALID_EVENTS = 3  # fewer say next to nothing about a pixel
ACTIVE_SHARE = 0.05  # of the pixels should have this many
HOT_SHARE = 0.05  # of the events
BLOCKS, BLOCK = 8, 1 << 17  # events searched for repeats: of a long recording, evenly spread
REPEATED_SHARE, MOST_REPEATED = 0.01, 0.1  # of the events: a warning, an error
COARSE = 0.25  # distinct times, as a share of those of events at random: fewer lie on a grid


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
        "Export it again with signed integers, or bool. (Leak in the dark is ON too: --protocol "
        "static measures it.)")]


def _few(counts: np.ndarray) -> list[Finding]:
    active = float((counts.sum(0) >= VALID_EVENTS).mean())
    if active >= ACTIVE_SHARE:
        return []
    return [Finding(
        "EV017", "warning", f"only {active:.1%} of the pixels have {VALID_EVENTS} or more events: "
        "elsewhere the maps show the camera's summary.", "Record more motion and texture.")]


def repeated(events: Events) -> list[Finding]:
    """EV038 if events repeat others exactly. A pixel cannot send one polarity twice in the same
    microsecond; events of a simulator whose clock is coarse can."""
    count = repeats = 0
    for part in _blocks(len(events)):
        t = events.t[part] - events.t[part.start]
        pixel = events.y[part].astype(np.int64) * events.size[0] + events.x[part]
        code = np.sort((t * (events.size[0] * events.size[1]) + pixel) * 2 + events.p[part])
        span, distinct = int(t[-1]) + 1, 1 + int((np.diff(t) > 0).sum())
        if distinct < COARSE * span * -np.expm1(-len(t) / span):
            continue
        count, repeats = count + len(t), repeats + int((np.diff(code) == 0).sum())
    if repeats <= REPEATED_SHARE * max(count, LEAST_EVENTS):
        return []
    share = repeats / count
    return [Finding(
        "EV038", "error" if share > MOST_REPEATED else "warning",
        f"{share:.0%} of {count:,} events repeat another of the same pixel, time and polarity, "
        "which no camera sends: were they written twice, or overlapping parts joined? Thresholds "
        "would come out too low.",
        "Keep each once: in Python, np.unique(np.stack([t, x, y, p], 1), axis=0).")]


def _blocks(count: int) -> list[slice]:
    """Blocks of events without overlap: all of them, or as many as are searched."""
    if count > BLOCKS * BLOCK:
        return [slice(first, first + BLOCK)
                for first in np.linspace(0, count - BLOCK, BLOCKS).astype(int).tolist()]
    ends = np.linspace(0, count, -(-count // BLOCK) + 1).astype(int).tolist()
    return [slice(*pair) for pair in itertools.pairwise(ends)]


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
