"""What makes thresholds wrong without looking wrong: events and frames that do not belong together,
or not like this."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from helpers.benches import SHAPE, screen

from evflow import Camera, Events, Recording, check, simulate
from evflow.recordings.adjust import flipped, shifted
from evflow.recordings.check import frames_offset
from evflow.recordings.check.contents import BLOCK, BLOCKS, repeated


def codes_of(recording: Recording) -> set[str]:
    return {finding.code for finding in check(recording).findings}


@pytest.mark.parametrize("side", ["horizontal", "vertical", "both"])
def test_mirrored_frames(sound: Recording, side: str) -> None:
    (error,) = check(flipped(sound, side)).errors
    assert error.code == "EV029"
    assert error.fix == f"Pass --flip-frames {side}, or remove what was passed."


def test_events_and_frames_that_are_unrelated_are_an_error(sound: Recording) -> None:
    e = sound.events
    order = np.random.default_rng(0).permutation(64 * 48)
    pixel = order[e.y.astype(int) * 64 + e.x]
    scattered = dataclasses.replace(e, x=pixel % 64, y=pixel // 64)
    assert "EV034" in codes_of(dataclasses.replace(sound, events=scattered))


@pytest.mark.parametrize("offset_ms", [-40, 30])
def test_inversion_and_offset_are_found_together(sound: Recording, offset_ms: int) -> None:
    swapped = dataclasses.replace(sound.events, p=~sound.events.p)
    moved = shifted(dataclasses.replace(sound, events=swapped), offset_ms * 1000)
    (finding,) = check(moved).errors
    assert finding.code == "EV021"
    assert frames_offset(moved) == pytest.approx(-offset_ms * 1000, abs=8_000)


def test_mirrored_and_inverted_are_found_together(sound: Recording) -> None:
    swapped = dataclasses.replace(sound.events, p=~sound.events.p)
    (finding,) = check(flipped(dataclasses.replace(sound, events=swapped), "horizontal")).errors
    assert finding.code == "EV029"
    assert "--polarity invert" in finding.fix


def rows_of(events: Events, rows: Any, **columns: Any) -> Events:
    """Some rows of the events, with other values in some columns."""
    kept = {n: getattr(events, n)[rows] for n in ("x", "y", "t", "p")} | {"size": events.size}
    return Events(**(kept | columns))


def transposed(r: Recording, turns: int = 0) -> Recording:
    """The square part of a recording, its events with x and y swapped; frames turned by 90
    degrees."""
    side = min(r.events.size)
    kept = (r.events.x < side) & (r.events.y < side)
    frames = np.rot90(r.frames[:, :side, :side], turns, (1, 2)).copy()
    x, y = r.events.x[kept], r.events.y[kept]
    return Recording(rows_of(r.events, kept, x=y, y=x, size=(side, side)), frames, r.frame_times)


def displaced(r: Recording, dx: int, dy: int) -> Recording:
    x, y = r.events.x.astype(int) + dx, r.events.y.astype(int) + dy
    kept = (x >= 0) & (x < r.events.size[0]) & (y >= 0) & (y < r.events.size[1])
    return dataclasses.replace(r, events=rows_of(r.events, kept, x=x[kept], y=y[kept]))


def again(r: Recording, share: float) -> Recording:
    """The recording with the first part of its events written twice."""
    n = len(r.events)
    rows = np.sort(np.concatenate([np.arange(n), np.arange(int(share * n))]))
    return dataclasses.replace(r, events=rows_of(r.events, rows))


def shown(r: Recording, frames: np.ndarray) -> Recording:
    return dataclasses.replace(r, frames=np.broadcast_to(frames, r.frames.shape).copy())


def turned_midway(r: Recording) -> Recording:
    return dataclasses.replace(r, events=dataclasses.replace(
        r.events, p=r.events.p ^ (r.events.t > np.median(r.frame_times))))


def timed(r: Recording, factor: float) -> Recording:
    first = int(r.frame_times[0])
    return dataclasses.replace(
        r, frame_times=first + np.rint((r.frame_times - first) * factor).astype(np.int64))


def backwards(r: Recording) -> Recording:
    return dataclasses.replace(r, frames=r.frames[::-1])


def by_name(r: Recording) -> Recording:
    """Frames in the order 1, 10, 11, 2, 3, ..."""
    return dataclasses.replace(r, frames=r.frames[sorted(range(len(r.frames)), key=str)])


@pytest.mark.parametrize(("make", "code", "severity", "said"), [
    (turned_midway, "EV024", "error", "but not around"),
    (lambda r: timed(r, 0.7), "EV024", "error", "--frames-fps"),
    (lambda r: timed(r, 0.9), "EV024", "warning", "--frames-fps"),
    (lambda r: timed(r, 0.95), "EV024", "warning", "5."),
    (lambda r: timed(r, 2.0), "EV024", "error", "--frames-fps"),
    (backwards, "EV024", "error", "reverse order"),
    (by_name, "EV024", "error", "out of order"),
    (transposed, "EV029", "error", "rows and columns of the frames swapped"),
    (lambda r: transposed(r, 1), "EV029", "error", "mirrored in the"),
    (lambda r: displaced(r, 9, -6), "EV037", "error", "px to the right and"),
    (lambda r: displaced(r, -9, 6), "EV037", "error", "px below"),
    (lambda r: again(r, 1.0), "EV038", "error", "50%"),
    (lambda r: again(r, 0.04), "EV038", "warning", "4%"),
    (lambda r: shown(r, r.frames[3]), "EV034", "error", "are alike"),
    (lambda r: shown(r, np.uint8(90)), "EV034", "error", "are alike")])
def test_what_makes_thresholds_wrong_is_found(
    sound: Recording, make: Callable[[Recording], Recording], code: str, severity: str, said: str
) -> None:
    findings = {f.code: f for f in check(make(sound)).findings}
    assert (findings[code].severity, said in str(findings[code])) == (severity, True)


@pytest.mark.parametrize("count", [3_000, BLOCK + 2, 3 * BLOCK, 9 * BLOCK, 20 * BLOCK])
def test_every_event_is_counted_once_when_repeats_are_looked_for(count: int) -> None:
    once = np.random.default_rng(0).integers(0, 60, (2, (count + 1) // 2))
    x, y = np.repeat(once, 2, axis=1)[:, :count]
    t = np.repeat(7 * np.arange(once.shape[1]), 2)[:count]
    (finding,) = repeated(Events(x, y, t, np.ones(count, bool), (60, 60)))
    assert finding.seen.startswith(f"50% of {min(count, BLOCKS * BLOCK):,} events repeat another")


def test_an_exposure_that_varies_displaces_nothing(sound: Recording) -> None:
    """Frames that change as a whole agree less with events at any time, but not in any place."""
    gain = np.where(np.arange(len(sound.frames)) % 2, 0.7, 1.0)[:, None, None]
    varied = dataclasses.replace(sound, frames=np.rint(sound.frames * gain).astype(np.uint8))
    assert {"EV024", "EV029", "EV037"} & codes_of(varied) == set()


def test_a_clock_of_few_digits_may_repeat_events(sound: Recording) -> None:
    """As a simulator that stamps all events of a step alike does."""
    coarse = dataclasses.replace(sound, events=dataclasses.replace(
        sound.events, t=sound.events.t // 20_000 * 20_000))
    assert len(np.unique(np.stack([coarse.events.t, coarse.events.x]), axis=1).T) < len(
        coarse.events)
    assert "EV038" not in codes_of(coarse)


@pytest.fixture(scope="module")
def rests() -> Recording:
    """A light that steps every quarter of a second, filmed at 40 frames a second."""
    dn = screen([40.0, 100.0, 55.0, 220.0] * 6, rest=250, ramp=1)
    shown = np.flatnonzero(np.diff(dn, prepend=0.0, append=0.0)[:-1] != 0)
    shown = np.union1d(np.union1d(shown - 1, shown)[1:], np.arange(10, len(dn), 25))
    video = np.broadcast_to(dn[shown, None, None], (len(shown), *SHAPE))
    events = simulate(jax.random.key(0), video, 1000 * shown,
                      Camera.constant(SHAPE, 0.25, 0.25, 2.0, 2.0))
    kept = np.arange(10, len(dn), 25)
    frames = np.broadcast_to(dn[kept, None, None], (len(kept), *SHAPE))
    return Recording(events, np.ascontiguousarray(frames, np.float32), 1000 * kept)


def filmed(r: Recording, noise_dn: float) -> Recording:
    """The recording with frames of 8 bits and that noise."""
    noise = np.random.default_rng(1).normal(0.0, noise_dn, r.frames.shape)
    return dataclasses.replace(r, frames=np.rint(r.frames + noise).clip(0, 255).astype(np.uint8))


@pytest.mark.parametrize("noise_dn", [0.0, 0.7])
def test_a_light_that_rests_most_of_the_time_is_checked_at_its_steps(
    rests: Recording, noise_dn: float
) -> None:
    """Evenly spread frame intervals may all lie within rests, where nothing but noise changes."""
    found = check(filmed(rests, noise_dn))
    assert not {"EV024", "EV034"} & {f.code for f in found.findings}


@pytest.mark.parametrize(("noise_dn", "offset_ms"), [(0.0, 50), (0.7, -100), (0.7, 150)])
def test_frames_of_such_a_light_may_be_late_by_several_intervals(
    rests: Recording, noise_dn: float, offset_ms: int
) -> None:
    """No events come between the frames of a step, which looks like a change of exposure."""
    late = shifted(filmed(rests, noise_dn), 1000 * offset_ms)
    (error,) = check(late).errors
    assert error.code == "EV024"
    assert frames_offset(late) == pytest.approx(-1000 * offset_ms, abs=10_000)


def test_a_change_of_exposure_in_a_scene_at_rest_is_no_step_of_its_light(rests: Recording) -> None:
    """The events are noise, at whatever time the frames are taken to be."""
    n, rng = 20_000, np.random.default_rng(1)
    t = np.sort(rng.integers(rests.events.t[0], rests.events.t[-1], n))
    noise = Events(rng.integers(0, SHAPE[1], n), rng.integers(0, SHAPE[0], n), t,
                   rng.random(n) < 0.5, SHAPE[::-1])
    still = dataclasses.replace(filmed(rests, 0.7), events=noise)
    assert not {"EV021", "EV024", "EV029"} & codes_of(still)
    assert frames_offset(still) == 0


def test_a_scene_of_which_only_the_light_changes_is_not_unrelated() -> None:
    """All cells change alike, so that none of them tells events of the light from those of chance;
    frames that become darker instead do."""
    rng, shape, times = np.random.default_rng(2), (128, 160), 40_000 * np.arange(26)
    light = np.exp(0.3e-6 * times)[:, None, None]
    dn = np.broadcast_to(rng.uniform(30.0, 120.0, shape) * light, (26, *shape))
    camera = Camera.constant(shape, 0.05, 0.05, 0.2, 0.2)
    events = simulate(jax.random.key(1), dn.astype(np.float32), times, camera)
    rising = filmed(Recording(events, dn.astype(np.float32), times), 1.0)
    assert "EV034" not in codes_of(rising)
    falling = dataclasses.replace(rising, frames=rising.frames[::-1].copy())
    assert "EV034" in codes_of(falling)
