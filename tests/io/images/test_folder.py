"""Folders of images, their times, stacks and recordings as sources of frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sources import message, read
from helpers.videos import code_of, drifting
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow import Events, Recording, write_events
from evflow.io.images.exposures import Stamps
from evflow.io.images.numbers import natural
from evflow.io.images.times import to_us
from evflow.io.source import open_frames

SIZE = (32, 24)


def folder(root: Path, count: int = 12, name: str = "img{}.png", *,
           depth: type = np.uint8, start: int = 1) -> np.ndarray:
    root.mkdir(parents=True, exist_ok=True)
    scale = 1 if depth == np.uint8 else 257
    frames = drifting(count, SIZE[::-1]).astype(depth) * depth(scale)
    for i, frame in enumerate(frames):
        assert cv2.imwrite(str(root / name.format(i + start)), frame)
    return frames


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "bmp", "pgm"])
def test_a_folder_in_natural_order(tmp_path: Path, suffix: str) -> None:
    frames = folder(tmp_path, 12, "img{}." + suffix)
    (tmp_path / ".DS_Store").write_bytes(b"x")
    (tmp_path / "._img1.png").write_bytes(b"x")
    seen, times, _ = read(tmp_path, fps=100)
    assert times == [10_000 * i for i in range(12)]
    np.testing.assert_allclose(seen.astype(int), frames, atol=12 if suffix == "jpg" else 0)


def test_a_folder_of_videos_is_taken_one_by_one(tmp_path: Path) -> None:
    (tmp_path / "b.mp4").touch()
    (tmp_path / "a.MOV").touch()
    assert "one by one: " + str(tmp_path / "a.MOV") in message(lambda: open_frames(tmp_path))


@given(st.lists(st.integers(0, 10**6), unique=True, max_size=8))
def test_natural_order_is_that_of_the_numbers(numbers: list[int]) -> None:
    assert sorted((f"f{n}.png" for n in numbers), key=natural) == [
        f"f{n}.png" for n in sorted(numbers)]
    assert sorted(["b1", "a2.10", "a2.9", "a02.9"], key=natural) == ["a02.9", "a2.9", "a2.10", "b1"]


@pytest.mark.parametrize("suffix", ["png", "tif", "pgm"])
def test_sixteen_bits_stay(tmp_path: Path, suffix: str) -> None:
    frames = folder(tmp_path, 3, "f{}." + suffix, depth=np.uint16)
    frames[0, 0, 0] = 12345
    cv2.imwrite(str(tmp_path / f"f1.{suffix}"), frames[0])
    seen, _, notes = read(tmp_path, fps=10)
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen, frames / 257, rtol=1e-6)
    assert notes == []


def test_one_image_in_two_formats_is_asked_about(tmp_path: Path) -> None:
    frames = folder(tmp_path, 3, "f{}.png")
    cv2.imwrite(str(tmp_path / "f1.bmp"), frames[0])
    assert "f1.bmp and f1.png: one image" in message(lambda: read(tmp_path, fps=10))
    (tmp_path / "timestamps.txt").write_text("0\n1\n2\n3\n")
    assert "EV008" in message(lambda: read(tmp_path, time_unit="s"))
    (tmp_path / "timestamps.txt").write_text("0 f1.png\n1 f2.png\n2 f3.png\n3 f1.bmp\n")
    assert len(read(tmp_path, time_unit="s")[0]) == 4


def test_twelve_bits_in_sixteen(tmp_path: Path) -> None:
    frames = folder(tmp_path, 3) .astype(np.uint16) * 16
    for i, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / f"img{i + 1}.png"), frame)
    assert "--full-scale 4095" in message(lambda: read(tmp_path, fps=10))
    np.testing.assert_allclose(read(tmp_path, fps=10, full_scale=4080)[0], frames / 16, rtol=1e-6)
    assert "EV003" in message(lambda: read(tmp_path, fps=10, full_scale=1023))


def test_colour_and_alpha_images(tmp_path: Path) -> None:
    bgra = np.random.default_rng(0).integers(0, 256, (24, 32, 4), np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), bgra)
    laid = np.rint(bgra[..., :3] * (bgra[..., 3:] / 255.0)).astype(np.uint8)  # over black
    grey = cv2.cvtColor(laid, cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(read(tmp_path, fps=1)[0][0], grey)
    np.testing.assert_array_equal(read(tmp_path, fps=1, colour="rggb")[0][0], laid)
    assert "laid over white" in read(tmp_path, fps=1, background="white")[2][0].text
    cv2.imwrite(str(tmp_path / "b.png"), grey)  # grey and colour mix as luma, not as a mosaic
    assert read(tmp_path, fps=1)[0].shape == (2, 24, 32)
    assert code_of(lambda: read(tmp_path, fps=1, colour="rggb")) == "EV003"


def test_damaged_and_unlike_images_are_named(tmp_path: Path) -> None:
    for suffix in ("png", "jpg"):
        root = tmp_path / suffix
        folder(root, 3, "img{}." + suffix)
        data = (root / f"img2.{suffix}").read_bytes()
        for part in (data[: len(data) // 2], data[:-20], b"", b"nonsense"):
            (root / f"img2.{suffix}").write_bytes(part)
            text = message(lambda root=root: read(root, fps=10))
            assert "EV009" in text
            assert f"img2.{suffix}" in text
        cv2.imwrite(str(root / f"img2.{suffix}"), np.zeros((20, 32), np.uint8))
        assert "EV015" in message(lambda root=root: read(root, fps=10))
    folder(tmp_path / "deep", 1, depth=np.uint16)
    folder(tmp_path / "deep", 1, start=2)
    assert code_of(lambda: read(tmp_path / "deep", fps=10)) == "EV003"


TIMES_US = [1_000_000, 1_033_300, 1_066_700, 1_100_000]
LAYOUTS = {
    "seconds": "\n".join(f"{t / 1e6:.6f}" for t in TIMES_US),
    "milliseconds": "\n".join(f"{t / 1e3:.3f}" for t in TIMES_US),
    "microseconds": "\n".join(map(str, TIMES_US)) + "\n",
    "nanoseconds": "\r\n".join(str(1000 * t) for t in TIMES_US),
    "ijrr": "\n".join(f"{t / 1e6:.6f} images/img{i}.png" for i, t in enumerate(TIMES_US, 1)),
    "tum": "# time file\n" + "\n".join(
        f"{t / 1e6:.6f} rgb/img{i}.png" for i, t in enumerate(TIMES_US, 1)),
    "voltmeter": "\n".join(f"/data/img{i}.png {t}" for i, t in enumerate(TIMES_US, 1)),
    "euroc": "#timestamp [ns],filename\n" + "\n".join(
        f"{1000 * t},img{i}.png" for i, t in enumerate(TIMES_US, 1)),
    "stems": "\n".join(f"img{i};{t}" for i, t in enumerate(TIMES_US, 1)),
    "indices": "\n".join(f"{i}\t{t / 1e6:.6f}" for i, t in enumerate(TIMES_US)),
    "exposures": "frame_id,timestamp_us,exposure_us,gain\n" + "\n".join(
        f"{i},{t},8000,1.5" for i, t in enumerate(TIMES_US)),
    "two clocks": "device_ns, timestamp_ns, file\n" + "\n".join(
        f"{77 * t}, {1000 * t}, img{i}.png" for i, t in enumerate(TIMES_US, 1)),
    "header": "index,time_us\n" + "\n".join(f"{i},{t}" for i, t in enumerate(TIMES_US)),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_time_files(tmp_path: Path, layout: str) -> None:
    frames = folder(tmp_path, 4)
    (tmp_path / "timestamps.txt").write_text(LAYOUTS[layout], newline="")
    seen, times, _ = read(tmp_path)
    assert times == TIMES_US
    np.testing.assert_array_equal(seen, frames)


def test_names_give_the_order_and_a_subfolder_is_found(tmp_path: Path) -> None:
    frames = folder(tmp_path / "imgs", 4)
    lines = zip(TIMES_US, (3, 1, 4, 2), strict=True)
    (tmp_path / "images.txt").write_text("\n".join(f"{t} imgs/img{i}.png" for t, i in lines))
    seen, times, _ = read(tmp_path)
    np.testing.assert_array_equal(seen, frames[[2, 0, 3, 1]])
    assert times == TIMES_US
    np.save(tmp_path / "t.npy", np.array(TIMES_US) / 1e6)
    assert read(tmp_path / "imgs", timestamps=tmp_path / "t.npy")[1] == TIMES_US
    assert str(tmp_path / "images.txt") in message(lambda: open_frames(tmp_path / "imgs"))


@pytest.mark.parametrize(("code", "text"), [
    ("EV002", "1\n1.03\n1.06\n"),
    ("EV002", "1\n1.03\n1.06\n1.1\n1.13\n"),
    ("EV004", "1\n1.03\n1.03\n1.1\n"),
    ("EV004", "1\n1.03\n0.9\n1.1\n"),
    ("EV009", "1\n1.03\n1.06\n1.0x\n"),
    ("EV009", "1 img1.png\n1.03 img2.png\n1.06\n"),
    ("EV009", "\0\0\0\0"),
    ("EV007", "1\nnan\n1.06\n1.1\n"),
    ("EV016", "1 img1.png\n1.03 img2.png\n1.06 img3.png\n1.1 img9.png\n"),
    ("EV002", "1 img1.png\n1.03 img2.png\n1.06 img3.png\n1.1 img3.png\n"),
    ("EV008", "1.5 2.5\n1.53 2.53\n1.56 2.56\n1.6 2.6\n"),
    ("EV008", "1 2 3\n4 5 6\n7 8 9\n10 11 12\n"),
    ("EV003", "0\n200\n400\n600\n"),  # 5 frames/s in ms, 5000 in us
    ("EV001", "# nothing\n"),
])
def test_bad_time_files(tmp_path: Path, code: str, text: str) -> None:
    folder(tmp_path, 4)
    (tmp_path / "timestamps.txt").write_text(text)
    found = message(lambda: open_frames(tmp_path))
    assert found.startswith(code), found
    assert "timestamps.txt" in found
    assert read(tmp_path, fps=10)[1] == [0, 100_000, 200_000, 300_000]  # --fps still helps


def test_folders_without_what_is_needed(tmp_path: Path) -> None:
    assert code_of(lambda: open_frames(tmp_path)) == "EV008"
    for name in ("left", "right"):
        folder(tmp_path / name, 2)
    assert "left" in message(lambda: open_frames(tmp_path))
    assert code_of(lambda: open_frames(tmp_path / "left")) == "EV020"
    assert code_of(
        lambda: open_frames(tmp_path / "left", timestamps=tmp_path / "t.txt")) == "EV016"


@given(st.floats(8.5, 390), st.sampled_from(["s", "ms", "us", "ns"]), st.integers(0, 10**8))
@settings(max_examples=200, deadline=None)
def test_the_unit_of_usual_rates_is_found(fps: float, unit: str, start: int) -> None:
    us = start + np.rint(np.arange(8) * 1e6 / fps).astype(np.int64)
    factor = {"s": 1e-6, "ms": 1e-3, "us": 1, "ns": 1000}[unit]
    np.testing.assert_array_equal(to_us(Stamps(us * factor), "them").us, us)


def test_times_since_1970_and_fast_cameras() -> None:
    ns = 1_700_000_000_123_456_789 + 200_000 * np.arange(5)  # 5000 frames/s: the epoch decides
    assert (to_us(Stamps(ns), "t").us == (ns + 500) // 1000).all()
    fast = 200 * np.arange(5)
    assert (to_us(Stamps(fast), "t", "us").us == fast).all()
    assert "5 frames/s in ms, 5000 frames/s in us" in message(lambda: to_us(Stamps(fast), "t"))


# --------------------------------------------------------------------------- stacks, recordings


def test_stacks(tmp_path: Path) -> None:
    frames = drifting(5, SIZE[::-1])
    rgb = np.random.default_rng(0).integers(0, 256, (5, 24, 32, 3), np.uint8)
    grey = np.stack([cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in rgb])
    path = tmp_path / "a.npy"
    for stack, expected in (
        (frames, frames), (frames.astype(np.float64), frames), (frames.astype(np.uint8),) * 2,
        (np.asfortranarray(frames), frames), (rgb, grey), (rgb[..., :1], rgb[..., 0]),
        (np.asfortranarray(rgb), grey),
    ):
        np.save(path, stack)
        seen, times, _ = read(path, fps=200)
        np.testing.assert_array_equal(seen, expected)
        assert times == [0, 5000, 10_000, 15_000, 20_000]
    np.testing.assert_array_equal(read(path, fps=200, colour="gbrg")[0], rgb[..., ::-1])
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", frames=frames, timestamps=np.arange(5) * 4000)
        seen, times, _ = read(tmp_path / "a.npz", time_unit="us")
        np.testing.assert_array_equal(seen, frames)
        assert times == [0, 4000, 8000, 12_000, 16_000]
    notes = read(tmp_path / "a.npz", time_unit="s")[2]
    assert "read in s, are 4e+03 s apart; in us" in notes[0].text
    for name, stamps in (("ts", np.arange(5) * 4000), ("image_timestamps", np.arange(5) * 4e-3),
                         ("exposure_ts", np.arange(5)[:, None] * 4000 + [-9, 9])):
        np.savez(tmp_path / "b.npz", images=frames, gain=np.ones(5), **{name: stamps})
        assert read(tmp_path / "b.npz")[1] == times
        np.save(tmp_path / "t.npy", stamps)
        assert read(path, timestamps=tmp_path / "t.npy")[1] == times
    begin = np.arange(5) * 4000 - 9
    exposed = {"exposure_start": begin, "exposure_end": begin + 18}
    for arrays in ({"t": times}, {"a": times}, exposed, {"t": times, "u": begin, "fps": 250}):
        np.savez(tmp_path / "t.npz", **arrays)
        assert read(path, timestamps=tmp_path / "t.npz")[1] == times
    np.savez(tmp_path / "t.npz", a=times, b=times)
    assert "holds a, b; which" in message(lambda: read(path, timestamps=tmp_path / "t.npz"))
    np.save(tmp_path / "t.npy", np.array([[5, 9.0]] * 5))
    assert "not begin and end" in message(lambda: read(path, timestamps=tmp_path / "t.npy"))


def test_an_npz_whose_frames_claim_less_is_damaged(tmp_path: Path) -> None:
    """Its checksum lies behind bytes that no frame needs."""
    path = tmp_path / "a.npz"
    np.savez(path, frames=np.zeros((4, 48, 64), np.uint8), timestamps=np.arange(4))
    path.write_bytes(path.read_bytes().replace(b"(4, 48, 64)", b"(4, 48, 44)"))
    assert code_of(lambda: read(path, time_unit="us")) == "EV009"


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_cut_off_stacks_say_how_much_is_left(tmp_path: Path, name: str) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (10, 24, 32), np.uint8)
    path = tmp_path / name
    (np.save if name == "a.npy" else np.savez)(path, frames)
    data = bytearray(path.read_bytes())
    if name == "a.npy":
        del data[-3 * 24 * 32 - 5 :]
    else:
        data[5 * 24 * 32] ^= 255  # the checksum fails once all is read
    path.write_bytes(data)
    text = message(lambda: read(path, fps=10))
    assert "EV009" in text
    left = int(text.split(" of the 10 frames")[0].split()[-1])
    assert left == 6 if name == "a.npy" else 0 < left < 10
    assert len(read(path, fps=10, partial=True)[0]) == left


def test_bad_stacks(tmp_path: Path) -> None:
    frames = drifting(4, SIZE[::-1])
    holed = frames.copy()
    holed[2, 3, 4] = np.nan
    for code, stack in (
        ("EV002", frames[0]), ("EV002", np.zeros((4, 3, 24, 32), np.uint8)),
        ("EV001", frames[:0]), ("EV003", frames > 100), ("EV003", frames / 255),
        ("EV003", frames - 50), ("EV003", frames * 2), ("EV007", holed),
        ("EV003", frames.astype(np.int32)), ("EV009", np.array([{}, {}], object)),
    ):
        np.save(tmp_path / "a.npy", stack, allow_pickle=True)
        assert code_of(lambda: read(tmp_path / "a.npy", fps=10)) == code, stack.shape
    np.save(tmp_path / "a.npy", frames / 255)
    np.testing.assert_allclose(
        read(tmp_path / "a.npy", fps=10, full_scale=1)[0], frames, rtol=1e-5)
    assert code_of(lambda: open_frames(tmp_path / "a.npy")) == "EV020"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01")
    assert code_of(lambda: open_frames(tmp_path / "a.npy", fps=10)) == "EV009"
    np.savez(tmp_path / "b.npz", depth=frames)
    assert code_of(lambda: open_frames(tmp_path / "b.npz", fps=10)) == "EV008"


def test_the_frames_of_a_recording(tmp_path: Path) -> None:
    none = np.zeros(0, int)
    events = Events(none, none, none, none, SIZE)
    frames = drifting(4, SIZE[::-1]).astype(np.uint8)
    path = tmp_path / "r.h5"
    write_events(path, Recording(events, frames, np.arange(4) * 40_000))
    seen, times, _ = read(path)
    np.testing.assert_array_equal(seen, frames)
    assert times == [0, 40_000, 80_000, 120_000]
    assert code_of(lambda: open_frames(path, fps=10)) == "EV020"
    assert "as they are" in read(path, colour="rggb")[2][0].text
    write_events(tmp_path / "bare.h5", events)
    assert code_of(lambda: open_frames(tmp_path / "bare.h5")) == "EV011"


def test_a_late_event_does_not_stand_between_a_recording_and_its_frames(tmp_path: Path) -> None:
    frames = drifting(4, SIZE[::-1]).astype(np.uint8)
    (tmp_path / "images").mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), frame)
    times = "".join(f"{0.04 * i:.6f} images/{i}.png\n" for i in range(4))
    (tmp_path / "images.txt").write_text(times)
    rows = [f"{t:.6f} {k % SIZE[0]} 0 {k % 2}" for k, t in enumerate(np.linspace(0, 0.12, 200))]
    rows[100] = "0.010000 0 0 1"
    (tmp_path / "events.txt").write_text("\n".join(rows) + "\n")
    seen, at, notes = read(tmp_path)
    np.testing.assert_array_equal(seen, frames)
    assert at == [0, 40_000, 80_000, 120_000]
    assert not any(note.code == "events.late" for note in notes)


def test_a_real_folder(data_file: Callable[[str], Path]) -> None:
    root = data_file("data/recordings/ijrr_slider_depth")
    frames, times, notes = read(root / "images", timestamps=root / "images.txt")
    recording, recorded, _ = read(root)
    np.testing.assert_array_equal(frames, recording)
    assert times == recorded
    assert len(times) == 87
    assert "read in s (25.8 frames/s)" in notes[0].text
