"""Hostile zips, pickles, and names and links in folders that lead elsewhere or nowhere."""

from __future__ import annotations

import io
import os
import struct
import zipfile
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from helpers import tables
from helpers.fuzz_registry import each, hostile
from helpers.fuzz_samples import SAMPLES, Sample, frames_of, sample
from helpers.recordings import make, write_ijrr

BOMB = 1 << 29  # bytes, from a file of 0.5 MB


class Trap:
    """Unpickled, it would write the file `sprung`."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.close, (-1,)


def pickled() -> np.ndarray:
    return np.array([Trap(), {}], object)


def deflated(path: Path, members: dict[str, tuple[bytes, bytes, int]]) -> Path:
    """A zip of members {name: (beginning, block, times)}, each beginning + block * times, made
    without ever holding them: a block compressed once is a part of the stream that repeats."""
    records, central = b"", b""
    for name, (first, block, times) in members.items():
        coder = zlib.compressobj(9, zlib.DEFLATED, -15)
        stream = coder.compress(first) + coder.flush(zlib.Z_FULL_FLUSH)
        coder = zlib.compressobj(9, zlib.DEFLATED, -15)
        stream += (coder.compress(block) + coder.flush(zlib.Z_FULL_FLUSH)) * times
        stream += zlib.compressobj(9, zlib.DEFLATED, -15).flush()
        crc = zlib.crc32(first)
        for _ in range(times):
            crc = zlib.crc32(block, crc)
        common = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 0x21, crc, len(stream),
                             len(first) + len(block) * times, len(name), 0)
        central += (b"PK\x01\x02\x14\0" + common + struct.pack("<HHHII", 0, 0, 0, 0, len(records))
                    + name.encode())
        records += b"PK\x03\x04" + common + name.encode() + stream
    end = struct.pack("<4sHHHHIIH", b"PK\x05\x06", 0, 0, len(members), len(members), len(central),
                      len(records), 0)
    path.write_bytes(records + central + end)
    return path


def npy(shape: tuple[int, ...], dtype: str = "|u1") -> bytes:
    """The header of an .npy."""
    f = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        f, {"descr": dtype, "fortran_order": False, "shape": shape})
    return f.getvalue()


def zeros(shape: tuple[int, ...], dtype: str = "|u1") -> tuple[bytes, bytes, int]:
    total = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return npy(shape, dtype), bytes(1 << 20), total >> 20


EVENT = {name: zeros((BOMB // 32,), "<i8") for name in "txyp"}


@hostile
def npz_bomb(folder: Path) -> Sample:
    members = {f"{name}.npy": column for name, column in EVENT.items()}
    return sample(deflated(folder / "a.npz", members), size=(9, 9))


@hostile
def npz_bomb_of_parts(folder: Path) -> Sample:
    """No member is large."""
    parts = {f"{i}.npy": zeros((1 << 25,)) for i in range(16)}
    return sample(deflated(folder / "a.npz", parts), size=(9, 9))


@hostile
def stack_bomb_of_times(folder: Path) -> Sample:
    members = {"frames.npy": zeros((16, 256, 256)), "t.npy": zeros((BOMB // 8,), "<i8")}
    return frames_of(deflated(folder / "a.npz", members))


@hostile
def stack_bomb_of_one_frame(folder: Path) -> Sample:
    return frames_of(deflated(folder / "a.npz", {"frames.npy": zeros((1, 1 << 15, 1 << 14))}),
                     fps=25)


@hostile
def camera_bomb(folder: Path) -> Sample:
    names = ("theta_on", "theta_off", "eta_on", "eta_off")
    path = deflated(folder / "a.npz", {f"{n}.npy": zeros((1 << 13, 1 << 12), "<f4") for n in names})
    return Sample(path, (path,), SAMPLES["camera"](folder).read)


@each(ijrr=("deep/events.txt", b""), e2vid=("a.txt", b"64 48\n"))
def text_bomb(folder: Path, case: tuple[str, bytes]) -> Sample:
    name, first = case
    block = b"0.100000000 1 1 1\n" * (1 << 14)
    members = {name: (first, block, BOMB // len(block))}
    return sample(deflated(folder / "a.zip", members), size=(9, 9))


@hostile
def zip_that_claims_a_long_member(folder: Path) -> Sample:
    """Packed into more bytes than the file has."""
    path = folder / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("events.txt", "0.1 1 1 1\n" * 9)
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\1\2") + 20
    data[at:at + 4] = (1 << 30).to_bytes(4, "little")
    path.write_bytes(data)
    return sample(path, size=(9, 9))


@each(up="../../events.txt", rooted="/etc/events.txt", twice="a/events.txt b/events.txt")
def zip_names(folder: Path, case: str) -> Sample:
    with zipfile.ZipFile(folder / "a.zip", "w") as archive:
        for name in case.split():
            archive.writestr(name, "0.1 1 1 7\n")
    return sample(folder / "a.zip", size=(9, 9))


@each(up="../../../etc/passwd", rooted="/etc/passwd", none="images/none.png", inner="images",
      long="x" * 5000, nul="images/a\0b.png")
def image_names(folder: Path, case: str) -> Sample:
    path = write_ijrr(folder / "ijrr", make(50, 2))
    (path / "images.txt").write_text(f"0.001 {case}\n")
    return sample(path)


@hostile
def one_image_a_million_times(folder: Path) -> Sample:
    path = write_ijrr(folder / "ijrr", make(50, 2))
    (path / "images.txt").write_text("".join(
        f"{i * 1e-6:.6f} images/frame_00000000.png\n" for i in range(300_000)))
    return sample(path)


def without_size(path: Path) -> Path:
    os.mkfifo(path)
    return path


@hostile
def pipe_without_end(folder: Path) -> Sample:
    path = without_size(folder / "a.h5")
    return Sample(path, (), sample(path).read)


@each(image="images/frame_00000000.png", events="events.txt", index="images.txt")
def pipe_in_folder(folder: Path, case: str) -> Sample:
    path = write_ijrr(folder / "ijrr", make(50, 2))
    (path / case).unlink()
    without_size(path / case)
    (path / "images.txt").is_file() or (path / "images").rename(path / "other")
    return Sample(path, (), partial(sample(path).read, size=(9, 9)))


@each(loop="a.png", endless="/dev/zero", missing="gone.png")
def linked_image(folder: Path, case: str) -> Sample:
    path = folder / "frames"
    path.mkdir()
    (path / "a.png").symlink_to(case)
    return Sample(path, (), frames_of(path, fps=25).read)


@each(npz="a.npz", stack="a.npy", camera="camera.npz", evreal="boxes/events_ts.npy",
      evimo2="samsung_mono/imo/eval/scene_00/dataset_events_t.npy", times="t.npy")
def pickle(folder: Path, case: str) -> Sample:
    kind = case.split(".")[0].split("/")[0]
    base = {"boxes": "evreal", "samsung_mono": "evimo2"}.get(kind)
    path = tables.write(folder, base, 50) if base else folder / case
    if case.endswith("npz"):
        np.savez(path, **dict.fromkeys(("t", "x", "y", "p", "theta_on", "theta_off", "eta_on",
                                        "eta_off"), pickled()), allow_pickle=True)
    else:
        np.save(folder / case, pickled(), allow_pickle=True)
    if kind == "camera":
        return Sample(path, (path,), SAMPLES["camera"](folder / "b").read)
    if kind == "t":
        SAMPLES["stack-npy"](folder)
        return Sample(folder / "a.npy", (path,), frames_of(path, timestamps=path).read)
    return frames_of(path, fps=25) if kind == "a" and case == "a.npy" else sample(path)
