"""What a screen's light did, and the events of its steps and rests.

Rests are those of the frames, or given; levels of light those of the frames, or given. Steps and
rests that the events do not cover are left out.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from evflow.errors import EvflowDataError
from evflow.estimation.bench.coverage import SILENT, covered, noise_us, watched
from evflow.estimation.bench.levels import Unit, light_of_rests, lux_notes
from evflow.estimation.bench.logarithm import Other, other_map
from evflow.estimation.bench.rests import check_steps, find_rests
from evflow.estimation.bench.settling import SETTLE_US, settled_at, settling_us
from evflow.light.log_maps import lin_log, lin_log_inverse
from evflow.notes import Note
from evflow.recordings.faulty_pixels import hot_at_rest
from evflow.recordings.glitches import exposed
from evflow.recordings.stillness import LEAST_EVENTS, MOVING, coincidence_excess
from evflow.types import Events, Recording

Span = tuple[int, int]

MOST = 0.5  # share of pixels whose level must be known


@dataclasses.dataclass(frozen=True, eq=False)
class Steps:
    """K steps of light between K+1 rests.

    levels: (K+1, H, W) log intensity at each rest; lit: (K+1, H, W) bool, where it is known, as the
    frames are neither saturated nor black; counts: (K, 2, H, W) ON and OFF events of each
    step; seconds: (K,) counting time of each; rests: (K+1, 2, H, W) events at each rest; since:
    (K+1, H, W) seconds from the last event at each, or its begin, to its end; spans: the
    rests; settled: times until which events belong to the step that leads to a rest; quiet: the
    parts of the rests in which events were counted as noise; light: (K+1,) in unit;
    uncovered, silent_s: steps beyond the events, and time at rest whose events are missing, both
    left out; other: the levels by another logarithm, if there is light so dark that it matters;
    notes: on the light."""

    levels: np.ndarray
    lit: np.ndarray
    counts: np.ndarray
    seconds: np.ndarray
    rests: np.ndarray
    since: np.ndarray
    spans: list[Span]
    settled: list[int]
    quiet: list[Span]
    light: np.ndarray
    unit: Unit
    uncovered: int
    silent_s: float
    other: Other | None
    notes: tuple[Note, ...]

    @property
    def rest(self) -> np.ndarray:
        """(2, H, W) events of all rests."""
        return self.rests.sum(0, dtype=np.float64)

    @property
    def n_events(self) -> np.ndarray:
        """(H, W) uint32 events of all steps."""
        return self.counts.sum((0, 1)).astype(np.uint32)

    @property
    def rests_s(self) -> np.ndarray:
        """(K+1,) seconds of counting at each rest."""
        return np.array([b - a for a, b in self.quiet]) * 1e-6

    @property
    def rest_s(self) -> float:
        """Total seconds of counting at rest."""
        return float(self.rests_s.sum())

    @property
    def changes(self) -> np.ndarray:
        """(K,) log units, of the median pixel."""
        return np.median(np.diff(self.levels, axis=0), (1, 2))

    @property
    def sized(self) -> np.ndarray:
        """(K,) bool: steps of which most pixels' change is known."""
        return (self.lit[1:] & self.lit[:-1]).mean((1, 2)) > MOST

    @property
    def reach(self) -> np.ndarray:
        """(H, W) log units between the darkest and the brightest known level of a pixel."""
        brightest = np.where(self.lit, self.levels, -np.inf).max(0)
        return brightest - np.where(self.lit, self.levels, np.inf).min(0)


