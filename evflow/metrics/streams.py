"""Similarity of two event streams: rates, counts per pixel, intervals, isolated events.

Everything is measured over the time both streams cover, on the same pixels, and comes out as
plain numbers, lists and None (undefined: no such events, nothing varies), ready for JSON. Host
side, NumPy only. Memory: about 100 bytes an event.
"""

from __future__ import annotations

import dataclasses
import operator
from typing import Any

import numpy as np

from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.metrics.space_time import space_time_r
from evflow.types import Events

CURVE_STEPS = 120  # about as many points as a rate curve has
CURVE_STEP_US = 1_000  # the shortest step of one
LOG_EDGES = np.linspace(-6.0, 2.0, 65)  # log10 s: 1 us to 100 s, eight bins a decade
TOUCHING = 0.01  # overlap, as share of the shorter stream, below which clocks are taken to differ
ALONE_US = 5_000  # no neighbour fired for this long: removed by a background-activity filter
NET_CELL, NET_US, NET_STEPS = 8, 20_000, 2_000  # pixels; us; limit of steps, for memory
NEIGHBOURS = tuple((dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dx or dy)
ASKED_EVENTS = 400_000  # events whose neighbours are searched, evenly taken from the stream


def compare(
    real: Events, synthetic: Events, *, span_us: tuple[int, int] | None = None
) -> dict[str, Any]:
    """Compare a recorded and a synthetic event stream.

    Args:
        real: the recorded stream.
        synthetic: the simulated stream, of the same sensor size.
        span_us: (t0, t1), integer microseconds: the time [t0, t1) to compare, without shifting a
            stream; None: the time that both cover.

    Returns:
        A JSON-ready dict, None where a number is undefined.

        size, duration_s, span_us, events (numbers of events); covered, covered_of_longer: share of
        the shorter stream's time, and of the longer one's, that is compared, None with span_us;
        aligned_at: "clock", or
        "beginnings" where the streams share hardly any time and the synthetic one was moved by
        shift_us to begin with the real one;
        rate_hz: events per second and pixel, per polarity, and their ratio synthetic / real;
        on_off: ON events per OFF event; curve: the rates over time and their correlation r;
        counts: correlation r of the events per pixel; net_r: of ON less OFF events over cells of
        8x8 pixels and 20 ms, negative where polarity is swapped; space_time_r: the same over
        3x3 pixels and 2 ms, how alike they are in detail; active: share of pixels that fire, and
        `common`, those in both over those in either;
        intervals: between successive events of a pixel; neighbours: since the latest event of the
        eight pixels around, with `alone`, the share of events without one within 5 ms (mostly
        noise). Both have ks (Kolmogorov-Smirnov, 0..1), wasserstein_decades (of log10 time),
        median_s and a histogram; same_polarity: share of a pixel's events that repeat the
        polarity before.

    Raises:
        EvflowDataError: EV001 (a stream is empty), EV015 (different sizes), EV020 (an empty span,
            or no `Events`).
    """
    for name, events in (("real", real), ("synthetic", synthetic)):
        need(events, Events, name, "Of a path: evflow.read_events(path).")
    if span_us is not None:
        span_us = operator.index(span_us[0]), operator.index(span_us[1])
    if span_us is not None and span_us[1] <= span_us[0]:
        raise EvflowDataError("EV020", f"span_us={span_us}.", "It must end after it begins.")
    moved, shift = _aligned(real, synthetic, move=span_us is None)
    t0, t1 = span_us or (int(max(real.t[0], moved.t[0])), int(min(real.t[-1], moved.t[-1])) + 1)
    sides = {"real": real.slice(t0, t1), "synthetic": moved.slice(t0, t1)}
    seconds = (t1 - t0) * 1e-6
    shorter, longer = (
        min((t1 - t0) / us, 1.0) if us and span_us is None else None
        for us in sorted(events.duration_us for events in (real, moved)))
    counts = {name: events.count_map().astype(np.float64) for name, events in sides.items()}
    pixels = real.size[0] * real.size[1]
    rates = {name: _per_polarity(c.reshape(2, -1).sum(1) / (seconds * pixels))
             for name, c in counts.items()}
    return {
        "size": list(real.size), "duration_s": seconds, "span_us": [t0, t1],
        "covered": shorter, "covered_of_longer": longer,
        "aligned_at": "clock" if shift is None else "beginnings", "shift_us": shift or 0,
        "events": {name: len(events) for name, events in sides.items()},
        "rate_hz": {**rates, "ratio": {
            p: _ratio(rates["synthetic"][p], rates["real"][p]) for p in ("on", "off", "both")}},
        "on_off": {name: _ratio(r["on"], r["off"]) for name, r in rates.items()},
        "curve": _curves(sides, t0, t1, pixels),
        "counts": {"r": correlations(counts["real"], counts["synthetic"])},
        "net_r": _correlation(*(_net(side, t0, t1) for side in sides.values())),
        "space_time_r": space_time_r(sides["real"], sides["synthetic"], t0, t1),
        "active": _active(counts["real"].sum(0) > 0, counts["synthetic"].sum(0) > 0),
        **_delays(sides),
    }


def _aligned(real: Events, synthetic: Events, *, move: bool) -> tuple[Events, int | None]:
    """The synthetic stream, and by how many us it was moved: None where the clocks agree."""
    if real.size != synthetic.size:
        raise EvflowDataError(
            "EV015", f"the real stream is {real.size[0]}x{real.size[1]}, the synthetic one "
            f"{synthetic.size[0]}x{synthetic.size[1]}.",
            "Compare streams of one sensor; was the video resized? Where only the header is "
            "wrong: --size.")
    for name, events in (("real", real), ("synthetic", synthetic)):
        if not len(events):
            raise EvflowDataError("EV001", f"the {name} stream has no events.",
                                  "There is nothing to compare it by.")
    common = min(real.t[-1], synthetic.t[-1]) - max(real.t[0], synthetic.t[0])
    shorter = min(real.t[-1] - real.t[0], synthetic.t[-1] - synthetic.t[0])
    if not move or common > TOUCHING * shorter or common == shorter:
        return synthetic, None
    shift = int(real.t[0] - synthetic.t[0])
    return dataclasses.replace(synthetic, t=synthetic.t + shift), shift


def _per_polarity(pair: np.ndarray) -> dict[str, float]:
    on, off = (float(v) for v in pair)
    return {"on": on, "off": off, "both": on + off}


def _side(counts: np.ndarray, polarity: str) -> np.ndarray:
    return {"on": counts[0], "off": counts[1], "both": counts.sum(0)}[polarity]


def _ratio(a: float, b: float) -> float | None:
    return a / b if b > 0 else None


def _correlation(a: np.ndarray, b: np.ndarray) -> float | None:
    """Pearson's r; None where one of the two does not vary."""
    a, b = a.ravel() - a.mean(), b.ravel() - b.mean()
    scale = np.sqrt((a @ a) * (b @ b))
    return float(np.clip(a @ b / scale, -1.0, 1.0)) if scale > 0 else None


def correlations(one: np.ndarray, other: np.ndarray) -> dict[str, float | None]:
    """Pearson's r of events per pixel (2, H, W), ON and OFF: of "on", "off" and "both"."""
    return {p: _correlation(_side(one, p), _side(other, p)) for p in ("on", "off", "both")}


def _curves(sides: dict[str, Events], t0: int, t1: int, pixels: int) -> dict[str, Any]:
    """Rates over time in steps of at least 1 ms, and how their ups and downs correlate."""
    step = max(CURVE_STEP_US, -(-(t1 - t0) // CURVE_STEPS))
    steps = max(1, (t1 - t0) // step)  # whole steps: the rest would look like a drop
    edges = t0 + step * np.arange(steps + 1)
    curves = {name: {p: np.histogram(events.t[events.p == on], edges)[0] / (step * 1e-6 * pixels)
                     for p, on in (("on", True), ("off", False))}
              for name, events in sides.items()}
    r = {p: _correlation(curves["real"][p], curves["synthetic"][p]) for p in ("on", "off")}
    return {"start_us": t0, "step_us": int(step), "r": r,
            **{name: {p: c.tolist() for p, c in both.items()} for name, both in curves.items()}}


def _net(events: Events, t0: int, t1: int) -> np.ndarray:
    """ON less OFF events of each cell and time step."""
    step = max(NET_US, -(-(t1 - t0) // NET_STEPS))
    columns, rows = (-(-side // NET_CELL) for side in events.size)
    cell = (events.y // NET_CELL).astype(np.int64) * columns + events.x // NET_CELL
    code = (events.t - t0) // step * (columns * rows) + cell
    size = -(-(t1 - t0) // step) * columns * rows
    return np.bincount(code, np.where(events.p, 1.0, -1.0), size)


def _active(real: np.ndarray, synthetic: np.ndarray) -> dict[str, float | None]:
    return {"real": float(real.mean()), "synthetic": float(synthetic.mean()),
            "common": _ratio(float((real & synthetic).sum()), float((real | synthetic).sum()))}


def _delays(sides: dict[str, Events]) -> dict[str, Any]:
    """Intervals of events to those before at the same pixel and at its neighbours."""
    found = {name: _of_pixels(events) for name, events in sides.items()}
    around = {name: delays for name, (_, _, delays) in found.items()}
    same = {name: share for name, (_, share, _) in found.items()}
    intervals = _times_alike({name: own for name, (own, _, _) in found.items()})
    del found  # as large as the events
    alone = {name: float((d > ALONE_US).mean()) if d.size else None for name, d in around.items()}
    near = {name: d[np.isfinite(d)] for name, d in around.items()}
    return {"intervals": intervals, "neighbours": {**_times_alike(near), "alone": alone},
            "same_polarity": same}


def _of_pixels(events: Events) -> tuple[np.ndarray, float | None, np.ndarray]:
    """`_own_intervals` and `_neighbour_delays`, from one sort, which is as large as the events."""
    keys, order = _by_pixel(events)
    return *_own_intervals(events, order), _neighbour_delays(events, keys, order)


def _by_pixel(events: Events) -> tuple[np.ndarray, np.ndarray]:
    """Of the events by pixel and then by time: pixel * N + number (N,), which is sorted in a fifth
    of the time that an order takes, and number."""
    keys = _pixels(events) * len(events)
    keys += np.arange(len(events))
    keys.sort()
    return keys, keys % max(len(events), 1)


def _own_intervals(events: Events, order: np.ndarray) -> tuple[np.ndarray, float | None]:
    """(M,) us between successive events of a pixel; the share of them of one polarity. order: of
    `_by_pixel`."""
    pixel, t, p = _pixels(events)[order], events.t[order], events.p[order]
    same = pixel[1:] == pixel[:-1]
    repeats = (p[1:] == p[:-1])[same]
    return np.diff(t)[same].astype(np.float64), float(repeats.mean()) if repeats.size else None


def _neighbour_delays(events: Events, keys: np.ndarray, order: np.ndarray) -> np.ndarray:
    """(M,) us from the latest event of the eight pixels around to an event, inf without one;
    M <= ASKED_EVENTS events, evenly taken. keys, order: of `_by_pixel`."""
    n = len(events)
    width, height = events.size
    chosen = np.zeros(n, bool)
    chosen[np.linspace(0, n - 1, min(n, ASKED_EVENTS)).astype(np.int64)] = True
    asked = order[chosen[order]]  # those of a pixel together: found in the cache
    x, y = events.x[asked].astype(np.int64), events.y[asked].astype(np.int64)
    latest = np.full(len(asked), -1)
    for dx, dy in NEIGHBOURS:
        inside = (x + dx >= 0) & (x + dx < width) & (y + dy >= 0) & (y + dy < height)
        pixel = (y + dy) * width + x + dx
        pixel *= n
        before = np.searchsorted(keys, pixel + asked) - 1
        number = keys.take(np.maximum(before, 0)) - pixel  # below 0: an event of another pixel
        np.maximum(latest, np.where(inside & (before >= 0), number, -1), out=latest)
    delay = (events.t[asked] - events.t[np.maximum(latest, 0)]).astype(np.float64)
    return np.where(latest >= 0, delay, np.inf)


def _pixels(events: Events) -> np.ndarray:
    return events.y.astype(np.int64) * events.size[0] + events.x


def _times_alike(us: dict[str, np.ndarray]) -> dict[str, Any]:
    """Distances, medians and histograms of two sets of times, in log10 seconds (at least 1 us)."""
    logs = {name: np.sort(np.log10(np.maximum(v, 1.0) * 1e-6)) for name, v in us.items()}
    ks, wasserstein = distances(logs["real"], logs["synthetic"])
    shares = {name: (np.histogram(np.clip(v, LOG_EDGES[0], LOG_EDGES[-1]), LOG_EDGES)[0]
                     / max(1, v.size)).tolist() for name, v in logs.items()}
    medians = {name: float(10 ** np.median(v)) if v.size else None for name, v in logs.items()}
    return {"ks": ks, "wasserstein_decades": wasserstein, "median_s": medians,
            "histogram": {"log10_s_edges": LOG_EDGES.tolist(), **shares}}


def distances(a: np.ndarray, b: np.ndarray) -> tuple[float | None, float | None]:
    """Kolmogorov-Smirnov max |F - G| and Wasserstein-1 (integral of |F - G|) of two sorted samples
    (N,), (M,); None for both where one is empty."""
    if not (a.size and b.size):
        return None, None
    at = np.sort(np.concatenate([a, b]), kind="stable")  # merges the two
    apart = np.searchsorted(a, at, side="right") / a.size
    apart -= np.searchsorted(b, at, side="right") / b.size
    np.abs(apart, out=apart)
    return float(apart.max()), float(apart[:-1] @ np.diff(at))
