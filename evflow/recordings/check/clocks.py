"""Rules on time: unit, gaps and jumps of the events' clock, dropped frames, events tied to a
clock."""

from __future__ import annotations

import numpy as np

from evflow.io.decode.misread import misread
from evflow.recordings.bunches import bunch
from evflow.recordings.ceiling import rate_ceiling
from evflow.recordings.check.findings import Finding, Severity
from evflow.recordings.flicker import flicker
from evflow.recordings.gaps import event_gaps
from evflow.recordings.windows import DROPPED
from evflow.types import Recording

JUMP_US = 10_000_000  # a jump is longer than this, and longer than the rest of the recording


def clocks(recording: Recording) -> list[Finding]:
    """EV023 (unit), EV025 (gaps), EV026 (jump), EV030 (dropped frames)."""
    wrong = misread(recording.events, recording.frame_times)
    reported = [note.text for note in recording.notes if note.code == "events.unit"]
    if wrong is None:
        return [*_gaps(recording), *_dropped(recording)]
    severity: Severity = "error" if wrong.certain else "warning"
    if reported:  # reported by the reader, which knows the unit it used
        return [Finding("EV023", severity, f"{reported[0]}.")]
    return [Finding("EV023", severity, wrong.seen, f"Pass --time-unit {wrong.unit}.")]


def _gaps(recording: Recording) -> list[Finding]:
    t = recording.events.t
    at = event_gaps(t)
    if not len(at):
        return []
    lost = t[at + 1] - t[at]
    rest = int(t[-1] - t[0]) - int(lost.sum())
    longest, lost_us = int(at[np.argmax(lost)]), int(lost.max())
    from_s, to_s = ((int(t[i]) - int(t[0])) / 1e6 for i in (longest, longest + 1))
    if lost_us > max(JUMP_US, rest):
        return [Finding(
            "EV026", "warning", f"event times jump from {from_s:.3f} s to {to_s:.3f} s, by more "
            f"than the {rest / 1e6:.3f} s that hold events: another clock from event "
            f"{longest + 1:,} on?", f"Read the parts separately: --stop {from_s:.3f} and "
            f"--start {to_s:.3f}.")]
    more = f" ({len(at)} gaps, {lost.sum() / 1e6:.2f} s in all)" if len(at) > 1 else ""
    return [Finding(
        "EV025", "warning", f"no events between {from_s:.3f} s and {to_s:.3f} s{more}: dropped "
        "packets, or a scene that stood still?",
        "An estimate leaves out the windows, or the steps of a bench, there. To exclude it "
        f"elsewhere: --stop {from_s:.3f} or --start {to_s:.3f}.")]


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
        f"{at[0]} ({between[at[0]] / 1e3:.1f} ms instead of the usual {usual / 1e3:.1f} ms).",
        "No window crosses them; lower the camera's frame rate or its load.")]


def capped(recording: Recording) -> list[Finding]:
    """EV039 if the event rate has a ceiling."""
    found = rate_ceiling(recording.events.t)
    return [] if found is None else [Finding(
        "EV039", "warning", f"for {found.share:.0%} of the time with events, their rate is "
        f"{found.per_s:,.0f} events/s and never much higher: a readout at its limit, or an event "
        "rate control (ERC)?",
        "Events are lost or late there; thresholds would come out too high. An estimate leaves out "
        "the windows at the limit. Record slower motion or less contrast, a part of the sensor "
        "(ROI), or with the rate control off.")]


def bunches(recording: Recording) -> list[Finding]:
    """EV035 if events bunch at the frames."""
    found = bunch(recording)
    return [] if found is None else [Finding(
        "EV035", "warning", f"between {found.begin_us / 1e3:+.2f} and {found.end_us / 1e3:+.2f} ms "
        f"of each frame come {found.on:.0%} of the ON and {found.off:.0%} of the OFF events in "
        "excess of the usual rate.",
        "The readout of frames disturbs the pixels (as in a DAVIS240C), or light flashes with the "
        "frames: simulations lack these events, so expect that many fewer.")]


def flickers(recording: Recording) -> list[Finding]:
    """EV036 if the light flickers."""
    found = flicker(recording.events)
    return [] if found is None else [Finding(
        "EV036", "warning", f"the light flickers at {found.hz:.1f} Hz: all over the sensor the "
        f"rates of ON and OFF events rise and fall by {found.on:.0%} and {found.off:.0%} of their "
        "mean.",
        "Lamps on the mains flicker at 100 or 120 Hz, dimmed screens faster. Frames hardly show "
        "it, so an estimate finds thresholds too low (by about 10 % in simulations) and noise too "
        "high: record in daylight or with a DC lamp.")]
