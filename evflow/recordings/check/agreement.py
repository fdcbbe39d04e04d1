"""Do events and frames agree? A pixel's net events (ON minus OFF) follow the change of its log
brightness; their correlation over cells of pixels and frame intervals shows whether polarity, clock
and orientation are those of one camera.

The sweep over the frames' clock peaks late: a pixel fires once brightness has moved by a threshold,
so events trail it, by 0-10 ms in the recordings measured. The mean delay is subtracted, and an
offset is only reported beyond max(half a frame interval, 10 ms).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.spool import forget
from evflow.io.decode.units import too_few
from evflow.recordings.check.findings import Finding
from evflow.recordings.windows import plan_windows
from evflow.types import Events, Recording

MIN_STEP_US = 20_000  # frames closer than that change too little
MOST_STEPS = 24  # frame intervals examined, evenly spread
CELLS = 160  # along the longer side: pooling averages out quantisation by the thresholds
DARK_DN, BRIGHT_DN = 15.0, 250.0  # as in the refinement: outside, log changes are unreliable
LEAST_EVENTS, LEAST_CELLS = 500, 200  # fewer are not enough to decide
INVERTED = -0.2  # correlation below which polarity is inverted
AGREES, BETTER = 0.2, 0.1  # minimum correlation of another interpretation, and its gain
UNRELATED = 0.06  # maximum over all interpretations; 26 recordings that agree have at least .12
STRONG = 0.3  # mean change of log brightness in a cell, above noise and drift
LEAST_CHANGE, MOST_THETA = 500.0, 10.0  # log units in all; real recordings have >= .4 per event
SURE_CELLS, SURE_EVENTS = 4_000, 20_000  # with this many, chance correlations are at most .03
SWEEP_INTERVALS, SWEEP_US = 3, 200_000  # range of the sweep: frame intervals, at most us
SWEEP_STEP_US = 5_000
LATENCY_US = 4_000
LEAST_OFFSET_US = 10_000

FLIPS = {"horizontal": (1,), "vertical": (0,), "both": (0, 1)}


@dataclasses.dataclass(frozen=True, eq=False)
class Steps:
    """Frame steps to compare with events. changes: {flip: (K, cells)} change of log brightness, NaN
    in cells without a pixel that is well exposed in both frames; bounds: (K, 2) int64 us; cell:
    side of a cell in pixels; interval_us: the median of all frame intervals."""

    events: Events
    changes: dict[str, np.ndarray]
    bounds: np.ndarray
    cell: int
    interval_us: float

    def correlations(self, offsets_us: np.ndarray, flip: str = "") -> np.ndarray:
        """Pearson's r with the frames' clock shifted by each offset; NaN if there are too few."""
        sums = np.zeros((6, len(offsets_us)))
        for change, (t0, t1) in zip(self.changes[flip], self.bounds, strict=True):
            known = np.isfinite(change)
            forget(self.events.x, self.events.y, self.events.t, self.events.p)
            near = self.events.slice(int(t0 + offsets_us.min()), int(t1 + offsets_us.max()))
            code = _codes(near, self.cell)
            edges = np.searchsorted(near.t, np.stack([t0 + offsets_us, t1 + offsets_us]))
            a = change[known]
            sum_a, sum_aa = a.sum(), (a * a).sum()  # no BLAS: its threads cost more than they give
            for i, (first, last) in enumerate(edges.T):
                sign = np.bincount(code[first:last], minlength=2 * len(change)).reshape(-1, 2)
                b = (sign[:, 1] - sign[:, 0])[known].astype(np.float64)
                sums[:, i] += (
                    sum_a, b.sum(), sum_aa, (b * b).sum(), (a * b).sum(), last - first)
        a, b, aa, bb, ab, count = sums
        cells = max(int(np.isfinite(self.changes[flip]).sum()), 1)
        power = (aa - a**2 / cells) * (bb - b**2 / cells)
        enough = (count >= LEAST_EVENTS) & (cells >= LEAST_CELLS) & (power > 0)
        r = (ab - a * b / cells) / np.sqrt(np.where(enough, power, 1.0))
        return np.where(enough, r, np.nan)

    def correlation(self, flip: str = "") -> float:
        """Pearson's r of the recording as it is."""
        return float(self.correlations(np.zeros(1, np.int64), flip)[0])

    def enough(self) -> bool:
        """Whether there is enough data for a correlation near zero to mean that there is none."""
        first, last = int(self.bounds[0, 0]), int(self.bounds[-1, 1])
        cells = int(np.isfinite(self.changes[""]).sum())
        return cells >= SURE_CELLS and len(self.events.slice(first, last)) >= SURE_EVENTS

    def sweep(self) -> tuple[np.ndarray, np.ndarray]:
        """Offsets of the frames' clock in us, and r at each."""
        reach = min(SWEEP_INTERVALS * self.interval_us, SWEEP_US)
        count = int(reach // SWEEP_STEP_US)
        offsets = SWEEP_STEP_US * np.arange(-count, count + 1)
        return offsets, self.correlations(offsets)


def frame_steps(recording: Recording, flips: Mapping[str, tuple[int, ...]] = FLIPS) -> Steps | None:
    """The steps to examine, also for mirrored frames; None without frames, events or a common
    time."""
    try:
        pairs = plan_windows(recording, MIN_STEP_US).pairs
    except EvflowDataError:
        return None
    if not pairs:
        return None
    if len(pairs) > MOST_STEPS:
        pairs = tuple(pairs[round(i)] for i in np.linspace(0, len(pairs) - 1, MOST_STEPS))
    cell = max(1, round(max(recording.events.size) / CELLS))
    changes: dict[str, list[np.ndarray]] = {flip: [] for flip in ("", *flips)}
    for first, last in pairs:
        change = _change(recording.frame_dn(first), recording.frame_dn(last))
        changes[""].append(_pooled(change, cell))
        for flip, axes in flips.items():
            changes[flip].append(_pooled(np.flip(change, axes), cell))
    bounds = recording.frame_times[np.array(pairs)]
    interval = float(np.median(np.diff(recording.frame_times)))
    return Steps(recording.events, {k: np.stack(v) for k, v in changes.items()}, bounds, cell,
                 interval)


def agreement(recording: Recording) -> list[Finding]:
    """EV021 (polarity inverted), EV023 (times stretched), EV024 (clocks not aligned), EV029 (frames
    mirrored), EV034 (frames and events unrelated)."""
    steps = frame_steps(recording)
    if steps is None:
        return []
    if (missing := _missing(steps)) or np.isnan(here := steps.correlation()):
        return missing
    offsets, r = steps.sweep()
    flips = {flip: steps.correlation(flip=flip) for flip in FLIPS}
    flip = max(flips, key=lambda f: abs(flips[f]))
    if abs(flips[flip]) > AGREES and abs(flips[flip]) > np.nanmax(np.abs(r)) + BETTER:
        return [_mirrored(flip, here, flips[flip])]
    over = f"r={here:+.2f} over {len(steps.bounds)} frame steps"
    inverted = _inverted(r)
    if inverted:
        offset, best = _peak(offsets, -r)
        late = _is_offset(steps, offset, best, -here)
        also = (f" The frame times are off too: add {offset / 1e3:.1f} to --frames-offset-ms."
                if late else "")
        return [Finding(
            "EV021", "error", "events and frame brightness anti-correlate "
            f"({over}{f', {-best:+.2f} at its clearest' if late else ''}): ON and OFF are swapped.",
            "Pass --polarity invert (polarity='invert'), or remove it if it was passed; or "
            f"check the exporter.{also}")]
    offset, best = _peak(offsets, r)
    if _is_offset(steps, offset, best, here):
        side = "late" if offset < 0 else "early"
        severity: Literal["error", "warning"] = "error" if here < 0.5 * best else "warning"
        return [Finding(
            "EV024", severity, f"frame times are about {abs(offset) / 1e3:.1f} ms too {side} for "
            f"the events (r {here:+.2f}, {best:+.2f} where they agree best).",
            f"Pass --frames-offset-ms {offset / 1e3:.1f}, in addition to what was passed, or "
            "--frames-offset-ms auto.")]
    if max(best, abs(flips[flip])) < UNRELATED and steps.enough():
        return [Finding(
            "EV034", "error", f"events and frames are unrelated ({over}; no shift, flip or "
            "polarity improves it).",
            "Are they from one camera and one time? Are coordinates transposed, or is the time "
            "unit wrong (--time-unit)? Nothing can be measured from them.")]
    return []


def _mirrored(flip: str, here: float, best: float) -> Finding:
    """EV029, given r of the recording and of the one with mirrored frames."""
    swapped = " and with ON and OFF swapped" if best < 0 else ""
    also = " --polarity invert" if best < 0 else ""
    axis = "both axes" if flip == "both" else f"the {flip} axis"
    return Finding(
        "EV029", "error", f"events and frames agree only with the frames mirrored in {axis}"
        f"{swapped} (r {here:+.2f} -> {abs(best):+.2f}).",
        f"Pass --flip-frames {flip}{also}, or remove what was passed.")


def _missing(steps: Steps) -> list[Finding]:
    """EV023 if frames change far more than so few events allow at any threshold: a short excerpt of
    events whose times are stretched."""
    change = np.abs(steps.changes[""])
    shown = float(change[change > STRONG * steps.cell**2].sum())
    count = sum(len(steps.events.slice(int(t0), int(t1))) for t0, t1 in steps.bounds)
    if shown < LEAST_CHANGE or count > shown / MOST_THETA:
        return []
    wrong = too_few(count, shown)
    return [Finding("EV023", "warning", wrong.seen, f"Are event times too long? Pass --time-unit "
                    f"{wrong.unit}; or are the frames from another recording?")]


def frames_offset(recording: Recording) -> int:
    """By how many us to shift the frame times so that they agree with the events, of either
    polarity; 0 if they already do, or if it cannot be determined."""
    steps = frame_steps(recording)
    if steps is None or np.isnan(here := steps.correlation()):
        return 0
    offsets, r = steps.sweep()
    sign = -1.0 if _inverted(r) else 1.0
    offset, best = _peak(offsets, sign * r)
    return offset if _is_offset(steps, offset, best, sign * here) else 0


def _inverted(r: np.ndarray) -> bool:
    """Whether the sweep has its largest magnitude where events and frames anti-correlate."""
    return bool(np.nanmin(r) < min(INVERTED, -np.nanmax(r)))


def _is_offset(steps: Steps, offset: int, best: float, here: float) -> bool:
    least = max(steps.interval_us / 2, LEAST_OFFSET_US)
    return abs(offset) > least and best > AGREES and best > here + BETTER


def _peak(offsets: np.ndarray, r: np.ndarray) -> tuple[int, float]:
    """The offset of the largest r (interpolated by a parabola, without the events' latency), and
    that r."""
    i = int(np.nanargmax(r))
    if 0 < i < len(r) - 1 and np.isfinite(r[i - 1:i + 2]).all():
        left, top, right = r[i - 1:i + 2]
        bend = left - 2 * top + right
        shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
        return round(float(offsets[i] + shift * SWEEP_STEP_US)) - LATENCY_US, float(top)
    return int(offsets[i]) - LATENCY_US, float(r[i])


def _change(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Change of log brightness (H, W), NaN where a frame is near black or saturated."""
    low, high = np.minimum(before, after), np.maximum(before, after)
    known = (low >= DARK_DN) & (high <= BRIGHT_DN)
    change = np.log(np.maximum(after, 1.0) / np.maximum(before, 1.0))
    return np.where(known, change, np.nan)


def _pooled(change: np.ndarray, cell: int) -> np.ndarray:
    """The sum over each cell (cells,) of its known pixels, NaN without any."""
    shape = change.shape[0], -(-change.shape[1] // cell) * cell
    known = np.isfinite(change)
    total, count = (_cells(np.where(known, a, 0.0), shape, cell) for a in (change, 1.0))
    return np.where(count > 0, total, np.nan)


def _cells(image: np.ndarray, shape: tuple[int, int], cell: int) -> np.ndarray:
    rows = -(-shape[0] // cell)
    padded = np.zeros((rows * cell, shape[1]))
    padded[: image.shape[0], : image.shape[1]] = image
    return padded.reshape(rows, cell, -1, cell).sum((1, 3)).ravel()


def _codes(events: Events, cell: int) -> np.ndarray:
    """2 (number of the cell) + (1 if ON), of each event."""
    columns = -(-events.size[0] // cell)
    return 2 * ((events.y // cell).astype(np.int64) * columns + events.x // cell) + events.p
