"""The checks: each usual mistake is found and named, and a sound recording passes."""

from __future__ import annotations

import builtins
import dataclasses
import errno
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evflow import Events, Recording, Report, check, read_recording, write_events
from evflow.errors import CODES, EvflowDataError
from evflow.light.colour import CONVERTED
from evflow.notes import Note
from evflow.recordings.adjust import shifted
from evflow.recordings.check import frames_offset
from evflow.recordings.faulty_pixels import hot_among_neighbours


def changed(recording: Recording, **columns: Any) -> Recording:
    """The recording with other columns of events."""
    old = {n: getattr(recording.events, n) for n in ("x", "y", "t", "p", "size")}
    return dataclasses.replace(recording, events=Events(**(old | columns)))


def codes(recording: Recording) -> list[str]:
    return [f.code for f in check(recording).findings]


def refused(call: Callable[[], Any]) -> EvflowDataError:
    with pytest.raises(EvflowDataError) as caught:
        call()
    return caught.value


def test_a_sound_recording_has_no_findings(sound: Recording) -> None:
    report = check(sound)
    assert report == Report()
    report.raise_if_failed()
    assert json.loads(report.to_json()) == {"errors": [], "warnings": [], "notes": []}


def test_mistake_1_polarity_swapped(sound: Recording) -> None:
    report = check(changed(sound, p=~sound.events.p))
    assert [f.code for f in report.errors] == ["EV021"]
    assert "--polarity invert" in report.errors[0].fix
    assert refused(report.raise_if_failed).code == "EV021"
    assert refused(lambda: changed(sound, p=sound.events.p.astype(np.uint8) * 255)).code == "EV006"


def test_mistake_1b_polarity_lost(sound: Recording) -> None:
    assert "EV022" in codes(changed(sound, p=np.ones(len(sound.events), bool)))


@pytest.mark.parametrize(("factor", "unit"), [(1e-6, "s"), (1e-3, "ms"), (1e3, "ns")])
def test_mistake_2_time_unit(sound: Recording, factor: float, unit: str) -> None:
    t = np.rint(sound.events.t * factor).astype(np.int64)
    (error,) = check(changed(sound, t=t)).errors
    assert error.code == "EV023"
    assert error.fix.startswith(f"Pass --time-unit {unit}")


