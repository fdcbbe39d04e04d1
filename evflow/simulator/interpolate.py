"""Slow videos made fast: frames in between, by optical flow.

The simulator takes log intensity as linear between frames, which is right only while nothing
moves by more than about half a pixel. Blending 40 ms apart mis-simulates everything fast, so slower
videos are first filled up with motion-compensated frames (host code, frame pair by frame pair).
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from evflow.errors import EvflowDataError
from evflow.notes import Note
from evflow.process.threads import ahead
from evflow.simulator.between import intervals
from evflow.simulator.exposure import unblurred

MIN_SIDE = 12  # pixels on the longer side: smaller frames show no motion
STEP_PX = 0.5  # of motion: at one pixel a step, fine textures lose 5 to 15 % of their events
MAX_STEPS = 128  # frames per pair; faster motion gives no reliable flow
GOLDEN, NEAREST = 0.6180339887, 0.3
AHEAD = 1  # intervals whose motion is computed while another is filled
FAILED = 0.3  # share of changing pixels with wrong flow: strong occlusion alone causes that much


def upsample(
    pairs: Iterable[tuple[np.ndarray, int]], *, max_motion_px: float = STEP_PX,
    exposure_us: int = 0, warn: Callable[[Note], None] | None = None,
    tell: Callable[[Seen], None] = lambda _: None,
) -> Iterator[tuple[np.ndarray, int]]:
    """Insert frames so that motion between neighbours is at most about max_motion_px.

    Args:
        pairs: (frame (H, W) in DN 0..255, time in us).
        max_motion_px: motion between neighbouring frames of the output.
        exposure_us: of the frames; the blur of what moves meanwhile is taken out.
        warn: receives notes at the end: motion that needs more than MAX_STEPS steps, failed
            optical flow, cuts.
        tell: receives measurements of each interval.

    Yields:
        (float32 frame, time): the given frames, unchanged unless they have an exposure, and frames
        at even times between them, delayed by two input frames (three with an exposure).

    Raises:
        EvflowDataError: EV002 (frames too small or of changing size), EV004 (order), EV007 (NaN),
            EV020.
    """
    if exposure_us < 0:
        raise EvflowDataError("EV020", f"exposure_us={exposure_us}.", "It must be >= 0.")
    if not max_motion_px > 0:
        raise EvflowDataError("EV020", f"max_motion_px={max_motion_px}.", "It must be > 0.")
    last: list[tuple[np.ndarray, int]] = []

    def watched() -> Iterator[tuple[np.ndarray, int]]:
        for pair in _checked(pairs):
            last[:] = [pair]
            yield pair

    seen: list[Seen] = []
    with ahead(unblurred(intervals(watched()), exposure_us), AHEAD) as found:
        for number, interval in enumerate(found):
            wanted = math.ceil(interval.speed_px / max_motion_px)
            t0, t1 = interval.a.time, interval.b.time
            seen.append(Seen(t0, t1, interval.speed_px, wanted, interval.motion.failed,
                             interval.motion.lost))
            tell(seen[-1])
            yield interval.a.dn, t0
            times = _times(t0, t1, min(MAX_STEPS, wanted), number)
            fractions = [(t - t0) / (t1 - t0) for t in times]
            if fractions:
                yield from zip(interval.at(fractions), times, strict=True)
            last[:] = [(interval.b.dn, t1)]
    yield from last
    if warn is not None:
        for note in notes_on(seen):
            warn(note)


def _times(t0: int, t1: int, steps: int, number: int) -> list[int]:
    """Times in us that divide interval `number` into about `steps`, none closer to a frame than
    NEAREST steps. Each interval starts at another fraction of a step (multiples of the golden
    ratio), so that a step's effect on the event rate does not add up over the frames."""
    step = (t1 - t0) / max(1, min(steps, t1 - t0))
    first = (1 - number * GOLDEN % 1) * step
    times = t0 + np.unique(np.rint(np.arange(first, t1 - t0, step)).astype(np.int64))
    margin = NEAREST * step
    return [int(t) for t in times if t0 + margin <= t <= t1 - margin]