def counted_steps(
    recording: Recording, rests_us: Sequence[Span] | None, light: Sequence[float] | None,
    lux: tuple[float, ...],
) -> Steps:
    """The steps and rests of a recording; arguments and errors as of `calibrate_step`."""
    events, spans = recording.events, _rests(recording, rests_us)
    if lux and light is not None:
        raise EvflowDataError("EV020", "both light and lux.", "Give one of them.")
    levels, lit = _levels(recording, spans, light)
    framed = None if light is not None else levels
    if light is None:
        check_steps(levels)
    # Frames saturate before the light rests, and still are while it begins to fall.
    spans = [(a, b) if known.mean() > MOST else (a + (b - a) // 4, b - (b - a) // 4)
             for (a, b), known in zip(spans, lit, strict=True)]
    unit: Unit = "DN" if light is None else "light"
    doubts = []
    if lux:
        seen = np.median(levels, (1, 2))
        unit, light = "lux", light_of_rests(seen, lux)
        doubts = lux_notes(seen, lux)
        levels, lit = _levels(recording, spans, light)
    other = None if framed is None else other_map(levels, framed, bool(lux))
    settled = settled_at(spans, SETTLE_US)
    up = np.diff(np.median(levels, (1, 2))) > 0
    noise = noise_us(events, [(a, b) for a, (_, b) in zip(settled, spans, strict=True)], up)
    inside = covered(events, spans, settled, float(noise.min()))
    uncovered = len(spans) - len(spans[inside])
    levels, lit, spans, noise = levels[inside], lit[inside], spans[inside], noise[inside]
    settle, slow = settling_us(events, spans)
    settled = settled_at(spans, settle)
    light = None if light is None else light[inside]
    other = other and dataclasses.replace(other, levels=other.levels[inside])
    counts = [events.slice(before[1], after).count_map()
              for before, after in zip(spans, settled[1:], strict=False)]
    seconds = [(after - before[1]) * 1e-6
               for before, after in zip(spans, settled[1:], strict=False)]
    rested = [(a, b) for a, (_, b) in zip(settled, spans, strict=True)]
    late = np.concatenate([[False], ~up])[inside] * SILENT * _between_off(events, rested)
    quiet = [watched(events, *of_rest) for of_rest in zip(rested, noise, late, strict=True)]
    silent = sum(b - a for a, b in rested) - sum(b - a for a, b in quiet)
    rests = np.stack([events.slice(a, b).count_map() for a, b in quiet])
    since = np.stack([_since_last(events.slice(a, b), a, b) for a, b in rested])
    busiest = max((events.slice(a, b) for a, b in quiet), key=len)
    shown = (np.asarray(light, np.float64) if light is not None else
             np.asarray(lin_log_inverse(jnp.asarray(np.median(levels, (1, 2)))), np.float64))
    return Steps(levels, lit, np.array(counts, np.float64), np.array(seconds), rests, since, spans,
                 settled, quiet, shown, unit, uncovered, silent * 1e-6, other,
                 (*_restless(busiest), *doubts, *slow, *_clipped(lit)))


def _since_last(events: Events, begin: int, end: int) -> np.ndarray:
    """(H, W) seconds from each pixel's last event, or the begin, to the end (us)."""
    width, height = events.size
    since = np.full((height, width), (end - begin) * 1e-6)
    since[events.y, events.x] = (end - events.t) * 1e-6  # in order of time: the last one stays
    return since


def _between_off(events: Events, rested: list[Span]) -> float:
    """Mean time in us between OFF events at the rests, of all pixels: noise that is no leak."""
    sent = sum(int((~events.slice(*span).p).sum()) for span in rested)
    return sum(b - a for a, b in rested) / max(sent, 1)


def _rests(recording: Recording, rests_us: Sequence[Span] | None) -> list[Span]:
    """The rests of the light in us, given or found in the frames; EV020 if given ones overlap."""
    times = recording.frame_times
    spans = ([(int(times[a]), int(times[b])) for a, b in find_rests(recording)]
             if rests_us is None else [(int(a), int(b)) for a, b in rests_us])
    flat = [t for span in spans for t in span]
    if (len(spans) < 2 or any(b < a for a, b in itertools.pairwise(flat))
            or any(b == a for a, b in spans)):
        raise EvflowDataError("EV020", f"rests_us={spans}.",
                              "Give two or more (begin, end) in us, in order of time.")
    return spans


def _restless(rest: Events) -> list[Note]:
    """A note if the events of a rest are not noise alone."""
    hot = hot_at_rest(rest.count_map().sum(0))
    if len(rest) < LEAST_EVENTS or coincidence_excess(rest, hot) <= MOVING:
        return []
    return [Note(
        "scene.restless", "neighbouring pixels fire together while the light should rest: does it "
        "flicker or still settle, are its edges not where frames or triggers say, or does the "
        "camera regulate its exposure? Then noise rates, and thresholds, are wrong.")]


def _clipped(lit: np.ndarray) -> list[Note]:
    """A note where the level of rests is unknown to most pixels, lit (R, H, W) bool.

    Raises:
        EvflowDataError: EV017 if that leaves less than two rests.
    """
    hidden = int((lit.mean((1, 2)) <= MOST).sum())
    if len(lit) - hidden < 2:
        raise EvflowDataError(
            "EV017", f"the frames are saturated or black at {hidden} of {len(lit)} rests of the "
            "light.", "Expose the frames so that no level is white or black, or give the light of "
            "each level, --lux.")
    return [Note("levels.clipped", f"the frames are saturated or black at {hidden} of {len(lit)} "
                 "rests of the light: thresholds follow from the light of the others, and all "
                 "events between them.")] if hidden else []


def _levels(
    recording: Recording, spans: list[Span], light: Sequence[float] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Log intensity (R, H, W) at the rests, and where it is known, bool."""
    width, height = recording.events.size
    if light is not None:
        given = np.asarray(light, np.float64)
        if given.shape != (len(spans),) or not (np.isfinite(given) & (given > 0)).all():
            raise EvflowDataError("EV020", f"light={light!r} for {len(spans)} rests.",
                                  "Give one positive number per rest.")
        shape = (len(spans), height, width)
        return np.broadcast_to(np.log(given)[:, None, None], shape), np.ones(shape, bool)
    times, levels, lit = recording.frame_times, [], []
    for begin, end in spans:
        inside = np.flatnonzero((times >= begin) & (times <= end))
        if not len(inside):
            raise EvflowDataError("EV011", f"no frame between {begin} and {end} us.",
                                  "Give light, its value at each rest.")
        mean = np.mean([recording.frame_dn(int(i)) for i in inside], 0, np.float64)
        levels.append(np.asarray(lin_log(mean.astype(np.float32)), np.float64))
        lit.append(exposed(np.asarray(mean)))
    return np.stack(levels), np.stack(lit)