def test_mistake_2_time_unit_without_frames(sound: Recording) -> None:
    bare = changed(Recording.of_events(sound.events), t=sound.events.t // 1000)
    assert [f.code for f in check(bare).errors] == ["EV023"]


def test_mistake_3_unsorted(sound: Recording) -> None:
    error = refused(lambda: changed(sound, t=sound.events.t[::-1]))
    assert error.code == "EV004"
    assert "go back" in error.seen


@pytest.mark.parametrize("offset_ms", [-50, 40, 70])
def test_mistake_4_frames_misaligned(sound: Recording, offset_ms: int) -> None:
    moved = shifted(sound, offset_ms * 1000)
    (finding,) = check(moved).findings
    assert finding.code == "EV024"
    assert "--frames-offset-ms" in finding.fix
    assert frames_offset(moved) == pytest.approx(-offset_ms * 1000, abs=6_000)
    assert moved.notes == (Note("frames.moved", f"frame times shifted by {offset_ms:+g} ms"),)


def test_mistake_4_small_offsets_are_within_the_latency(sound: Recording) -> None:
    for offset_us in (-8_000, 0, 8_000):
        moved = shifted(sound, offset_us)
        assert codes(moved) == []
        assert frames_offset(moved) == 0


def test_mistake_5_dtype(sound: Recording) -> None:
    error = refused(lambda: changed(sound, x=sound.events.x + 0.37))
    assert error.code == "EV003"
    assert "undistorted" in error.fix


def test_mistake_6_shape(sound: Recording) -> None:
    rows = np.stack([sound.events.x, sound.events.y, sound.events.t, sound.events.p])
    error = refused(lambda: Events(rows, rows, rows, rows, (64, 48)))
    assert error.code == "EV002"
    frames = np.swapaxes(sound.frames, 1, 2)
    error = refused(lambda: dataclasses.replace(sound, frames=frames))
    assert error.code == "EV015"
    assert "frames transposed" in error.fix


def test_mistake_7_nan(sound: Recording) -> None:
    frames = sound.frames.astype(np.float32)
    frames[3, 5, 6] = np.nan
    error = refused(lambda: dataclasses.replace(sound, frames=frames))
    assert error.code == "EV007"
    assert "frame 3" in error.seen


def test_mistake_8_colour_frames(sound: Recording) -> None:
    colour = np.repeat(sound.frames[..., None], 3, -1)
    assert refused(lambda: dataclasses.replace(sound, frames=colour)).code == "EV002"
    elsewhere = Note("frames.replaced", "frames come from colour.mp4")
    noted = dataclasses.replace(sound, notes=(elsewhere,))
    assert not check(noted).notes
    noted = dataclasses.replace(sound, notes=(CONVERTED,))
    (note,) = check(noted).notes
    assert note.code == "EV032"


def test_mistake_9_no_frames(sound: Recording) -> None:
    report = check(Recording.of_events(sound.events))
    assert [f.code for f in report.warnings] == ["EV011"]
    assert "--frames DIR" in report.warnings[0].fix
    assert [f.code for f in report.strict().errors] == ["EV011"]


def test_mistake_10_gaps(sound: Recording) -> None:
    t = sound.events.t
    later = np.where(t > 250_000, t + 90_000, t)
    frames = sound.frame_times + np.where(sound.frame_times > 250_000, 90_000, 0)
    gapped = dataclasses.replace(changed(sound, t=later), frame_times=frames)
    found = {f.code: f for f in check(gapped).warnings}
    assert set(found) == {"EV025", "EV030"}
    assert "0.25" in found["EV025"].seen
    assert "about 2 frames are missing in 1 place, first after frame 5" in found["EV030"].seen


def test_the_clock_jumps(sound: Recording) -> None:
    t = sound.events.t
    jumped = changed(sound, t=np.where(t > 250_000, t + 3_600_000_000, t))
    found = [f for f in check(Recording.of_events(jumped.events)).warnings if f.code == "EV026"]
    assert len(found) == 1
    assert "--stop 0.2" in found[0].fix


def test_mistake_11_damaged_file(sound: Recording, tmp_path: Path) -> None:
    path = tmp_path / "cut.npz"
    write_events(path, sound, format="npz")
    path.write_bytes(path.read_bytes()[:2000])
    (error,) = check(path).errors
    assert error.code == "EV009"


def test_mistake_12_disk_full(
    sound: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*a: Any, **k: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    real = builtins.open

    def opened(file: Any, mode: str = "r", *a: Any, **k: Any) -> Any:
        if "w" in mode:
            full()
        return real(file, mode, *a, **k)

    monkeypatch.setattr(builtins, "open", opened)
    monkeypatch.setattr(np, "savez_compressed", full)
    error = refused(lambda: write_events(tmp_path / "out.npz", sound, format="npz"))
    assert error.code == "EV019"
    assert list(tmp_path.iterdir()) == []


def test_mistake_13_outside_the_sensor(sound: Recording, tmp_path: Path) -> None:
    error = refused(lambda: changed(sound, size=(40, 48)))
    assert error.code == "EV005"
    path = tmp_path / "bare.npz"
    write_events(path, sound.events, format="npz")
    assert refused(lambda: read_recording(path, size=(40, 48))).code == "EV005"
    kept = read_recording(path, size=(40, 48), drop_outside=True)
    assert len(kept.events) == (sound.events.x < 40).sum()
    assert kept.notes[0].code == "events.outside"
    assert "--drop-outside" in kept.notes[0].text


def test_mistake_14_empty(sound: Recording, tmp_path: Path) -> None:
    nothing = Recording(sound.events.slice(0, 0), sound.frames, sound.frame_times)
    assert codes(nothing) == ["EV001"]
    path = tmp_path / "rec.npz"
    write_events(path, sound, format="npz")
    (error,) = check(path, start_s=10, stop_s=12).errors
    assert error.code == "EV001"
    assert "covers 0.000 to" in error.fix


def test_mistake_15_sixteen_bit_frames(sound: Recording) -> None:
    deep = dataclasses.replace(sound, frames=sound.frames.astype(np.uint16) * 16)
    (note,) = check(deep).notes
    assert note.code == "EV031"
    assert "12-bit" in note.seen


def test_mistake_16_missing_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *a: Any, **k: Any) -> Any:
        if name == "h5py":
            raise ImportError(name)
        return real(name, *a, **k)

    path = tmp_path / "x.h5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    monkeypatch.setattr(builtins, "__import__", without)
    report = check(path)
    assert report.errors[0].code in ("EV010", "EV008")


def test_mistake_17_too_few_events(sound: Recording) -> None:
    n = 60
    part = sound.events
    t = np.linspace(0, 500_000, n).astype(int)
    few = Events(part.x[:n], part.y[:n], t, part.p[:n], (64, 48))
    found = check(dataclasses.replace(sound, events=few)).warnings
    assert "EV017" in [f.code for f in found]


def test_frames_and_events_of_different_times(sound: Recording) -> None:
    assert codes(shifted(sound, 10_000_000)) == ["EV012"]


def test_events_that_begin_at_the_end_leave_no_window(sound: Recording) -> None:
    end = int(sound.frame_times[-1])
    late = dataclasses.replace(sound.events, t=sound.events.t - sound.events.t[0] + end - 10_000)
    found = check(dataclasses.replace(sound, events=late))
    assert "EV017" in [f.code for f in found.errors]


def test_windows_are_those_of_the_estimate(sound: Recording) -> None:
    """Two frames 20 ms apart are enough for windows of 20 ms."""
    begin = int(sound.frame_times[2])
    two = dataclasses.replace(
        sound, events=sound.events.slice(begin, begin + 20_000), frames=sound.frames[2:4],
        frame_times=np.array([begin, begin + 20_000]))
    found = [[f.code for f in check(two, min_window_us=us).errors] for us in (40_000, 20_000)]
    assert "EV017" in found[0]
    assert "EV017" not in found[1]


def test_saturated_black_and_repeated_frames(sound: Recording) -> None:
    bright = np.clip(sound.frames.astype(int) * 4, 0, 255).astype(np.uint8)
    assert "EV027" in codes(dataclasses.replace(sound, frames=bright))
    dark = sound.frames.copy()
    dark[4] = 0
    (warning,) = check(dataclasses.replace(sound, frames=dark)).warnings
    assert warning.code == "EV027"
    assert "frame 4" in warning.seen
    twice = sound.frames.copy()
    twice[5] = twice[4]
    assert "EV028" in codes(dataclasses.replace(sound, frames=twice))


def test_hot_pixels_are_noted(sound: Recording) -> None:
    t = np.concatenate([sound.events.t, np.arange(0, 500_000, 50)])
    order = np.argsort(t, kind="stable")
    new = {n: np.concatenate([getattr(sound.events, n), np.full(10_000, v)])[order]
           for n, v in (("x", 3), ("y", 5), ("p", 1))}
    found = check(changed(sound, **new, t=t[order])).findings
    assert [f.code for f in found if f.severity == "note"] == ["EV033"]
    assert "x=3, y=5" in found[-1].seen


def test_only_what_exceeds_its_neighbours_is_hot_however_busy_all_are() -> None:
    counts = np.full((32, 40), 3_000)
    assert not hot_among_neighbours(counts).any()
    counts[4, 7] = 40_000
    assert np.argwhere(hot_among_neighbours(counts)).tolist() == [[4, 7]]


def test_codes_are_stable() -> None:
    assert list(CODES) == [f"EV{i:03}" for i in range(1, len(CODES) + 1)]
    assert CODES["EV021"] == "polarity inverted"


@pytest.mark.parametrize(("name", "codes"), [
    ("newton_cradle_davis346.aedat4", []), ("ijrr_slider_depth", ["EV035"])])
def test_real_recordings_with_frames_pass(
    data_file: Callable[[str], Path], name: str, codes: list[str]
) -> None:
    path = data_file(f"data/recordings/{name}")
    assert [finding.code for finding in check(path).findings] == codes
    (error,) = check(path, polarity="invert").errors
    assert error.code == "EV021"


@pytest.mark.parametrize(("name", "more"), [
    ("recordings/gen3_vga_person/events.npz", ["EV036"]),  # by lamps on mains of 60 Hz
    ("recordings/noise_static_dvxplorer640/events.npz", []), ("formats/evt2_sample.raw", []),
    ("formats/davis240_aedat2.aedat", []), ("formats/dvxplorer320.aedat4", [])])
def test_real_recordings_without_frames_lack_frames_alone(
    data_file: Callable[[str], Path], name: str, more: list[str]
) -> None:
    report = check(data_file(f"data/{name}"))
    assert report.errors == ()
    assert sorted(f.code for f in report.warnings) == ["EV011", *more]
    assert all("at 120.4 Hz" in f.seen for f in report.warnings if f.code == "EV036")
