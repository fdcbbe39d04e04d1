"""Folders of images as a video: in natural order, decoded one at a time, at full bit depth."""

from __future__ import annotations

import dataclasses
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from shlex import quote

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.limits import check_expansion, read_whole
from evflow.files.regular import is_there
from evflow.io.images import exr
from evflow.io.images.frames import FrameHints, Image
from evflow.io.images.numbers import KEEP, gaps, natural, running, unit_of
from evflow.io.images.pictures import claimed_bytes
from evflow.io.images.times import read_times
from evflow.notes import Note

RADIANCE = (".hdr", ".exr", ".pfm")  # formats without a defined white
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp", *RADIANCE)
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
EXIF, HEAD = (b"Exif\0\0", b"eXIf"), 1 << 16  # markers of EXIF orientation, and bytes to search
UPRIGHT = 6  # OpenCV's IMREAD_ANYCOLOR | IMREAD_ANYDEPTH: unchanged, but rotated as EXIF says
MADE = "made from the events by"  # mark of `evflow reconstruct` in its file of times
TIMES = ("timestamps.txt", "images.txt", "image_timestamps.txt", "timestamp.txt", "times.txt",
         "info.txt", "rgb.txt", "data.csv", "timestamps.csv", "timestamps.npy")


@dataclasses.dataclass(frozen=True)
class ImageFolder:
    """files in the order of their times_us (T,) int64; notes: what was assumed; exposure_us: 0 if
    it is unknown."""

    files: tuple[Path, ...]
    times_us: np.ndarray
    notes: tuple[Note, ...]
    exposure_us: int = 0

    def images(self) -> Iterator[Image]:
        for file, time in zip(self.files, self.times_us.tolist(), strict=True):
            yield Image(decode(file), time, str(file))


def open_folder(root: Path, hints: FrameHints) -> ImageFolder:
    """The images of a folder, or of its only subfolder with images, and their times.

    Times come from `hints.timestamps`, from `hints.fps`, or from a file in `TIMES` beside them.
    Raises EV008 (no images, or one in two formats), EV002 (counts differ), EV016 (an image is
    missing), EV020 (no times), and what `read_times` raises.
    """
    folder, files = _find(root)
    made = _made(folder)
    if hints.fps is not None:
        _check_once(files)
        times = np.array([hints.at_rate(i) for i in range(len(files))], np.int64)
        return ImageFolder(tuple(files), times, made + gaps(files, hints))
    source = _times_file(root, folder, files, hints)
    by_name = {file.name: file for file in files}
    us, notes, exposure_us, names = read_times(source, hints.time_unit, by_name)
    if not names:
        _check_once(files)
    missing = [name for name in names if name not in by_name]
    if missing:
        raise EvflowDataError(
            "EV016", f"{source} names {missing[0]}, which is missing in {folder} "
            f"({len(missing)} of {len(names)} are).", "Restore the images or remove the lines.",
            where=source)
    if len(us) != len(files) or len(set(names)) != len(names):
        raise EvflowDataError(
            "EV002", f"{folder} holds {len(files)} images, {source} times for "
            f"{len(set(names)) if names else len(us)}.",
            "Images lost, or from another recording? Give each image one time, or pass --fps.",
            where=folder)
    files = [by_name[name] for name in names] if names else files
    return ImageFolder(tuple(files), us, notes + made, exposure_us)


