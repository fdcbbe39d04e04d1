"""Frames put right: from elsewhere, on another clock, turned round, linear in light; and frames
that hide what the pixels saw."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.networks import hidden

from evflow import Camera, Recording, check, estimate_camera, linearised, read_recording
from evflow.errors import EvflowDataError
from evflow.io.images.times import read_times
from evflow.notes import Note
from evflow.recordings.adjust import flipped, shifted, with_frames
from evflow.recordings.glitches import exposed


@pytest.fixture(scope="module")
def watched() -> tuple[Recording, Camera]:
    return hidden(14)


def theta(recording: Recording) -> np.ndarray:
    found = estimate_camera(recording).summary
    return np.array([float(found.theta_on), float(found.theta_off)])


def coded(recording: Recording, code: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """The recording as a camera with that response, light 0..1 -> code 0..1, shows it."""
    frames = np.rint(255 * code(recording.frames / 255.0)).astype(np.uint8)
    return dataclasses.replace(recording, frames=frames)


def srgb(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def test_a_response_is_undone(watched: tuple[Recording, Camera]) -> None:
    recording = watched[0]
    for response, code in (("gamma", lambda v: v ** (1 / 2.2)), ("srgb", srgb)):
        linear = linearised(coded(recording, code), response)
        assert linear.frames.dtype == np.float32
        away = linear.frames - recording.frames
        assert np.abs(away).max() < 1.3  # half a code value at the steep, bright end
        assert linear.notes == (Note("frames.linearised", f"frames linearised ({response})"),)
    assert linearised(recording, "linear") is recording
    with pytest.raises(EvflowDataError, match="EV020"):
        linearised(recording, "log")
    dark = linearised(dataclasses.replace(recording, frames=recording.frames // 24), "srgb")
    assert 0 < dark.frames.max() < 1  # of codes up to 10; not fractions of white


@pytest.mark.slow
def test_thresholds_of_gamma_frames_are_those_of_linear_ones(
    watched: tuple[Recording, Camera]
) -> None:
    recording = watched[0]
    gamma = coded(recording, lambda light: light ** (1 / 2.2))
    truth = theta(recording)
    assert (theta(gamma) / truth < 0.6).all()  # what is to be repaired: a factor of 2.2
    assert theta(linearised(gamma, "gamma")) == pytest.approx(truth, rel=0.05)


def test_frames_move_and_turn(watched: tuple[Recording, Camera]) -> None:
    recording = watched[0]
    moved = shifted(recording, 12_500)
    assert (moved.frame_times == recording.frame_times + 12_500).all()
    assert moved.notes == (Note("frames.moved", "frame times shifted by +12.5 ms"),)
    assert shifted(recording, 0) is recording
    for side, axis in (("horizontal", 2), ("vertical", 1)):
        turned = flipped(recording, side)
        assert (turned.frames == np.flip(recording.frames, axis)).all()
        assert (flipped(turned, side).frames == recording.frames).all()
    with pytest.raises(EvflowDataError, match="EV020"):
        flipped(recording, "diagonal")


def folder_of(recording: Recording, folder: Path) -> Path:
    folder.mkdir()
    for i, frame in enumerate(recording.frames):
        cv2.imwrite(str(folder / f"frame_{i}.png"), frame)
    return folder


def test_frames_come_from_a_folder_with_begin_and_end_of_exposure(
    watched: tuple[Recording, Camera], tmp_path: Path
) -> None:
    recording = watched[0]
    folder, times = folder_of(recording, tmp_path / "images"), tmp_path / "exposure.txt"
    times.write_text("# begin, end\n" + "".join(
        f"{t - 5_000}, {t + 5_001}\n" for t in recording.frame_times))
    bare = Recording.of_events(recording.events)
    found = with_frames(bare, folder, timestamps=times)
    assert (found.frames == recording.frames).all()
    assert (found.frame_times == recording.frame_times).all()
    assert "--timestamps-unit" in found.notes[1].text
    assert [note.code for note in found.notes] == [
        "frames.replaced", "frames.unit", "frames.exposure"]
    assert found.exposure_us == 10_001
    again = with_frames(found, folder, fps=25)
    assert again.exposure_us == 0
    assert all(note.code != "frames.exposure" for note in again.notes)
    assert check(found).errors == ()


def test_frames_come_from_a_stack(watched: tuple[Recording, Camera], tmp_path: Path) -> None:
    recording = watched[0]
    bare = Recording.of_events(recording.events)
    np.save(tmp_path / "frames.npy", recording.frames)
    found = with_frames(bare, tmp_path / "frames.npy", fps=25, offset_us=20_000)
    assert (found.frame_times == recording.frame_times).all()
    with pytest.raises(EvflowDataError, match=r"EV020.*--frames-fps"):
        with_frames(bare, tmp_path / "frames.npy")
    late = with_frames(bare, tmp_path / "frames.npy", fps=1)  # 2 s and more: beyond the margin
    assert late.frame_times.tolist() == [0, 1_000_000]
    with pytest.raises(EvflowDataError, match=r"EV012.*--frames-offset-ms"):
        with_frames(bare, tmp_path / "frames.npy", fps=25, offset_us=10_000_000)
    np.save(tmp_path / "dark.npy", recording.frames / np.float32(255))
    with pytest.raises(EvflowDataError, match="EV003"):
        with_frames(bare, tmp_path / "dark.npy", fps=25)
    dark = with_frames(bare, tmp_path / "dark.npy", fps=25, full_scale=255)
    assert dark.frames.max() <= 1
    np.save(tmp_path / "small.npy", recording.frames[:, :10])
    with pytest.raises(EvflowDataError, match="EV015"):
        with_frames(bare, tmp_path / "small.npy", fps=25)


def test_times_of_exposures(tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    for text, times in (
        ("1000 5000\n41000 45000\n81000 85000\n", [3000, 43000, 83000]),
        ("0 1000 5000\n1 41000 45000\n2 81000 85000\n", [3000, 43000, 83000]),
        ("0.001 0.005\n0.041 0.045\n0.081 0.085\n", [3000, 43000, 83000]),
    ):
        path.write_text(text)
        assert read_times(path)[0].tolist() == times
    for text in ("1000 4000\n41000 4000\n81000 4000\n", "1 50000\n40000 90000\n80000 130000\n"):
        path.write_text(text)  # an exposure time beside the time; exposures that overlap
        with pytest.raises(EvflowDataError, match="EV008"):
            read_times(path)
    path.write_text("1000 5000 a.png\n41000 45000 b.png\n")
    us, _, _, names = read_times(path, "us", ["a.png", "b.png"])
    assert (us.tolist(), names) == ([3000, 43000], ("a.png", "b.png"))


def test_saturated_pixels_tell_nothing(watched: tuple[Recording, Camera]) -> None:
    """Frames that saturate in part of the picture: thresholds stay where they were. Taken as they
    are, saturated pixels fire without any change and draw theta down by a tenth."""
    recording = watched[0]
    clipped = np.clip(np.rint(recording.frames * 1.6), 0, 255).astype(np.uint8)
    assert 0.05 < (clipped == 255).mean() < 0.6
    saturated = dataclasses.replace(recording, frames=clipped)
    found = estimate_camera(saturated, pixel="ideal")
    truth = np.array([np.median(watched[1].theta_on), np.median(watched[1].theta_off)])
    estimate = np.array([float(found.summary.theta_on), float(found.summary.theta_off)])
    assert estimate == pytest.approx(truth, rel=0.12)
    # The brighter frames move the knee of the lin-log, which is taken for an offset in part.
    measured = estimate_camera(saturated)
    for name, value in zip(("theta_on", "theta_off"), truth, strict=True):
        away = abs(float(getattr(measured.summary, name)) - value)
        assert away < 2 * float(getattr(measured.summary_std, name))
    white = (clipped == 255).all(0)
    assert white.any()
    assert not found.valid[white].any()
    assert found.hot.mean() < 0.01


def test_exposed() -> None:
    first, second = np.array([[0.0, 1.0, 251.0, 100.0]]), np.array([[9.0, 2.0, 253.0, 100.0]])
    assert exposed(first, second).tolist() == [[False, True, False, True]]
    assert exposed(first).tolist() == [[False, True, True, True]]


def test_a_cut_off_file_is_read_in_part(
    data_file: Callable[[str], Path], tmp_path: Path
) -> None:
    for name in ("evt2_sample.raw", "evt3_sample.raw"):
        whole = data_file(f"data/formats/{name}")
        data = whole.read_bytes()
        cut = tmp_path / name
        cut.write_bytes(data[: len(data) // 2 // 8 * 8 + 1])
        with pytest.raises(EvflowDataError, match=r"EV009.*--partial"):
            read_recording(cut)
        part = read_recording(cut, partial=True)
        n = len(part.events)
        sound = read_recording(whole).events
        assert 0.3 < n / len(sound) < 0.7
        assert (part.events.t == sound.t[:n]).all()
        assert part.notes[-1].code == "events.partial"
        assert "--partial" in part.notes[-1].text


def test_a_cut_off_text_and_aedat4_are_read_in_part(
    data_file: Callable[[str], Path], tmp_path: Path
) -> None:
    text = tmp_path / "events.txt"
    text.write_text("".join(f"{i * 1e-4:.6f} {i % 64} {i % 48} {i % 2}\n" for i in range(1000))
                    + "0.1000 12 3")
    with pytest.raises(EvflowDataError, match="EV009"):
        read_recording(text, size=(64, 48))
    assert len(read_recording(text, size=(64, 48), partial=True).events) == 1000
    pytest.importorskip("aedat")
    whole = data_file("data/recordings/newton_cradle_davis346.aedat4")
    cut = tmp_path / "cut.aedat4"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(EvflowDataError, match="EV009"):
        read_recording(cut)
    part = read_recording(cut, partial=True)
    assert 50_000 < len(part.events) < 300_000
    assert part.has_frames


def test_any_white_of_deep_frames_is_reported(watched: tuple[Recording, Camera]) -> None:
    deep = dataclasses.replace(watched[0], frames=watched[0].frames.astype(np.uint16) * 16)
    for white, said in ((4095, "12-bit data, white is taken as 4,095"),
                        (5000, "white is taken as 5,000")):
        given = dataclasses.replace(deep, full_scale=white)
        assert any(said in str(f) for f in check(given).findings if f.code == "EV031")