@dataclasses.dataclass(frozen=True)
class Seen:
    """Measurements of the interval from t0 to t1 us: motion, steps that it needs, share of wrong
    flow, whether the flow is lost."""

    t0: int
    t1: int
    motion_px: float
    wanted: int
    failed: float
    lost: bool


def notes_on(seen: list[Seen]) -> Iterator[Note]:
    """Notes on intervals that could not be interpolated well, naming the worst of each kind."""
    fast = [s for s in seen if s.wanted > MAX_STEPS]
    if fast:
        worst = max(fast, key=lambda s: s.motion_px)
        yield Note("frames.fast", f"motion of {worst.motion_px:.0f} px between the frames at "
                   f"{worst.t0} and {worst.t1} us is too fast to interpolate well; {MAX_STEPS} "
                   f"steps were used{_many(fast, seen)}.")
    lost = [s for s in seen if s.lost]
    if lost:
        yield Note("frames.cut", f"hardly anything of the frame at {lost[0].t0} us is found in "
                   f"that at {lost[0].t1} us{_many(lost, seen)}: a cut, or motion too fast to "
                   "follow. The frames are cross-faded, which gives a burst of false events; "
                   "--start and --stop select a single shot.")
    failed = [s for s in seen if s.failed > FAILED and not s.lost]
    if failed:
        worst = max(failed, key=lambda s: s.failed)
        yield Note("frames.flow", f"optical flow fails in {worst.failed:.0%} of the pixels that "
                   f"change between the frames at {worst.t0} and {worst.t1} us{_many(failed, seen)}"
                   ": noise, or motion too fast or too intricate to follow. Events there "
                   "are those of a fade; a higher frame rate helps.")


def _many(some: list[Seen], seen: list[Seen]) -> str:
    return f" (likewise in {len(some)} of {len(seen)} intervals)" if len(some) > 1 else ""


def _checked(pairs: Iterable[tuple[np.ndarray, int]]) -> Iterator[tuple[np.ndarray, int]]:
    """Frames as float32; EV002 where sizes differ or are too small for optical flow, EV004 where
    times do not increase, EV007 where a frame is not finite."""
    shape, last = None, -math.inf
    for given, time in pairs:
        frame = np.asarray(given, np.float32)
        if not time > last:
            raise EvflowDataError("EV004", f"a frame at {time} us follows one at {last} us.",
                                  "Times of frames must increase.")
        last = time
        shape = shape or frame.shape
        if frame.ndim != 2 or frame.shape != shape:
            raise EvflowDataError(
                "EV002", f"frame at {time} us has shape {frame.shape}, the first {shape}.",
                "Expected (H, W) of one size.")
        if max(shape) < MIN_SIDE:
            raise EvflowDataError(
                "EV002", f"frames of {shape[1]}x{shape[0]} pixels are too small to see motion in: "
                f"their longer side has less than {MIN_SIDE}.",
                "Use the frames without interpolation: --no-interpolate, or no upsample.")
        if not np.isfinite(frame).all():
            raise EvflowDataError("EV007", f"the frame at {time} us has NaN or infinite values.",
                                  "Frames must be linear DN.")
        yield frame, int(time)


def unzip(
    pairs: Iterable[tuple[np.ndarray, int]]
) -> tuple[Iterator[np.ndarray], Iterator[int]]:
    """Lazy (frames, times) of a stream of pairs, for `simulate_stream`, which alternates between
    the two. Buffers one pair (itertools.tee would hold 57)."""
    source, times = iter(pairs), collections.deque[int]()

    def frames() -> Iterator[np.ndarray]:
        for frame, t in source:
            times.append(t)
            yield frame

    def waiting() -> Iterator[int]:
        while times:
            yield times.popleft()

    return frames(), waiting()
