"""Known file types that are not read: what they are, and what to do with them."""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from shlex import quote

from evflow.errors import EvflowDataError
from evflow.files.archives import DAMAGE, npy_header
from evflow.io.decode.columns import meaning
from evflow.io.formats import unread_text
from evflow.io.formats.unread_text import Known
from evflow.io.images.folder import list_images
from evflow.io.images.times import read_times

NPZ = "np.savez('events.npz', t=t, x=x, y=y, p=p, size=(width, height)), t in microseconds"
VIDEO = Known(
    "a video or image: it holds frames, not events",
    "Simulate its events (evflow simulate), or pass it beside a recording (--frames).")
MAGICS: tuple[tuple[int, bytes, Known], ...] = (  # at a byte of the file
    (0, b"Event Stream", Known(
        "an Event Stream (.es)", "Convert it with faery (pip install faery): faery input file IN "
        "output file OUT.csv.")),
    (0, b"MATLAB 5.0 MAT-file", Known(
        "a MATLAB file", f"In Python, scipy.io.loadmat(path) has its arrays: write {NPZ}.")),
    (0, b"MATLAB 7.3 MAT-file", Known(
        "a MATLAB file of version 7.3, which is HDF5", "In Python, h5py.File(path) has its arrays: "
        f"write {NPZ}.")),
    (0, b"#!AER-DAT", Known("AEDAT of an unknown version",
                            "Versions 1 to 4 are read: log it again with DV or jAER.")),
    (0, b"\x1f\x8b", Known("compressed by gzip", "Unpack it first: gunzip.")),
    (0, b"\x28\xb5\x2f\xfd", Known("compressed by zstd", "Unpack it first: zstd -d.")),
    (0, b"BZh", Known("compressed by bzip2", "Unpack it first: bunzip2.")),
    (0, b"\xfd7zXZ\0", Known("compressed by xz", "Unpack it first: unxz.")),
    (0, b"\x04\x22\x4d\x18", Known("compressed by lz4", "Unpack it first: lz4 -d.")),
    (0, b"7z\xbc\xaf\x27\x1c", Known("a 7z archive", "Unpack it first: 7z x.")),
    (0, b"Rar!", Known("a RAR archive", "Unpack it first.")),
    (257, b"ustar", Known("a tar archive", "Unpack it first: tar -xf.")),
    (0, b"PAR1", Known("a Parquet file", f"In Python, pandas.read_parquet(path) has its columns: "
                       f"write {NPZ}.")),
    (0, b"ARROW1", Known("a Feather file", "In Python, pandas.read_feather(path) has its columns: "
                         f"write {NPZ}.")),
    (0, b"\x80\x04", Known("a pickle of Python", "It could run any program, and is never opened: "
                           f"where it was made, write {NPZ}.")),
    (0, b"SQLite format 3\0", Known(
        "an SQLite database without ROS 2 messages", "For a ROS 2 bag pass the folder, or the .db3 "
        "with its metadata.yaml.")),
    (0, b"version https://git-lfs", Known(
        "a pointer to a file in Git LFS", "Fetch the file itself: git lfs pull.")),
    (0, b"<!DOCTYPE html", Known("a web page", "The download failed, or needs a login.")),
    (0, b"<html", Known("a web page", "The download failed, or needs a login.")),
    (0, b"\x89PNG\r\n", VIDEO), (0, b"\xff\xd8\xff", VIDEO), (0, b"GIF8", VIDEO),
    (0, b"II*\0", VIDEO), (0, b"MM\0*", VIDEO), (4, b"ftyp", VIDEO), (0, b"\x1aE\xdf\xa3", VIDEO),
    (0, b"RIFF", VIDEO),
)
MOST = 20  # files of a folder that are examined
LONGEST = 1 << 22  # bytes of a file of frame times that is examined
PICKLES = tuple(bytes([0x80, version]) for version in (2, 3, 5))


