"""Times that are a thousand times too long or too short: found where something tells for certain,
and nowhere else."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.recordings import write_ijrr

from evflow import Events, EvflowDataError, Recording, check
from evflow.io import read_recording
from evflow.notes import texts
from evflow.recordings.adjust import with_frames

SIZE = (64, 48)
MS = 1000


def watched(count: int, span_us: int, *, step_us: int = 1) -> Recording:
    """A texture that moves fast beneath frames every 40 ms, and `count` events at random, at
    multiples of step_us."""
    rng = np.random.default_rng(count)
    times = 20 * MS + 40 * MS * np.arange(13)
    texture = rng.integers(30, 230, (48, 200)).astype(np.uint8)
    frames = np.stack([texture[:, 5 * i : 5 * i + 64] for i in range(len(times))])
    t = step_us * np.sort(rng.integers(0, span_us // step_us, count))
    events = Events(rng.integers(0, 64, count), rng.integers(0, 48, count), t,
                    rng.integers(0, 2, count), SIZE)
    return Recording(events, frames, times)


def findings(recording: Recording) -> list[tuple[str, str]]:
    """Severity and words of what is said of the unit."""
    return [(f.severity, str(f)) for f in check(recording).findings if f.code == "EV023"]


@pytest.mark.parametrize("power", [3, 6])
def test_frames_tell_of_times_too_long(power: int) -> None:
    ((severity, words),) = findings(watched(20_000, 500 * MS * 10**power))
    assert severity == "error"
    assert ("ms if they were read in s" if power == 3 else "us read as s") in words


def test_frames_tell_of_a_short_cut_of_times_too_long() -> None:
    """The cut hides how long all events take, not that they are too few for the frames."""
    ((severity, words),) = findings(watched(60, 540 * MS))
    assert severity == "warning"
    assert "but only 5" in words
    assert "--time-unit ns" in words
    assert not findings(watched(20_000, 540 * MS))
    still = watched(60, 540 * MS)
    assert not findings(Recording(still.events, still.frames[:1].repeat(13, 0), still.frame_times))


def test_without_frames_few_events_on_ticks_are_doubted() -> None:
    def bare(*args: int, **kwargs: int) -> Recording:
        return Recording.of_events(watched(*args, **kwargs).events)

    ((severity, words),) = findings(bare(20_000, 500_000 * MS, step_us=1000))
    assert severity == "warning"
    assert "steps of 1 ms of a simulator" in words
    assert not findings(bare(20_000, 500_000 * MS))  # few, but not on ticks
    assert not findings(bare(20_000, 5_000 * MS, step_us=1000))  # on ticks, but a usual rate


def test_more_events_than_a_link_carries() -> None:
    """In a flash every pixel may fire a few times at once; none goes on like that."""
    pixels = SIZE[0] * SIZE[1]
    flash = watched(4 * pixels, 2 * MS)
    assert not findings(Recording.of_events(flash.events))
    ((severity, words),) = findings(Recording.of_events(watched(30 * pixels, 12 * MS).events))
    assert severity == "error"
    assert "--time-unit ms" in words


def mixed(tmp_path: Path, layout: str, frames_unit: str) -> Path:
    """A recording whose events are in ns and whose frame times are in another unit."""
    tmp_path.mkdir(exist_ok=True)
    made = watched(20_000, 500 * MS)
    per_us = {"ns": 1000, "us": 1, "s": 1e-6}[frames_unit]
    t, times = 1000 * made.events.t, per_us * made.frame_times
    ev, path = made.events, tmp_path / f"mixed.{layout}"
    if layout == "npz":
        np.savez(path, t=t, x=ev.x, y=ev.y, p=ev.p, size=SIZE, frames=made.frames,
                 frame_times=times)
    elif layout == "h5":
        with h5py.File(path, "w") as f:
            f.attrs["width"], f.attrs["height"] = SIZE
            for name, column in (("x", ev.x), ("y", ev.y), ("t", t), ("p", ev.p)):
                f[f"events/{name}"] = column
            f["frames"], f["frame_times"] = made.frames, times
    else:
        write_ijrr(path, made)
        (path / "events.txt").write_text("".join(
            f"{a} {x} {y} {int(p)}\n" for a, x, y, p in zip(t, ev.x, ev.y, ev.p, strict=True)))
        (path / "images.txt").write_text("".join(
            f"{a} images/frame_{i:08d}.png\n" for i, a in enumerate(times)))
    return path


@pytest.mark.parametrize(("layout", "frames_unit"), [
    ("npz", "ns"), ("npz", "us"), ("h5", "ns"), ("h5", "us"), ("folder", "ns"), ("folder", "s")])
def test_the_events_unit_leaves_plausible_frame_times_alone(
    tmp_path: Path, layout: str, frames_unit: str
) -> None:
    """--time-unit is the advice where both clocks contradict, so it must not scale both."""
    found = read_recording(mixed(tmp_path, layout, frames_unit), time_unit="ns")
    made = watched(20_000, 500 * MS)
    np.testing.assert_array_equal(found.events.t, made.events.t)
    np.testing.assert_array_equal(found.frame_times, made.frame_times)
    said = [n for n in found.notes
            if n.code == "frames.unit" and f"read in {frames_unit}" in n.text]
    assert len(said) == (frames_unit != "ns")
    part = read_recording(
        mixed(tmp_path / "part", layout, frames_unit), time_unit="ns", start_s=0.2, stop_s=0.3)
    np.testing.assert_array_equal(part.frame_times, made.frame_times[5:8])


@pytest.mark.parametrize("layout", ["npz", "h5"])
def test_frame_times_that_fall_beside_the_events_are_in_another_unit(
    tmp_path: Path, layout: str
) -> None:
    made, epoch = watched(20_000, 500 * MS), 1_700_000_000_000_000
    ev, times, path = made.events, 1000 * (made.frame_times + epoch), tmp_path / f"a.{layout}"
    if layout == "npz":
        np.savez(path, timestamp_ns=1000 * (ev.t + epoch), x=ev.x, y=ev.y, p=ev.p, size=SIZE,
                 frames=made.frames, frame_times=times)
    else:
        with h5py.File(path, "w") as f:
            f.attrs["width"], f.attrs["height"] = SIZE
            for name, column in (("x", ev.x), ("y", ev.y), ("t", ev.t + epoch), ("p", ev.p)):
                f[f"events/{name}"] = column
            f["frames"], f["frame_times"] = made.frames, times
    found = read_recording(path)
    np.testing.assert_array_equal(found.events.t - epoch, ev.t)
    np.testing.assert_array_equal(found.frame_times - epoch, made.frame_times)
    assert [n.text for n in found.notes if n.code == "frames.unit"] == [
        f"frame times of {path} were read in ns."]
    part = read_recording(path, start_s=0.2, stop_s=0.3)
    np.testing.assert_array_equal(part.frame_times - epoch, made.frame_times[5:8])


@pytest.mark.parametrize("later_us", [0, 7_000_000])
@pytest.mark.parametrize(("factor", "words"), [
    (1000, "1,000 times the events'"), (1e-3, "1/1,000 of the events'")])
def test_times_a_thousandfold_apart_are_no_offset(
    tmp_path: Path, factor: float, words: str, later_us: int
) -> None:
    made, epoch = watched(20_000, 500 * MS), 1_700_000_000_000_000
    events = dataclasses.replace(made.events, t=made.events.t + epoch)
    times = (factor * (made.frame_times + epoch + later_us)).astype(np.int64)
    (finding,) = (f for f in check(Recording(events, made.frames, times)).errors
                  if f.code == "EV012")
    assert words in finding.fix
    assert "--timestamps-unit" in finding.fix
    assert "offset" not in finding.fix
    np.savez(tmp_path / "frames.npz", frames=made.frames, frame_times=times)
    with pytest.raises(EvflowDataError, match=r"EV012.*--timestamps-unit") as caught:
        with_frames(Recording.of_events(events), tmp_path / "frames.npz", time_unit="us")
    assert words in caught.value.fix
    assert "offset" not in caught.value.fix


def test_frame_times_in_seconds_beside_whole_events(tmp_path: Path) -> None:
    made = watched(20_000, 500 * MS)
    ev, path = made.events, tmp_path / "a.npz"
    np.savez(path, t=ev.t, x=ev.x, y=ev.y, p=ev.p, size=SIZE, frames=made.frames,
             frame_times=1e-6 * made.frame_times)
    found = read_recording(path)
    np.testing.assert_array_equal(found.frame_times, made.frame_times)
    assert "were read in s" in " ".join(texts(found.notes))


@pytest.mark.parametrize(("hz", "unit"), [(2000, "ns"), (5000, "ms"), (1, "ms"), (0.5, "ns")])
def test_frames_of_any_rate_share_the_unit_that_was_told(
    tmp_path: Path, hz: float, unit: str
) -> None:
    """What one clock wrote stays together: the span of the events tells, not a usual rate."""
    rng, per_us = np.random.default_rng(0), {"ns": 1000, "ms": 1e-3}[unit]
    times = (np.arange(6) * 1e6 / hz).round()
    t = np.sort(rng.integers(0, int(times[-1]) + 1, 5000))
    path = tmp_path / "a.npz"
    np.savez(path, t=t * per_us, x=rng.integers(0, 64, 5000), y=rng.integers(0, 48, 5000),
             p=rng.integers(0, 2, 5000), size=SIZE, frames=np.zeros((6, 48, 64), np.uint8),
             frame_times=times * per_us)
    found = read_recording(path, time_unit=unit)
    np.testing.assert_array_equal(found.frame_times, times)


def test_whole_floats_beside_whole_events(tmp_path: Path) -> None:
    made = watched(20_000, 500 * MS)
    ev, path = made.events, tmp_path / "a.npz"
    np.savez(path, t=ev.t, x=ev.x, y=ev.y, p=ev.p, size=SIZE, frames=made.frames[:1],
             frame_times=made.frame_times[:1].astype(float))
    np.testing.assert_array_equal(read_recording(path).frame_times, made.frame_times[:1])
