"""Time: its unit, gaps and jumps of the events' clock, dropped frames."""

from __future__ import annotations

import numpy as np

from evflow.recordings.check.findings import Finding
from evflow.recordings.gaps import PACKET, event_gaps
from evflow.recordings.windows import DROPPED
from evflow.types import Recording

UNITS = {  # log10 of (span as read) / (true span): what the times look like, and the option
    -6: ("s read as us", "s"), -3: ("ms read as us", "ms"),
    3: ("ns read as us", "ns (or ms where they were read in s, us where in ms)"),
    6: ("us read as s", "us")}
NEAR = 0.4  # of log10: the ratio of two spans of one recording, events and frames
FAST_HZ, SLOW_HZ = 100.0, 1.0  # events per second and pixel: few sensors send more, or less
LEAST_EVENTS = 1_000
MOST_HZ = 5_000.0  # events per second and pixel, mean of a whole sensor: none sends as many
STRETCHED_HZ, TICK_US = 0.1, 1_000  # nor so few where anything moves; times of a us, stretched
LASTING_HZ, FLASH = 1_500.0, 20  # nor, after 20 events a pixel, this: links carry 60 to 1,150
JUMP_US = 10_000_000  # a jump is longer, and longer than all the rest of the recording


def clocks(recording: Recording) -> list[Finding]:
    """EV023 (unit), EV025 (gaps), EV026 (jump), EV030 (dropped frames)."""
    wrong = _unit(recording)
    return [wrong] if wrong else [*_gaps(recording), *_dropped(recording)]


def _unit(recording: Recording) -> Finding | None:
    events, times = recording.events, recording.frame_times
    if len(events) < 2:
        return None
    span = max(events.duration_us, 1)
    rate = len(events) / span * 1e6 / (events.size[0] * events.size[1])
    if len(times) > 1:
        frames_us = int(times[-1] - times[0])
        ratio = np.log10(span / frames_us)
        for power, (what, unit) in UNITS.items():
            # a short cut of a long recording has a usual rate
            odd = rate > FAST_HZ if power < 0 else rate < SLOW_HZ
            if odd and abs(ratio - power) < NEAR:
                return Finding(
                    "EV023", "error", f"events span {span:,} us but frames {frames_us:,} us: the "
                    f"event times look like {what}.", f"Pass --time-unit {unit}.")
    lasting = len(events) > FLASH * events.size[0] * events.size[1]
    if len(events) >= LEAST_EVENTS and rate > (LASTING_HZ if lasting else MOST_HZ):
        return Finding(
            "EV023", "error", f"{len(events):,} events in {span:,} us are {rate:,.0f} per second "
            "and pixel, more than a sensor sends: milliseconds read as microseconds?",
            "Pass --time-unit ms (or s).")
    if len(events) >= LEAST_EVENTS and rate < STRETCHED_HZ and _coarse(events.t):
        return Finding(
            "EV023", "warning", f"all times are {TICK_US:,} us apart or multiples of that, and "
            f"{rate:.2g} events per second and pixel are few: times a thousand times too long? "
            "Or steps of 1 ms of a simulator.", "Pass --time-unit ns where they were read in us, "
            "us where in ms, ms where in s.")
    return None


def _coarse(t: np.ndarray) -> bool:
    """Do all times (N,) lie on ticks of a millisecond? Most recordings answer at the first ones."""
    return all(not ((part - t[0]) % TICK_US).any() for part in (t[:PACKET], t))


def _gaps(recording: Recording) -> list[Finding]:
    t = recording.events.t
    at = event_gaps(t)
    if not len(at):
        return []
    between = np.diff(t)
    rest = int(t[-1] - t[0]) - int(between[at].sum())
    longest = int(at[np.argmax(between[at])])
    lost_us = int(between[longest])
    from_s, to_s = ((int(t[i]) - int(t[0])) / 1e6 for i in (longest, longest + 1))
    if lost_us > max(JUMP_US, rest):
        return [Finding(
            "EV026", "warning", f"event times jump from {from_s:.3f} s to {to_s:.3f} s, by more "
            f"than the {rest / 1e6:.3f} s that hold events: another clock from event "
            f"{longest + 1:,} on?", f"Read the parts alone: --stop {from_s:.3f} and "
            f"--start {to_s:.3f}.")]
    more = f" ({len(at)} gaps, {between[at].sum() / 1e6:.2f} s in all)" if len(at) > 1 else ""
    return [Finding(
        "EV025", "warning", f"no events between {from_s:.3f} s and {to_s:.3f} s{more}: dropped "
        "packets, or a scene that stood still?",
        "Windows there are left out of an estimate. To leave it out elsewhere: "
        f"--stop {from_s:.3f} or --start {to_s:.3f}.")]


def _dropped(recording: Recording) -> list[Finding]:
    times = recording.frame_times
    if len(times) < 3:
        return []
    between = np.diff(times)
    usual = float(np.median(between))
    at = np.flatnonzero(between > DROPPED * usual)
    if not len(at):
        return []
    lost = int(np.rint(between[at] / usual - 1).sum())
    places = "1 place" if len(at) == 1 else f"{len(at)} places"
    return [Finding(
        "EV030", "warning", f"about {lost} frames are missing in {places}, first after frame "
        f"{at[0]} ({between[at[0]] / 1e3:.1f} ms where {usual / 1e3:.1f} ms are usual).",
        "No window crosses them; lower the camera's frame rate or its load.")]