def _check_once(files: list[Path]) -> None:
    """Raise EV008 for files whose names differ in their ending alone."""
    seen: dict[str, Path] = {}
    for file in files:
        if (other := seen.setdefault(file.stem, file)) is not file:
            raise EvflowDataError(
                "EV008", f"{file.parent} holds {other.name} and {file.name}: one image in two "
                "formats?", "Keep one of them, or name each image in the file of times.",
                where=file.parent)


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder in natural order (img2 before img10), without hidden ones."""
    try:
        entries = list(folder.iterdir())
    except OSError as e:
        raise EvflowDataError("EV016", f"{folder} cannot be listed ({e.strerror}).",
                              where=folder) from e
    return sorted((p for p in entries if p.suffix.lower() in SUFFIXES
                   and not p.name.startswith(".")), key=lambda p: natural(p.name))


def unread_images(root: Path) -> tuple[Note, ...]:
    """A note on images that lie in or below the folder of a recording that names none."""
    for folder in (root, *sorted(p for p in root.iterdir() if p.is_dir())):
        if files := list_images(folder):
            times = next((p for place in dict.fromkeys((folder, root)) for name in TIMES
                          if is_there(p := place / name)), "FILE")
            return (Note("frames.unused", f"{len(files):,} images in {folder} were not read, as no "
                         "images.txt names their times: --frames "
                         f"{quote(str(folder))} --timestamps {quote(str(times))}"),)
    return ()


def decode(file: Path | zipfile.Path) -> np.ndarray:
    """One image at its full bit depth: (H, W) or (H, W, 3 or 4) in B, G, R(, A).

    Raises EV008 (an EXR that this OpenCV does not read), EV009 (damaged, truncated), EV016 (not
    found).
    """
    try:
        if not file.is_file():  # a pipe might never end
            raise OSError(0, "it is not a regular file")
        data = read_whole(file)
    except OSError as e:
        raise EvflowDataError("EV016", f"{file} cannot be read ({e.strerror}).", where=file) from e
    return decoded(data, file)


def decoded(data: bytes, where: object) -> np.ndarray:
    """The same from the bytes of an image; EV009. where: name for messages."""

    claimed = claimed_bytes(data)
    if claimed is not None:
        check_expansion(claimed, len(data), where)
    # OpenCV silently fills the missing part of a truncated JPEG or PNG with grey.
    jpeg, png = data.startswith(b"\xff\xd8"), data.startswith(b"\x89PNG")
    whole = not ((jpeg and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"))
                 or (png and b"IEND" not in data))
    image = (None if claimed is None else
             _exr(data, where) if data.startswith(exr.MAGIC) else _by_opencv(data))
    if image is None or not whole:
        raise EvflowDataError(
            "EV009", f"{where} ({len(data):,} bytes) is {'a damaged' if whole else 'a truncated'} "
            "image.", "Copy it again.", where=where)
    return image


def _by_opencv(data: bytes) -> np.ndarray | None:
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is not None and image.shape[2:] != (4,) and any(
                mark in data[:HEAD] for mark in EXIF):
            return cv2.imdecode(np.frombuffer(data, np.uint8), UPRIGHT)
        return image
    except cv2.error:
        return None


def _exr(data: bytes, file: object) -> np.ndarray | None:
    """An EXR, None if it is damaged; EV008 if nothing here supports its kind."""
    try:
        head = exr.header(data)
        if not (kind := exr.unread(head)):
            return exr.decode(data, head)
    except (ValueError, IndexError, struct.error, zlib.error):
        return None
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # off by default
    image = _by_opencv(data)
    if image is None:
        import cv2

        raise EvflowDataError(
            "EV008", f"{file} is an EXR with {kind}, which this OpenCV ({cv2.__version__}) does "
            "not read.", "Save it as scan lines with ZIP or no compression, or as .hdr; or use "
            "Debian's python3-opencv, which reads it.", where=file)
    return image[..., :3] if image.ndim == 3 else image


def _find(root: Path) -> tuple[Path, list[Path]]:
    """The folder that holds the images, and their paths."""
    files = list_images(root)
    if files:
        return root, files
    below = {p: found for p in sorted(root.iterdir()) if p.is_dir() and (found := list_images(p))}
    if len(below) == 1:
        return below.popitem()
    seen = (f"holds images in {sorted(p.name for p in below)[:5]}" if below else
            f"holds no image ({', '.join(s[1:] for s in SUFFIXES)}): "
            f"{sorted(p.name for p in root.iterdir())[:5]}")
    video = next((p for p in sorted(root.iterdir()) if p.suffix.lower() in VIDEOS), None)
    raise EvflowDataError(
        "EV008", f"{root} {seen}.", f"Take videos one by one: {video}, ..." if video and not below
        else "Pass the folder that has the frames.", where=root)


def _made(folder: Path) -> tuple[Note, ...]:
    """The note at the head of the file of times that `evflow reconstruct` writes: the images were
    made from events. It applies wherever the times are taken from."""
    path = folder / TIMES[0]
    if not path.is_file():  # a pipe might never end
        return ()
    try:
        with path.open(encoding="utf-8", errors="replace") as lines:
            first = lines.readline(1000).lstrip("# ").strip()
    except OSError:
        return ()
    return (Note("frames.made", first),) if MADE in first else ()


def _times_file(root: Path, folder: Path, files: list[Path], hints: FrameHints) -> Path:
    if hints.timestamps is not None:
        return Path(hints.timestamps)
    found = [p for place in dict.fromkeys((folder, root)) for name in TIMES
             if is_there(p := place / name)]
    if found:
        return found[0]
    near = [str(p) for name in TIMES if (p := folder.parent / name).is_file()]
    unit = unit_of(running(files))
    named = f" Their names look like times in {unit}: {KEEP}." if unit else ""
    raise EvflowDataError(
        "EV020", f"{folder} has images but no file with their times ({', '.join(TIMES[:3])}, ...).",
        f"Pass --fps, or --timestamps {near[0] if near else 'FILE'}.{named}", where=folder)
