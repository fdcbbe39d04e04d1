"""Frames whose rows are read one after the other are found, and frames of one time are not."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from helpers.networks import hidden

from evflow import Recording, check
from evflow.recordings.adjust import shifted
from evflow.recordings.check.findings import Finding
from evflow.recordings.check.rows import rolling
from evflow.recordings.check.steps import frame_steps
from evflow.types import Events


@pytest.fixture(scope="module")
def moving() -> Recording:
    """A lively scene seen for a second; frames every 40 ms."""
    return hidden(14, 900)[0]


def rolled(recording: Recording, late_us: int) -> Recording:
    """As if the frames' last row was read so much later than the first, at a time that all rows are
    given: its events come later than the frame."""
    e = recording.events
    t = e.t + (late_us * e.y.astype(np.int64)) // e.size[1]
    order = np.argsort(t, kind="stable")
    events = Events(e.x[order], e.y[order], t[order], e.p[order], e.size)
    return dataclasses.replace(recording, events=events)


def found(recording: Recording) -> Finding | None:
    steps = frame_steps(recording)
    assert steps is not None
    return rolling(steps)


@pytest.mark.parametrize(("late_us", "side"), [
    (12_000, "later"), (25_000, "later"), (-20_000, "earlier")])
def test_a_rolling_shutter_is_found_with_its_time(
    moving: Recording, late_us: int, side: str
) -> None:
    finding = found(rolled(moving, late_us))
    assert finding is not None
    assert (finding.code, finding.severity) == ("EV024", "warning")
    said = re.search(r"frames is (\d+) ms (\w+)", finding.seen)
    assert said is not None
    assert (float(said[1]), said[2]) == (pytest.approx(abs(late_us) / 1e3, abs=3.0), side)


def test_frames_of_one_time_are_not(moving: Recording, sound: Recording) -> None:
    for recording in (moving, sound, shifted(moving, 15_000), rolled(moving, 4_000)):
        assert found(recording) is None


def test_an_offset_is_told_beside_it(moving: Recording) -> None:
    findings = check(shifted(rolled(moving, 25_000), 40_000)).findings
    assert [f.code for f in findings] == ["EV024", "EV024"]
    assert "--frames-offset-ms" in findings[0].fix
    assert "rolling shutter" in findings[1].seen
    assert "--rolling-ms auto" in findings[1].fix
