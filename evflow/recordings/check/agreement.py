"""Do events and frames agree? A pixel's net events (ON minus OFF) follow the change of its log
brightness; their correlation over cells of pixels and frame intervals shows whether polarity, clock
and orientation are those of one camera.

The sweep over the frames' clock peaks late: a pixel fires once brightness has moved by a threshold,
so events trail it, by 0-10 ms in the recordings measured. The mean delay is subtracted, and an
offset is only reported beyond max(half a frame interval, 10 ms).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from evflow.io.decode.misread import too_few
from evflow.recordings.check.drift import backwards, drifting
from evflow.recordings.check.findings import Finding
from evflow.recordings.check.rows import rolling
from evflow.recordings.check.steps import (
    LEAST_CELLS,
    LEAST_EVENTS,
    TURNED,
    Steps,
    displacement,
    frame_steps,
    never_changes,
)
from evflow.recordings.stillness import MOVING, coincidence_excess
from evflow.types import Recording

INVERTED = -0.2  # correlation below which polarity is inverted
AGREES, BETTER = 0.2, 0.1  # minimum correlation of another interpretation, and its gain
CHANCE = 8.0  # over the root of the number of cells: more than r of any displacement by chance
UNRELATED = 0.06  # maximum over all interpretations; 26 recordings that agree have at least .12
STRONG = 0.3  # mean change of log brightness in a cell, above noise and drift
LEAST_CHANGE, MOST_THETA = 500.0, 10.0  # log units in all; real recordings have >= .4 per event
PARTS, IN_PART = 4, 0.4  # of the steps; least r of the best one
LOST, SHOWN = 0.25, 0.25  # share of that r below which another part disagrees (the least in 28
# sound recordings is .4), if its frames change by at least that share
LEAST_OFFSET_US = 10_000
ALIKE, ONE_SIDED = 0.8, 0.2  # least cosine of change and net events of the whole image, and least
# share of net events among all, where nothing but the light changes
USABLE = (0.03, 1.0)  # log units per event: thresholds of such light
STEADY = 0.1  # log units by which the change of cells then differs, rms: noise of frames


def agreement(recording: Recording) -> list[Finding]:
    """EV021 (polarity inverted), EV023 (times stretched), EV024 (clocks not aligned), EV029 (frames
    mirrored), EV034 (frames and events unrelated), EV037 (frames displaced)."""
    steps = frame_steps(recording)
    if steps is None:
        return []
    found = _judged(recording, steps)
    late = rolling(steps) if all(f.code == "EV024" for f in found) else None
    return [*found, late] if late else found


def _judged(recording: Recording, steps: Steps) -> list[Finding]:
    """What `agreement` finds, but for frames that are read row by row."""
    if wrong := _missing(steps) or _frozen(recording, steps):
        return wrong
    if np.isnan(here := steps.correlation()):
        return []
    r = steps.sweep()
    flips = {flip: steps.correlation(flip=flip) for flip in steps.changes if flip}
    flip = max(flips, key=lambda f: abs(flips[f]))
    otherwise = max(float(np.nanmax(np.abs(r))), abs(flips[flip]))
    if found := backwards(steps, otherwise) or drifting(steps) or _comes_and_goes(steps):
        return [found]
    if abs(flips[flip]) > AGREES and abs(flips[flip]) > np.nanmax(np.abs(r)) + BETTER:
        return [_mirrored(flip, here, flips[flip])]
    if wrong := _displaced(steps, float(np.nanmax(np.abs(r)))):
        return wrong
    over = f"r={here:+.2f} over {len(steps.bounds)} frame steps"
    inverted = _inverted(r)
    if inverted:
        offset, best = steps.peak(-r)
        late = _is_offset(steps, offset, best, -here)
        also = (f" The frame times are off too: add {offset / 1e3:.1f} to --frames-offset-ms."
                if late else "")
        return [Finding(
            "EV021", "error", "events and frame brightness anti-correlate "
            f"({over}{f', {-best:+.2f} at its clearest' if late else ''}): ON and OFF are swapped.",
            "Pass --polarity invert (polarity='invert'), or remove it if it was passed; or "
            f"check the exporter.{also}")]
    offset, best = steps.peak(r)
    if _is_offset(steps, offset, best, here):
        side = "late" if offset < 0 else "early"
        severity: Literal["error", "warning"] = "error" if here < 0.5 * best else "warning"
        return [Finding(
            "EV024", severity, f"frame times are about {abs(offset) / 1e3:.1f} ms too {side} for "
            f"the events (r {here:+.2f}, {best:+.2f} where they agree best).",
            f"Pass --frames-offset-ms {offset / 1e3:.1f}, in addition to what was passed, or "
            "--frames-offset-ms auto.")]
    if max(best, abs(flips[flip])) < UNRELATED and steps.enough() and not _by_light(steps):
        return [Finding(
            "EV034", "error", f"events and frames are unrelated ({over}; no shift, flip or "
            "polarity improves it).",
            "Are they from one camera and one time? Are coordinates transposed, or is the time "
            "unit wrong (--time-unit)? Nothing can be measured from them.")]
    return []


def _by_light(steps: Steps) -> bool:
    """Whether the light of the whole scene changes, events follow, and nothing else happens. Sums
    so far are compared: pixels of one threshold, as of a simulation, fire together now and then."""
    change, net, *_, count = steps.sums(np.zeros(1, np.int64))[..., 0].T
    light, sent = np.cumsum(change), np.cumsum(net)
    both, power = float((light * sent).sum()), float((sent**2).sum())
    theta = both / max(power, 1.0)
    cells = steps.changes[""]
    unlike = np.sqrt(np.nanmean((cells - np.nanmean(cells, 1, keepdims=True)) ** 2)) / steps.cell**2
    return bool(both > ALIKE * np.sqrt((light**2).sum() * power) and USABLE[0] < theta < USABLE[1]
                and np.abs(net).sum() > ONE_SIDED * count.sum() and unlike < STEADY)


def _mirrored(flip: str, here: float, best: float) -> Finding:
    """EV029, given r of the recording and of the one with mirrored frames."""
    swapped = " and with ON and OFF swapped" if best < 0 else ""
    also = " --polarity invert" if best < 0 else ""
    turned, flip = TURNED in flip, flip.removesuffix(TURNED)
    axis = "both axes" if flip == "both" else f"the {flip} axis"
    if turned:
        then = f", then mirrored in {axis}" if flip else ""
        return Finding(
            "EV029", "error", f"events and frames agree only with rows and columns of the frames "
            f"swapped{then}{swapped} (r {here:+.2f} -> {abs(best):+.2f}).",
            "Are x and y of the events swapped, or are the frames rotated? Swap those columns in "
            f"the export{f', pass{also}' if also else ''}, then check again.")
    return Finding(
        "EV029", "error", f"events and frames agree only with the frames mirrored in {axis}"
        f"{swapped} (r {here:+.2f} -> {abs(best):+.2f}).",
        f"Pass --flip-frames {flip}{also}, or remove what was passed.")


def _missing(steps: Steps) -> list[Finding]:
    """EV023 if frames change far more than so few events allow at any threshold: a short excerpt of
    events whose times are stretched."""
    change = np.abs(steps.changes[""])
    shown = float(change[change > STRONG * steps.cell**2].sum())
    count = steps.most_events()
    if shown < LEAST_CHANGE or count > shown / MOST_THETA:
        return []
    wrong = too_few(count, shown)
    return [Finding("EV023", "warning", wrong.seen, f"Are event times too long? Pass --time-unit "
                    f"{wrong.unit}; or are the frames from another recording?")]


def _frozen(recording: Recording, steps: Steps) -> list[Finding]:
    """EV034 if the frames never change while something moves past the pixels."""
    events = recording.events
    still = all(not np.nan_to_num(change).any() for change in steps.changes[""])
    if not still or np.isnan(steps.changes[""]).all() or len(events) < LEAST_EVENTS:
        return []
    if not never_changes(recording.frames):  # but in frames that belong to no window
        return []
    if coincidence_excess(events, np.zeros(events.size[::-1], bool)) <= MOVING:
        return []
    return [Finding(
        "EV034", "error", f"all {len(recording.frames):,} frames are alike, but "
        f"the {len(events):,} events are those of a scene that moves.",
        "Did the frame camera stop, or was one frame written again and again? Nothing can be "
        "measured from such frames; --no-frames uses the events alone.")]


def _comes_and_goes(steps: Steps) -> Finding | None:
    """EV024 if events and frames agree in one part of the recording and not in another, though the
    frames change there as well."""
    parts = steps.parts(PARTS)
    middle = len(steps.offsets_us) // 2
    r = np.array([steps.sweep(part)[middle] for part in parts])
    changes = [steps.changes[""][part] for part in parts]
    rms = np.array([np.sqrt((np.nan_to_num(change) ** 2).sum() / max(
        int(np.isfinite(change).sum()), 1)) for change in changes])
    if np.isnan(r).all() or not (most := float(np.nanmax(r))) > IN_PART:
        return None
    lost = (r < LOST * most) & (rms > SHOWN * rms[np.nanargmax(r)])
    if not lost.any():
        return None
    at, off = (float(steps.bounds[parts[i]].mean() - steps.events.t[0]) / 1e6
               for i in (np.nanargmax(r), np.argmin(np.where(lost, r, np.inf))))
    return Finding(
        "EV024", "error" if lost.sum() >= PARTS / 2 else "warning",
        f"events and frames agree around {at:.2f} s (r {most:+.2f}) but not around {off:.2f} s "
        f"(r {r[lost].min():+.2f}).",
        "Do the frames' times run too fast or slow (--frames-fps, --timestamps), are frames out of "
        "order, or does the polarity change? --start and --stop select a part that agrees.")


def _displaced(steps: Steps, best: float) -> list[Finding]:
    """EV037 if events and frames agree better some pixels apart than at any time offset."""
    cells = int(np.isfinite(steps.changes[""]).sum())
    here, r, dx, dy = displacement(steps)
    least = max(AGREES, max(best, here) + max(BETTER, CHANCE / np.sqrt(max(cells, 1))))
    if r < least or cells < LEAST_CELLS:
        return []
    return [Finding(
        "EV037", "error", f"events lie about {abs(dx)} px to the {'right' if dx > 0 else 'left'} "
        f"and {abs(dy)} px {'below' if dy > 0 else 'above'} what the frames show (r {here:+.2f}, "
        f"{r:+.2f} so far apart).",
        "Is one of them a part (ROI) of the sensor whose corner was not added, or from a second "
        f"sensor? Write the events with x {-dx:+d} and y {-dy:+d}, then check again.")]


def frames_offset(recording: Recording) -> int:
    """By how many us to shift the frame times so that they agree with the events, of either
    polarity; 0 if they already do, or if it cannot be determined."""
    steps = frame_steps(recording)
    if steps is None or np.isnan(here := steps.correlation()):
        return 0
    r = steps.sweep()
    sign = -1.0 if _inverted(r) else 1.0
    offset, best = steps.peak(sign * r)
    return offset if _is_offset(steps, offset, best, sign * here) else 0


def _inverted(r: np.ndarray) -> bool:
    """Whether the sweep has its largest magnitude where events and frames anti-correlate."""
    return bool(np.nanmin(r) < min(INVERTED, -np.nanmax(r)))


def _is_offset(steps: Steps, offset: int, best: float, here: float) -> bool:
    least = max(steps.interval_us / 2, LEAST_OFFSET_US)
    return abs(offset) > least and best > AGREES and best > here + BETTER
