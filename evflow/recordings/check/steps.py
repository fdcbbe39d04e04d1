"""Frame steps: what changes between two frames, in cells of pixels, and how well the net events of
the same interval (ON minus OFF) follow it.

Pearson's r is taken over all cells of all steps, for frames as they are, mirrored or transposed,
for shifts of their clock, and for displacements in the image.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import itertools
from collections.abc import Mapping

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.spool import forget
from evflow.recordings.glitches import ALL_CHANGES
from evflow.recordings.windows import WindowPlan, plan_windows
from evflow.types import Events, Recording

MIN_STEP_US = 20_000  # frames closer than that change too little
MOST_STEPS = 24  # frame intervals examined, one of each of so many parts of the recording
STRIDE = 4  # every 4th pixel of every 4th row tells how much a frame changes
CELLS = 160  # along the longer side: pooling averages out quantisation by the thresholds
DARK_DN, BRIGHT_DN = 15.0, 250.0  # outside, changes of log brightness are unreliable
LEAST_EVENTS, LEAST_CELLS = 500, 200  # fewer are not enough to decide
SURE_CELLS, SURE_EVENTS = 4_000, 20_000  # with this many, chance correlations are at most .03
SWEEP_INTERVALS, SWEEP_US = 3, 200_000  # range of the sweep: frame intervals, at most us
AT_REST = 0.2  # of the change of whole frames: below, frames change by nothing else but noise
LIT = 0.5  # least r of steps of a light with events at another time; sound ones have .9
SWEEP_STEP_US = 5_000
LATENCY_US = 4_000  # of the events, in the mean
LEAST_OVERLAP = 0.25  # of the events' power, of displaced frames

FLIPS = {"horizontal": (1,), "vertical": (0,), "both": (0, 1)}
WHOLE = slice(None)
TURNED = " of the transpose"  # square sensors: the same of frames with rows and columns swapped


@dataclasses.dataclass(frozen=True, eq=False)
class Steps:
    """Frame steps to compare with events. changes: {flip: (K, cells)} change of log brightness, NaN
    in cells without a pixel that is well exposed in both frames; bounds: (K, 2) int64 us; cell:
    side of a cell in pixels; interval_us: the median of all frame intervals; silent: whether they
    are steps of a light whose events come at another time."""

    events: Events
    changes: dict[str, np.ndarray]
    bounds: np.ndarray
    cell: int
    interval_us: float
    silent: bool = False

    def correlations(self, offsets_us: np.ndarray, flip: str = "") -> np.ndarray:
        """Pearson's r with the frames' clock shifted by each offset; NaN if there are too few."""
        return self.r_of(self.sums(offsets_us, flip), flip)

    def sums(self, offsets_us: np.ndarray, flip: str = "") -> np.ndarray:
        """What r is computed from (K, 6, offsets): sums over cells of the change a, the net events
        b, a², b² and ab, and the number of events."""
        sums = np.zeros((len(self.bounds), 6, len(offsets_us)))
        for k, (change, (t0, t1)) in enumerate(zip(self.changes[flip], self.bounds, strict=True)):
            known = np.isfinite(change)
            forget(self.events.x, self.events.y, self.events.t, self.events.p)
            near = self.events.slice(int(t0 + offsets_us.min()), int(t1 + offsets_us.max()))
            code = codes(near, self.cell)
            edges = np.searchsorted(near.t, np.stack([t0 + offsets_us, t1 + offsets_us]))
            a = change[known]
            sum_a, sum_aa = a.sum(), (a * a).sum()  # no BLAS: its threads cost more than they give
            for i, (first, last) in enumerate(edges.T):
                sign = np.bincount(code[first:last], minlength=2 * len(change)).reshape(-1, 2)
                b = (sign[:, 1] - sign[:, 0])[known].astype(np.float64)
                sums[k, :, i] = (
                    sum_a, b.sum(), sum_aa, (b * b).sum(), (a * b).sum(), last - first)
        return sums

    def r_of(self, sums: np.ndarray, flip: str = "", kept: slice = WHOLE) -> np.ndarray:
        """r of the kept steps, given the sums of all, as of `sums`."""
        a, b, aa, bb, ab, count = sums[kept].sum(0)
        cells = max(int(np.isfinite(self.changes[flip][kept]).sum()), 1)
        power = (aa - a**2 / cells) * (bb - b**2 / cells)
        enough = (count >= LEAST_EVENTS) & (cells >= LEAST_CELLS) & (power > 0)
        r = (ab - a * b / cells) / np.sqrt(np.where(enough, power, 1.0))
        return np.where(enough, r, np.nan)

    def correlation(self, flip: str = "") -> float:
        """Pearson's r of the recording as it is; 0 of silent steps with too few events."""
        r = float(self.correlations(np.zeros(1, np.int64), flip)[0])
        return 0.0 if self.silent and np.isnan(r) else r

    def enough(self) -> bool:
        """Whether there is enough data for a correlation near zero to mean that there is none."""
        first, last = int(self.bounds[0, 0]), int(self.bounds[-1, 1])
        cells = int(np.isfinite(self.changes[""]).sum())
        return cells >= SURE_CELLS and len(self.events.slice(first, last)) >= SURE_EVENTS

    def parts(self, of: int) -> list[slice]:
        """At most `of` equal parts of the steps, in time, none empty."""
        edges = np.linspace(0, len(self.bounds), of + 1).astype(int).tolist()
        return [slice(a, b) for a, b in itertools.pairwise(edges) if a < b]

    def backwards(self) -> Steps:
        """The steps as if the last frame came first."""
        return dataclasses.replace(
            self, changes={flip: -change[::-1] for flip, change in self.changes.items()})

    @functools.cached_property
    def offsets_us(self) -> np.ndarray:
        """Offsets of the frames' clock that are tried, in us."""
        reach = SWEEP_US if self.silent else SWEEP_INTERVALS * self.interval_us
        count = int(min(reach, SWEEP_US) // SWEEP_STEP_US)
        return SWEEP_STEP_US * np.arange(-count, count + 1)

    @functools.cached_property
    def _swept(self) -> np.ndarray:
        return self.sums(self.offsets_us)

    def sweep(self, kept: slice = WHOLE) -> np.ndarray:
        """r of the kept steps at each of `offsets_us`."""
        return self.r_of(self._swept, kept=kept)

    def most_events(self) -> int:
        """Events within the steps at the one of `offsets_us` where they are most."""
        return int(self._swept[:, 5].sum(0).max())

    def peak(self, r: np.ndarray) -> tuple[int, float]:
        """The offset in us of the largest r (interpolated by a parabola, without the events'
        latency), and that r. r: as of `sweep`, not NaN everywhere."""
        i = int(np.nanargmax(r))
        if 0 < i < len(r) - 1 and np.isfinite(r[i - 1:i + 2]).all():
            left, top, right = r[i - 1:i + 2]
            bend = left - 2 * top + right
            shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
            return round(float(self.offsets_us[i] + shift * SWEEP_STEP_US)) - LATENCY_US, float(top)
        return int(self.offsets_us[i]) - LATENCY_US, float(r[i])


def frame_steps(recording: Recording, flips: Mapping[str, tuple[int, ...]] = FLIPS) -> Steps | None:
    """The steps to examine, also for mirrored and, if they are square, transposed frames; None
    without frames, events or a common time."""
    try:
        plan = plan_windows(recording, MIN_STEP_US)
    except EvflowDataError:
        return None
    pairs = _most_telling(recording, plan.pairs)
    if silent := _without_events(recording, plan, pairs):
        steps = _of(recording, silent, flips, silent=True)
        if np.nan_to_num(np.abs(steps.sweep())).max() > LIT:
            return steps
    return _of(recording, pairs, flips) if pairs else None


def _of(
    recording: Recording, pairs: tuple[tuple[int, int], ...], flips: Mapping[str, tuple[int, ...]],
    *, silent: bool = False,
) -> Steps:
    """The steps from the first to the last frame of each pair."""
    cell = max(1, round(max(recording.events.size) / CELLS))
    width, height = recording.events.size
    changes: dict[str, list[np.ndarray]] = collections.defaultdict(list)
    for first, last in pairs:
        change = _change(recording.frame_dn(first), recording.frame_dn(last))
        turned = {"": change, TURNED: change.T} if flips and width == height else {"": change}
        for turn, image in turned.items():
            for flip, axes in ({"": ()} | dict(flips)).items():
                changes[flip + turn].append(_pooled(np.flip(image, axes), cell))
    bounds = recording.frame_times[np.array(pairs)]
    interval = float(np.median(np.diff(recording.frame_times)))
    return Steps(recording.events, {k: np.stack(v) for k, v in changes.items()}, bounds, cell,
                 interval, silent)


def _without_events(
    recording: Recording, plan: WindowPlan, pairs: tuple[tuple[int, int], ...]
) -> tuple[tuple[int, int], ...]:
    """Of each of MOST_STEPS parts the pair whose frames change most as a whole without events,
    which is no window of the plan. None unless frames are at rest in `pairs`: then the light of a
    bench may have stepped, and the frames be early or late by an interval or more."""
    jumps = [(s.first, s.last) for s in plan.skipped if s.why.startswith(ALL_CHANGES)]
    sizes = np.array([_seen_change(recording, *pair) for pair in jumps])
    rest = max((_seen_change(recording, *pair) for pair in pairs), default=0.0)
    if not jumps or rest > AT_REST * np.median(sizes):
        return ()
    parts = np.array_split(np.arange(len(jumps)), min(len(jumps), MOST_STEPS))
    return tuple(jumps[part[np.argmax(sizes[part])]] for part in parts)


def _most_telling(
    recording: Recording, pairs: tuple[tuple[int, int], ...]
) -> tuple[tuple[int, int], ...]:
    """Of each of MOST_STEPS parts the pair whose frames change most, near the one with the most
    events: evenly spread ones may all lie between the steps of a light."""
    if len(pairs) <= MOST_STEPS:
        return pairs
    bounds = recording.frame_times[np.array(pairs)]
    begin, end = np.searchsorted(recording.events.t, bounds).T
    forget(recording.events.t)
    chosen = []
    for part in np.array_split(np.arange(len(pairs)), MOST_STEPS):
        busiest = part[np.argmax((end - begin)[part])]
        near = part[np.abs(part - busiest) <= SWEEP_INTERVALS]  # as the clocks may differ
        changes = [_seen_change(recording, *pairs[k]) for k in near]
        chosen.append(pairs[near[int(np.argmax(changes))]])
    return tuple(chosen)


def never_changes(frames: np.ndarray) -> bool:
    """Whether every few pixels of frames (T, H, W) are the same in all of them."""
    some = np.s_[::STRIDE, ::STRIDE]
    return all(np.array_equal(frame[some], frames[0][some]) for frame in frames)


def _seen_change(recording: Recording, first: int, last: int) -> float:
    """Mean absolute change of every few pixels from one frame to another."""
    some = np.s_[::STRIDE, ::STRIDE]
    before, after = (recording.frames[i][some].astype(np.float32) for i in (first, last))
    return float(np.abs(after - before).mean())


def displacement(steps: Steps) -> tuple[float, float, int, int]:
    """r of the recording as it is, and the largest r if events lie dx, dy pixels from where the
    frames show changes, by up to half the sensor; and dx, dy. What a frame changes as a whole is
    left out of both."""
    columns = -(-steps.events.size[0] // steps.cell)
    rows = len(steps.changes[""][0]) // columns
    shape = 2 * rows, columns + 1  # spectra of images beside zeros, so that nothing wraps round
    product, energy, power = np.zeros(shape, complex), np.zeros(shape, complex), 0.0
    for change, (t0, t1) in zip(steps.changes[""], steps.bounds, strict=True):
        code = codes(steps.events.slice(int(t0), int(t1)), steps.cell)
        sign = np.bincount(code, minlength=2 * len(change)).reshape(-1, 2)
        net = (sign[:, 1] - sign[:, 0]).astype(np.float64)
        known = np.isfinite(change)
        a = np.where(known, change - change[known].mean() if known.any() else 0.0, 0.0)
        images = [a, known.astype(np.float64), net - net.mean(), (net - net.mean()) ** 2]
        a_, known_, net_, square_ = (
            np.fft.rfft2(i.reshape(rows, columns), (2 * rows, 2 * columns)) for i in images)
        product = product + a_.conj() * net_
        energy = energy + known_.conj() * square_
        power += float(a @ a)
    up, left = rows // 2, columns // 2
    near = np.s_[rows - up: rows + up + 1, columns - left: columns + left + 1]
    along, square = (np.fft.fftshift(np.fft.irfft2(s, (2 * rows, 2 * columns)))[near]
                     for s in (product, energy))
    whole = float(square[up, left])
    if not whole * power > 0:
        return 0.0, 0.0, 0, 0
    r = along / np.sqrt(power * np.maximum(square, LEAST_OVERLAP * whole))
    y, x = np.unravel_index(int(np.argmax(r)), r.shape)
    return (float(r[up, left]), float(r[y, x]), steps.cell * (int(x) - left),
            steps.cell * (int(y) - up))


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


def codes(events: Events, cell: int) -> np.ndarray:
    """2 (number of the cell) + (1 if ON), of each event."""
    columns = -(-events.size[0] // cell)
    return 2 * ((events.y // cell).astype(np.int64) * columns + events.x // cell) + events.p
