"""evflow's own .npz: t (int64 us), x, y, p, size = (width, height); frames and frame_times beside
them where there are any. `wh` is read as another name of `size`. Pickles are never loaded.

Members are checked against the bytes that the archive really holds before memory is taken.
"""

from __future__ import annotations

import math
import os
import zipfile
from pathlib import Path

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files import atomic_write
from evflow.io.hints import Hints
from evflow.types import Events, Recording

NAME = "npz"
EXTENSIONS: tuple[str, ...] = (".npz",)

MAX_RATIO = 1040  # DEFLATE cannot expand by more than 1032


def sniff(path: Path, head: bytes) -> bool:
    if not head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, ValueError):
        return path.suffix.lower() in EXTENSIONS  # cut off: the extension decides


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (a column is missing), EV009 (damaged), and what `Events` raises."""
    arrays = _load(path)
    missing = [name for name in ("t", "x", "y", "p") if name not in arrays]
    if missing:
        raise EvflowDataError(
            "EV008", f"{path} holds {sorted(arrays)} but not {missing}.",
            "Expected the keys t, x, y, p, size, and optionally frames, frame_times.")
    stored = arrays.get("size", arrays.get("wh"))
    x, y = arrays["x"], arrays["y"]
    reach = (int(x.max()), int(y.max())) if x.dtype.kind in "iu" and x.size and y.size else None
    size = hints.sensor(None if stored is None else tuple(stored.ravel().tolist()), reach=reach)
    events = Events(x, y, hints.microseconds(arrays["t"], "us"), hints.on(arrays["p"]), size)
    if "frames" not in arrays:
        return hints.crop(Recording.of_events(events))
    if "frame_times" not in arrays:
        raise EvflowDataError("EV008", f"{path} holds frames but no frame_times.")
    times = hints.microseconds(arrays["frame_times"], "us")
    return hints.crop(Recording(events, arrays["frames"], times))


def write(path: str | os.PathLike, recording: Recording, *, overwrite: bool = False) -> None:
    """Raises EV013 (exists), EV019 (cannot be written)."""
    events = recording.events
    arrays = {name: getattr(events, name) for name in ("t", "x", "y", "p")}
    arrays["size"] = np.array(events.size, np.int32)
    if recording.has_frames:
        arrays |= {"frames": recording.frames, "frame_times": recording.frame_times}
    with atomic_write(path, overwrite=overwrite) as temporary, open(temporary, "wb") as f:
        np.savez_compressed(f, allow_pickle=False, **arrays)


def _load(path: Path) -> dict[str, np.ndarray]:
    """All arrays of the archive by key; EV009 where any of them is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {info.filename.removesuffix(".npy"): _member(archive, info)
                    for info in archive.infolist()}
    except Exception as e:  # zip, zlib, NumPy's header parser, tokenize: a dozen kinds
        raise EvflowDataError(
            "EV009", f"{path} is not a sound .npz ({e or type(e).__name__}).",
            "Copy or export it again; arrays of objects (pickles) are refused.") from e


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    if not info.filename.endswith(".npy"):  # skipping it could lose the frames unseen
        raise ValueError(f"{info.filename} is not an array")
    if info.file_size > MAX_RATIO * info.compress_size + 1024:
        raise ValueError(f"{info.filename} claims {info.file_size:,} bytes")
    with archive.open(info) as f:
        major = np.lib.format.read_magic(f)[0]
        header = (np.lib.format.read_array_header_1_0 if major == 1
                  else np.lib.format.read_array_header_2_0)
        shape, _, dtype = header(f)
    if math.prod(shape) * dtype.itemsize > info.file_size:
        raise ValueError(f"{info.filename} is cut off: {dtype} {shape}")
    with archive.open(info) as f:
        return np.lib.format.read_array(f, allow_pickle=False)