def known(path: Path, head: bytes) -> Known | None:
    """What a file with this beginning is, if no format claims it; None if unknown."""
    for at, magic, found in MAGICS:
        if head.startswith(magic, at):
            return _of(path, found)
    if head.startswith(PICKLES):
        return next(found for _, magic, found in MAGICS if magic == b"\x80\x04")
    if head.startswith(b"\x93NUMPY"):
        return _array(head)
    if head.startswith(b"PK"):
        return _archive(path)
    if path.suffix.lower() == ".raw":
        return Known("not a Prophesee RAW: it does not begin with lines `% evt 3.0` or `% format "
                     "EVT3`, nor are its words EVT2, EVT2.1 or EVT3",
                     "Was it exported without its header, or is it raw video? Record it again, or "
                     "prepend the header of another recording of this camera.")
    if path.suffix.lower() in (".aedat", ".dat") and b"\0" in head[:64]:
        return Known("data without a header, possibly AEDAT 1 of an old jAER",
                     "Open it in jAER, and log it again: that writes AEDAT 2.")
    words = unread_text.known(head)
    return None if words is None else _of(path, words)


def folder(path: Path, is_recording: Callable[[Path], bool]) -> Known:
    """What a folder holds that no format claims, and which of its files can be read."""
    files = sorted(p for p in path.iterdir() if p.is_file())[:MOST]
    columns = {found: p for p in files if p.suffix == ".npy"
               and (found := meaning(p.stem.rpartition("_")[2]))}
    what = f"a folder of {', '.join(p.name for p in sorted(path.iterdir())[:5]) or 'nothing'}"
    if len(columns) == 4:
        loaded = ", ".join(f"{name}=np.load('{columns[name].name}')" for name in "txyp")
        return Known(what, f"Put the columns into one file: np.savez('events.npz', {loaded}, "
                     "size=(width, height)), t in microseconds.")
    recordings = []
    for file in files:
        with contextlib.suppress(EvflowDataError, OSError):
            recordings += [file] if is_recording(file) else []
    if not recordings:
        return Known(what, "Pass a recording in it; none of its own files is one.")
    if images := [p for p in sorted(path.iterdir()) if p.is_dir() and list_images(p)]:
        times = _times_of(len(list_images(images[0])), [*files, *sorted(images[0].iterdir())])
        events = next((r for r in recordings if r != times), recordings[0])
        return Known(what, f"Pass {events} with its frames: --frames {quote(str(images[0]))} "
                     "--timestamps " + (f"{quote(str(times))}." if times else
                                        "FILE, the file of their times."))
    others = " and others one by one" if len(recordings) > 1 else ""
    return Known(what, f"Pass {recordings[0]}{others}.")


def _times_of(n_images: int, files: list[Path]) -> Path | None:
    """The first of the files that holds as many increasing times as there are images."""
    for file in files:
        with contextlib.suppress(EvflowDataError, OSError):
            if file.stat().st_size < LONGEST and len(read_times(file, "us")[0]) == n_images:
                return file
    return None


def _of(path: Path, found: Known) -> Known:
    """Fill in the names of the file and of one beside it, as a shell takes them."""
    return found._replace(fix=found.fix.replace(" IN ", f" {quote(str(path))} ").replace(
        "OUT", quote(str(path.with_suffix("")))))


def _array(head: bytes) -> Known | None:
    try:
        shape, _, dtype = npy_header(io.BytesIO(head))
    except ValueError as e:
        return Known(f"a damaged .npy ({e})", "Copy or export it again; save Python objects as "
                     "arrays of numbers.")
    return Known(f"an array {shape} of {dtype}", "Events are N x 4 numbers, or records with t, x, "
                 "y and p; frames (T, H, W) go to evflow simulate, or beside a recording "
                 "(--frames).")


def _archive(path: Path) -> Known | None:
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name[:60] for name in sorted(archive.namelist())]
    except DAMAGE:
        return Known("a damaged zip archive", "Copy it again.")
    return Known(f"a zip archive of {', '.join(names[:5])}{' ...' if len(names) > 5 else ''}",
                 "Unpack it, and pass the file or folder of events.")
