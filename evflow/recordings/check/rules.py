"""Runs all rules."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Unpack

from evflow import io
from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.io.hints import HintArguments
from evflow.recordings.check.agreement import agreement
from evflow.recordings.check.clocks import bunches, capped, clocks, flickers
from evflow.recordings.check.contents import contents, repeated
from evflow.recordings.check.findings import Finding, Report
from evflow.recordings.check.images import images
from evflow.recordings.stillness import stands_still
from evflow.recordings.windows import MIN_US, check_overlap, iter_windows
from evflow.types import Recording, release


def check(
    recording_or_path: Recording | str | os.PathLike, *, min_window_us: int = MIN_US,
    **hints: Unpack[HintArguments],
) -> Report:
    """Look for common faults of a recording before any estimate.

    Without frames, the rules that need only events are applied. Faults of the data are findings,
    never exceptions; `report.raise_if_failed()` raises the first error.

    Codes of the findings: EV001 empty, EV011 no frames, EV012 no overlap, EV017 few events or no
    window, EV021 polarity inverted, EV022 polarity lost, EV023 time unit, EV024 clocks not aligned,
    EV025 gaps, EV026 clock jumps, EV027 saturated or black frames, EV028 repeated frames, EV029
    mirrored or transposed frames, EV030 dropped frames, EV031 bit depth, EV032 colour, EV033 hot
    pixels, EV034 unrelated or frozen frames, EV035 events that bunch at the frames, EV036
    flickering light, EV037 displaced frames, EV038 repeated events, EV039 capped event rate; and
    for a path, whatever the reader refuses.

    Args:
        recording_or_path: the recording, or a file or folder in any known format.
        min_window_us: shortest window that an estimate will use, microseconds.
        **hints: for the reader of a path, as in `read_recording`.

    Returns:
        The report: what was found, with the option that fixes it.

    Raises:
        EvflowDataError: EV020 (neither a recording nor a path).

    Example:
        >>> report = ef.check("flight.h5")
        >>> print(report)
    """
    if not isinstance(recording_or_path, Recording):
        need(recording_or_path, str | os.PathLike, "recording_or_path",
             "For events: Recording.of_events(events).")
        try:
            recording_or_path = io.read_recording(Path(recording_or_path), **hints)
        except EvflowDataError as error:
            return Report((Finding.of(error),))
    return Report(tuple(_findings(recording_or_path, min_window_us)))


def _findings(recording: Recording, min_window_us: int) -> list[Finding]:
    found = contents(recording)
    if not len(recording.events):
        return found
    found += clocks(recording)
    timed = all(f.code != "EV023" for f in found)
    if timed:
        found += [*flickers(recording), *capped(recording), *repeated(recording.events)]
    found += images(recording)
    if recording.has_frames and timed:
        # Noise alone rightly agrees with nothing, and needs no window between two frames.
        still = stands_still(recording)
        if not (still and len(recording.frame_times) == 1):
            try:
                check_overlap(recording)
            except EvflowDataError as error:
                return [*found, Finding.of(error)]
        found += bunches(recording)
        if not still:
            try:
                iter_windows(recording, min_window_us)
            except EvflowDataError as error:
                found.append(Finding.of(error))
            release(recording)
            found += _late(agreement(recording), found)
    release(recording)
    return sorted(found, key=lambda f: ("error", "warning", "note").index(f.severity))


def _late(agreed: list[Finding], found: list[Finding]) -> list[Finding]:
    """What was found on clocks, with other advice where events wait for the readout."""
    if all(f.code != "EV039" for f in found):
        return agreed
    return [dataclasses.replace(
        f, severity="warning", fix="Events that wait at a ceiling of their rate come late "
        "(EV039): check a part of the recording without.") if f.code == "EV024" else f
        for f in agreed]
