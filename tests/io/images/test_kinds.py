"""What ordinary files hold beside pixels: which side is up, gaps in their numbers, HDR, fields."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.videos import drifting

from evflow.errors import EvflowDataError
from evflow.io.images.folder import decode
from evflow.io.images.transfer import hdr_note
from evflow.io.images.values import white_of
from evflow.io.images.video import open_video
from evflow.io.source import open_frames

FRAMES = drifting(6, (24, 32), 1.0).astype(np.uint8)
TURNED = {1: FRAMES[0], 3: FRAMES[0][::-1, ::-1], 6: np.rot90(FRAMES[0], -1),
          8: np.rot90(FRAMES[0])}  # by EXIF's orientations


def with_exif(image: np.ndarray, suffix: str, orientation: int) -> bytes:
    """An image whose EXIF says how it was held."""
    data = cv2.imencode(suffix, image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    told = struct.pack(">2sHIHHHIHHI", b"MM", 42, 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    if suffix == ".jpg":
        told = b"Exif\0\0" + told
        return data[:2] + struct.pack(">2sH", b"\xff\xe1", len(told) + 2) + told + data[2:]
    told = b"eXIf" + told
    return data[:33] + struct.pack(">I", len(told) - 4) + told + struct.pack(
        ">I", zlib.crc32(told)) + data[33:]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("orientation", TURNED)
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_images_stand_as_they_were_seen(
    tmp_path: Path, suffix: str, orientation: int, depth: type
) -> None:
    """As videos do, which OpenCV turns."""
    if suffix == ".jpg" and depth == np.uint16:
        return
    scale = 1 if depth == np.uint8 else 257
    for image in (FRAMES[0], np.stack([FRAMES[0]] * 3, -1)):
        file = tmp_path / f"a{suffix}"
        file.write_bytes(with_exif(image.astype(depth) * depth(scale), suffix, orientation))
        found = decode(file)
        assert (found.dtype, found.ndim) == (depth, image.ndim)
        wanted = TURNED[orientation]
        np.testing.assert_allclose(found if found.ndim == 2 else found[..., 0],
                                   wanted.astype(float) * scale, atol=6 * (suffix == ".jpg"))


@pytest.mark.parametrize(("numbers", "said"), [
    (range(6), ""), (range(0, 60, 10), ""), ([0, 1, 2, 23, 24, 25], "a02x.png to a23x.png:"),
    ([0, 1, 2, 4, 5, 9], "a02x.png to a04x.png, and in 1 more places:")])
def test_missing_numbers_are_told(tmp_path: Path, numbers: list[int], said: str) -> None:
    for number, frame in zip(numbers, FRAMES, strict=True):
        cv2.imwrite(str(tmp_path / f"a{number:02d}x.png"), frame)
    source = open_frames(tmp_path, fps=10)
    assert [t for _, t in source.open()] == [100_000 * i for i in range(6)]
    told = [note.text for note in source.notes if note.code == "frames.gaps"]
    assert len(told) == bool(said)
    assert all(said in text for text in told)


@pytest.mark.parametrize(("first", "apart", "jitter", "fps", "lost", "said"), [
    (1403636579763555584, 50_000_000, 0, 20, 0, ""),  # ns, which float64 does not hold
    (1403636579763555584, 50_000_000, 20_000, 20, 0, ""),
    (0, 50_000, 20, 20, 0, ""),
    (1403636579763555584, 50_000_000, 20_000, 20, 1, "in ns, 20 frames/s; those of --fps 20 are"),
    (1403636579763555584, 50_000_000, 0, 25, 0, "ns, 20 frames/s; those of --fps 25 are")])
def test_numbers_that_are_times(
    tmp_path: Path, first: int, apart: int, jitter: int, fps: float, lost: int, said: str
) -> None:
    rng = np.random.default_rng(0)
    for i, frame in enumerate(FRAMES):
        time = first + apart * (i + lost * (i > 2)) + int(rng.integers(-jitter, jitter + 1))
        cv2.imwrite(str(tmp_path / f"{time + jitter}.png"), frame)
    told = [note.text for note in open_frames(tmp_path, fps=fps).notes
            if note.code == "frames.gaps"]
    assert len(told) == bool(said)
    assert all(said in text for text in told)
    with pytest.raises(EvflowDataError, match=r"EV020.*names look like times in [nu]s"):
        open_frames(tmp_path)


def test_names_of_several_numbers_have_no_gaps(tmp_path: Path) -> None:
    for i, frame in enumerate(FRAMES):
        cv2.imwrite(str(tmp_path / f"{i // 3}_{7 * i % 3}.png"), frame)
    assert not [note for note in open_frames(tmp_path, fps=10).notes if note.code == "frames.gaps"]


def box(name: bytes, inside: bytes) -> bytes:
    return struct.pack(">I", 8 + len(inside)) + name + inside


@pytest.mark.parametrize(("transfer", "curve"), [(16, "PQ"), (18, "HLG"), (1, ""), (13, "")])
def test_an_hdr_video_is_told_by_its_container(
    tmp_path: Path, transfer: int, curve: str
) -> None:
    colours = box(b"colr", b"nclx" + struct.pack(">HHHB", 9, transfer, 9, 0))
    index = box(b"moov", box(b"trak", bytes(40) + colours))
    matroska = b"\x1a\x45\xdf\xa3" + bytes(60) + b"\x55\xba\x81" + bytes([transfer]) + bytes(9)
    for data in (box(b"ftyp", b"isom") + index + box(b"mdat", bytes(99)),
                 box(b"ftyp", b"isom") + box(b"mdat", bytes(99)) + index, matroska):
        (tmp_path / "a.mp4").write_bytes(data)
        told = hdr_note(tmp_path / "a.mp4")
        assert len(told) == bool(curve)
        assert all(f"({curve})" in note.text for note in told)
    brand = box(b"ftyp", b"isom")
    for data in (b"", brand, brand + b"\0\0\0\1moov", matroska[:66]):
        (tmp_path / "a.mp4").write_bytes(data)
        assert hdr_note(tmp_path / "a.mp4") == ()


def write(path: Path, frames: np.ndarray) -> Path:
    size = frames.shape[2:0:-1]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, size)
    for frame in frames:
        video.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    video.release()
    return path


def test_what_a_decoder_leaves_of_fields_is_told(tmp_path: Path) -> None:
    """OpenCV 5 gives the same memory again for each interlaced frame."""
    still = open_frames(write(tmp_path / "a.avi", FRAMES[[2] * 6]), response="auto")
    assert len(list(still.open())) == 6
    codes = [note.code for note in still.notes]
    assert "frames.still" in codes
    assert "frames.repeated" not in codes
    moving = open_frames(write(tmp_path / "b.avi", FRAMES))
    assert len(list(moving.open())) == 6
    assert not moving.notes
    with pytest.raises(EvflowDataError, match=r"same black picture.*-vf bwdif") as raised:
        open_frames(write(tmp_path / "c.avi", 0 * FRAMES))
    assert raised.value.code == "EV009"
    late = open_frames(write(tmp_path / "d.avi", np.concatenate([0 * FRAMES, FRAMES])))
    assert len(list(late.open())) == 12


def test_a_codec_that_is_not_known_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Unknown:
        def __init__(self, _path: str) -> None: ...

        def isOpened(self) -> bool:
            return True

        def read(self) -> tuple[bool, None]:
            return False, None

        def release(self) -> None: ...

        def get(self, what: int) -> float:
            return cv2.VideoWriter.fourcc(*"AV01") if what == cv2.CAP_PROP_FOURCC else 25.0

    monkeypatch.setattr(cv2, "VideoCapture", Unknown)
    with pytest.raises(EvflowDataError, match=r"codec is AV01.*ffmpeg -i a\.avi -c:v libx264"):
        open_video(write(tmp_path / "a.avi", FRAMES))


@pytest.mark.parametrize(("dtype", "fix"), [
    ("bool", "255 * frames.astype(np.uint8)"), ("int32", "frames.astype(np.float32)")])
def test_arrays_of_other_types_are_refused_with_what_to_do(dtype: str, fix: str) -> None:
    with pytest.raises(EvflowDataError) as raised:
        white_of(np.dtype(dtype), "frame 0")
    assert raised.value.code == "EV003"
    assert fix in str(raised.value)


def turned(frames: np.ndarray) -> list[np.ndarray]:
    return [np.repeat(frame[..., None], 3, -1) for frame in frames]


def animation(path: Path, frames: np.ndarray) -> None:
    """Shown for 40 and 80 ms in turn."""
    made = cv2.Animation()
    made.frames = turned(frames)
    made.durations = np.array([40, 80] * len(frames), np.int32)[: len(frames)]
    assert cv2.imwriteanimation(str(path), made)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pages_are_frames(tmp_path: Path, suffix: str) -> None:
    path, timed = tmp_path / f"a{suffix}", suffix == ".png"
    if timed:
        animation(path, FRAMES)
    else:
        assert cv2.imwritemulti(str(path), list(FRAMES))
        with pytest.raises(EvflowDataError, match="6 frames but no times"):
            open_frames(path)
    for hints in ({"fps": 50.0}, *([{}] if timed else [])):
        found = list(open_frames(path, response="linear", **hints).open())
        np.testing.assert_array_equal([frame for frame, _ in found], FRAMES)
        steps = [20_000] * 5 if hints else [40_000, 80_000, 40_000, 80_000, 40_000]
        assert np.diff([time for _, time in found]).tolist() == steps
    with pytest.raises(EvflowDataError, match="holds 6 pages, not one image"):
        open_frames(tmp_path, fps=50)


def test_reduced_copies_of_a_picture_are_no_frames(tmp_path: Path) -> None:
    for i in range(2):
        assert cv2.imwritemulti(str(tmp_path / f"{i}.tif"), [FRAMES[i], FRAMES[i][::2, ::2]])
    found = [frame for frame, _ in open_frames(tmp_path, fps=50, response="linear").open()]
    np.testing.assert_array_equal(found, FRAMES[:2])
