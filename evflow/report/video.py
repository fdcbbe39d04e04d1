"""Writing pictures as .mp4 or .avi (OpenCV), .gif (Pillow), or a folder of images with times.

A film is written beside its place, opened again, and only moved there if all its pictures can be
read.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from PIL import Image

from evflow.errors import EvflowDataError
from evflow.files.atomic import aside, atomic_write
from evflow.files.folders import atomic_folder
from evflow.files.moves import remove
from evflow.files.whole import write_checked

Codec = Literal["mpeg4", "vp9"]

FOURCC = {"mpeg4": "mp4v", "vp9": "vp09", "mjpeg": "MJPG"}  # H.264 is in no free build of OpenCV
CODECS: tuple[Codec, ...] = ("mpeg4", "vp9")
SUFFIXES = (".mp4", ".avi", ".gif")
TIMES = "timestamps.txt"
FPS = (0.1, 240.0)
WIDTH = 640  # screen pixels that a small sensor is enlarged to...
HEIGHT = 4096  # ...if it is not so narrow that more rows are made than codecs take
SCALES = (1, 32)
FINE_FPS = 65.0  # OpenCV counts rates in thousandths, MPEG-4 no more than 65535 of them a second
GIF_TICK_S = 0.01  # GIF counts time in hundredths of a second
LEAST_TICKS = 2  # browsers slow down shorter pictures
GIF_FRAMES = 600  # a GIF is held in memory and grows large: more are refused


def write_video(
    path: str | os.PathLike, pictures: Iterator[np.ndarray], count: int, *, fps: float,
    codec: Codec = "mpeg4", overwrite: bool = False,
) -> str:
    """Write `count` pictures (H, W, 3) uint8 RGB of one even size; returns what was written, in
    words. codec: of .mp4; an .avi is motion JPEG.

    Raises EV013, EV019 (OpenCV cannot write it, or not all can be read again), EV020.
    """
    path = Path(path)
    kind = path.suffix.lower()
    check_within(FPS, "fps", fps)
    with atomic_write(path, overwrite=overwrite) as temporary, contextlib.ExitStack() as stack:
        made = aside(path, f"part{kind}")  # OpenCV tells the kind of film by the ending
        stack.callback(remove, made)
        made.touch()  # says why where nothing can be written, which OpenCV does not
        if kind == ".gif":
            how = _write_gif(made, pictures, count, fps)
        else:
            how = _write_film(made, pictures, count, fps, "mjpeg" if kind == ".avi" else codec)
        os.replace(made, temporary)
    return f"{count} pictures, {count / fps:.1f} s, {how}"


def check_within(bounds: tuple[float, float], name: str, value: float | None) -> None:
    """EV020 for a value that is given and not between the bounds."""
    low, high = bounds
    if value is not None and not low <= value <= high:
        raise EvflowDataError("EV020", f"{name}={value:g}.",
                              f"Give a value from {low:g} to {high:g}.")


def write_images(
    folder: str | os.PathLike, images: Iterator[np.ndarray], times_us: np.ndarray, *,
    remark: str = "", overwrite: bool = False,
) -> str:
    """Write grey images (H, W) on 0..1 as 8-bit .png, with their times (T,) in timestamps.txt, as
    readers of image folders take them, a remark at its head; returns what was written, in words.

    Raises EV013 (the folder exists, or holds other things), EV019.
    """
    folder = Path(folder)
    before = len(list(folder.iterdir())) if folder.is_dir() else 0
    names = [f"frame_{i:08d}.png" for i in range(max(len(times_us), before))]
    with atomic_folder(folder, names=(TIMES, *names), overwrite=overwrite) as temporary:
        for name, image in zip(names, images, strict=False):
            pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
            Image.fromarray(pixels).save(temporary / name)
        lines = (f"{time} {name}\n" for time, name in zip(times_us, names, strict=False))
        head = f"# {remark}\n" if remark else ""
        write_checked(temporary / TIMES, f"{head}# timestamp_us image\n" + "".join(lines))
    return f"{len(times_us)} images"


def enlarged(image: np.ndarray, scale: int | None = None) -> np.ndarray:
    """(H, W, 3) floats 0..1 as uint8, each pixel scale x scale (None: as many as make it 640
    wide, but at most 4096 high), the sides even: codecs store colour at half the resolution."""
    if scale is None:
        scale = max(1, min(round(WIDTH / image.shape[1]), HEIGHT // image.shape[0]))
    pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8).repeat(scale, 0).repeat(scale, 1)
    height, width = pixels.shape[:2]
    return np.pad(pixels, [(0, height % 2), (0, width % 2), (0, 0)], mode="edge")


def _write_film(
    path: Path, pictures: Iterator[np.ndarray], count: int, fps: float, codec: str
) -> str:
    first = next(pictures)
    size = (first.shape[1], first.shape[0])
    fps = round(fps, 2) if fps > FINE_FPS else fps
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*FOURCC[codec]), fps, size)
    if not writer.isOpened():
        raise EvflowDataError(
            "EV019", f"OpenCV {cv2.__version__} does not write {codec} of {size[0]}x{size[1]} at "
            f"{fps:g} pictures a second.",
            "Try a smaller --scale, the other codec, or a .gif.")
    try:
        writer.write(first[..., ::-1])
        for picture in pictures:
            writer.write(picture[..., ::-1])
    finally:
        writer.release()
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    readable = 0
    while capture.grab():
        readable += 1
    capture.release()
    if readable != count:
        raise EvflowDataError("EV019", f"{readable} of {count} pictures can be read again.",
                              "Is the disk full? Nothing was kept.")
    browsers = " (for browsers --codec vp9, or ffmpeg -c:v libx264)" if codec == "mpeg4" else ""
    return f"{size[0]}x{size[1]}, {codec}{browsers}"


def _write_gif(path: Path, pictures: Iterator[np.ndarray], count: int, fps: float) -> str:
    if count > GIF_FRAMES:
        raise EvflowDataError("EV020", f"the GIF would have {count:,} pictures.",
                              f"At most {GIF_FRAMES}: show less (--start, --stop), or .mp4.")
    edges = [round(i / (fps * GIF_TICK_S)) for i in range(count + 1)]
    images: list[Image.Image] = []
    begins: list[int] = []
    for begin, picture in zip(edges, pictures, strict=False):
        if not begins or begin - begins[-1] >= LEAST_TICKS:
            images.append(Image.fromarray(picture).quantize(64, dither=Image.Dither.NONE))
            begins.append(begin)
    ticks = np.maximum(np.diff([*begins, edges[-1]]), LEAST_TICKS)
    images[0].save(path, save_all=True, append_images=images[1:], loop=0, optimize=False,
                   duration=(1000 * GIF_TICK_S * ticks).astype(int).tolist())
    width, height = images[0].size
    some = f", {len(images)} of them, as a GIF shows at most 50 a second" * (len(images) < count)
    return f"{width}x{height}{some}"
