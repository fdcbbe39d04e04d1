"""Which steps and rests of a bench its events cover, and which steps have lost events.

The light's rests come from frames or triggers. The events may begin later or end earlier, and a
full bus loses packets where all pixels fire. A silence shows that events are missing if the noise
at rest makes it improbable; lost events of a step show by comparison with the other steps.
"""

from __future__ import annotations

import numpy as np

from evflow.errors import EvflowDataError
from evflow.notes import Note
from evflow.recordings.faulty_pixels import hot_at_rest
from evflow.types import Events

Span = tuple[int, int]

SILENT = 20.0  # noise events expected in a silence by which events are missing
UNUSUAL = 10.0  # and its length over the 95th percentile of the pauses: noise varies with light
LEAST_STEPS = 3  # of a direction: among two it is open which one lacks events
LOST, LOST_EVENTS = 0.6, 1.0  # share of the predicted events, and events per pixel less than those


def noise_us(events: Events, quiet: list[Span], up: np.ndarray) -> np.ndarray:
    """(R,) mean time in us between noise events of the whole sensor without hot pixels, at each of
    the rests. The median over those after steps of the same direction, as leak comes after rises
    alone, and of their second halves, as slow pixels still answer to a step in the first. Infinite
    without noise. up: (R - 1,) bool, the steps between the rests."""
    halves = [((a + b) // 2, b) for a, b in quiet]
    inside = np.array([b > int(events.t[0]) and a < int(events.t[-1]) for a, b in halves])
    counts = np.array([events.slice(*half).count_map().sum(0) for half in halves])
    kept = ~hot_at_rest(counts[inside].sum(0)) if inside.any() else np.ones(counts.shape[1:], bool)
    rates = counts[:, kept].sum(1) / np.array([max(b - a, 1) for a, b in halves])
    found = np.full(len(quiet), np.median(rates[inside]) if inside.any() else 0.0)
    for alike in (np.concatenate([[False], up == side]) for side in (True, False)):
        if (alike & inside).any():
            found[alike] = np.median(rates[alike & inside])
    found[0] = found.min()  # what was before it is not known
    return np.divide(1.0, found, out=np.full(len(found), np.inf), where=found > 0)


def covered(events: Events, spans: list[Span], settled: list[int], noise: float) -> slice:
    """Those of the rests between which the events are complete.

    Args:
        events: of the recording.
        spans: the R rests.
        settled: (R,) times until which events belong to the step that leads to a rest.
        noise: us between noise events.

    Raises:
        EvflowDataError: EV017 if the events cover no step.
    """
    permitted = SILENT * noise
    begin, end = int(events.t[0]) - permitted, int(events.t[-1]) + permitted
    inside = [i for i, span in enumerate(spans) if span[1] >= begin and settled[i] <= end]
    if len(inside) < 2:
        raise EvflowDataError(
            "EV017", f"of {len(spans) - 1} steps of the light none lies between the first event, "
            f"{events.t[0] * 1e-6:.3f} s, and the last, {events.t[-1] * 1e-6:.3f} s.",
            "Start the events before the light steps and stop them after it; are frames, triggers "
            "and events on one clock?")
    return slice(inside[0], inside[-1] + 1)


def watched(events: Events, span: Span, noise: float, late_us: float = 0.0) -> Span:
    """The longest part of a rest without a silence that its noise makes improbable; all of it where
    several silences leave less than half, as between the bursts of a flickering light. late_us: how
    long it may be silent at first, as leak begins late after the light fell."""
    t = events.slice(*span).t
    bounds = np.concatenate([[span[0]], t, [span[1]]])
    pauses = np.diff(bounds)
    usual = float(np.quantile(pauses, 0.95)) if len(t) else 0.0
    if len(t) and pauses[0] < late_us:
        pauses[0] = 0
    silent = np.flatnonzero(pauses > max(SILENT * noise, UNUSUAL * usual))
    if not len(silent):
        return span
    begins, ends = bounds[[0, *(silent + 1)]], bounds[[*silent, -1]]
    longest = int(np.argmax(ends - begins))
    kept = int(begins[longest]), int(ends[longest])
    return span if len(silent) > 1 and 2 * (kept[1] - kept[0]) < span[1] - span[0] else kept


def lost_steps(changes: np.ndarray, sent: np.ndarray, sized: np.ndarray) -> np.ndarray:
    """(K,) bool: steps with far fewer events than the other steps' thresholds predict.

    Args:
        changes: (K,) log units.
        sent: (K, 2) ON and OFF events per pixel minus the noise.
        sized: (K,) bool, steps whose change is known.
    """
    up = changes > 0
    own = np.where(up, sent[:, 0], sent[:, 1])
    # After a step in the other direction the memory must first return: about an event less.
    events = own + np.diff(up, prepend=not up[0])
    lost = np.zeros(len(changes), bool)
    for side in (up & sized, ~up & sized):
        if side.sum() >= LEAST_STEPS and (known := side & (events > 0)).any():
            predicted = np.abs(changes) / np.median(np.abs(changes[known]) / events[known])
            less = (events < predicted - LOST_EVENTS) & (own < LOST * (predicted - events + own))
            lost |= side & less
    return lost


def skipped_notes(uncovered: int, silent_s: float, lost: np.ndarray) -> list[Note]:
    """Notes on steps beyond the events, on silences in rests, and on lost (K,) steps."""
    found = []
    if uncovered:
        found.append(Note("steps.skipped", f"{uncovered} of {uncovered + len(lost)} steps of the "
                          "light are left out: they lie before the first event or after the "
                          "last."))
    if silent_s:
        found.append(Note("events.gaps", f"for {silent_s:.3g} s at rest no pixel sent an event, as "
                          "where packets are lost or the recording ends: the noise rates refer to "
                          "the time that is left."))
    if lost.any():
        which = ", ".join(str(k + 1) for k in np.flatnonzero(lost))
        found.append(Note("steps.skipped", f"{lost.sum()} of {len(lost)} steps of the light are "
                          f"left out (number {which}): they sent far fewer events than the others "
                          "predict. Were packets lost there? Record a part of the sensor, or "
                          "smaller steps."))
    return found
