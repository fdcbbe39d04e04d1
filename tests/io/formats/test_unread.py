"""Files that are named rather than read, each with what to do."""

from __future__ import annotations

import gzip
import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import refused

from evflow.io.source import open_frames


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array, allow_pickle=True)
    return out.getvalue()


def zipped(*names: str) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name in names:
            archive.writestr(name, "x")
    return out.getvalue()


FILES = {  # name: bytes, and what the message says
    "a.es": (b"Event Stream\2\0\0\1@\x000\0", "a.es output file "),
    "a.mat": (b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(200), "scipy.io.loadmat"),
    "b.mat": (b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(600), "h5py.File(path)"),
    "a.csv.gz": (gzip.compress(b"0.1 3 4 1\n" * 9), "gunzip"),
    "a.zst": (b"\x28\xb5\x2f\xfd" + bytes(20), "zstd -d"),
    "a.parquet": (b"PAR1" + bytes(99), "pandas.read_parquet"),
    "a.pkl": (pickle.dumps({"t": [1]}), "never opened"),
    "a.tar": (b"events.txt".ljust(257, b"\0") + b"ustar\0" + bytes(249), "tar -xf"),
    "a.mp4": (b"\0\0\0\x20ftypisom" + bytes(99), "evflow simulate"),
    "a.avi": (b"RIFF\x99\0\0\0AVI LIST" + bytes(99), "--frames"),
    "a.npy": (npy(np.zeros((5, 4, 3), np.uint8)), "an array (5, 4, 3) of uint8"),
    "b.npy": (npy(np.array([None])), "Python objects"),
    "a.zip": (zipped("left/a.raw", "right/b.raw"), "a zip archive of left/a.raw, right/b.raw"),
    "a.raw": (bytes(range(99)), "begin with lines `% evt 3.0`"),
    "old.dat": (b"\0\1\0\2\0\3" * 9, "AEDAT 1"),
    "utf16.csv": ("t,x,y,p\n0.1,3,4,1\n".encode("utf-16"), "iconv -f UTF-16 -t UTF-8"),
    "with a blank.csv": ("t,x,y,p\n0.1,3,4,1\n".encode("utf-16"), "with a blank.csv' > '"),
    "mac.csv": (b"t,x,y,p\r0.1,3,4,1\r0.2,3,4,1\r", "tr '\\r' '\\n' <"),
    "lfs.h5": (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
    "page.npz": (b"<!DOCTYPE html><html>", "The download failed"),
    "a.json": (b'{"t": 0.1, "x": 3}\n' * 9, "is JSON"),
    "half.txt": (b"0.1 3 4 2\n0.2 3 4 1\n0.3 5 4 1\n" * 9, "number 4 holds 1, 2"),
    "three.txt": (b"0.1 3 4\n0.2 7 4\n0.3 5 4\n" * 9, "Events need a polarity"),
    "new.aedat": (b"#!AER-DAT5.0\r\n" + bytes(99), "unknown version"),
}


@pytest.mark.parametrize("name", FILES)
def test_what_is_named(tmp_path: Path, name: str) -> None:
    data, said = FILES[name]
    (tmp_path / name).write_bytes(data)
    error = refused(tmp_path / name)
    assert error.code == "EV008"
    assert said in str(error)


def test_frames_are_still_frames(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((3, 48, 64), np.uint8))
    assert open_frames(tmp_path / "a.npy", fps=25).size == (64, 48)


@pytest.mark.parametrize(("names", "said"), [
    (["events.csv"], "Pass {}/events.csv."),
    (["events.csv", "images/1.png"], "Pass {0}/events.csv with its frames: --frames {0}/images -"),
    (["events.csv", "images/1.png", "a_times.txt", "note.txt"], "--timestamps {}/a_times.txt."),
    (["a.csv", "b.csv"], "Pass {}/a.csv and others"),
    (["a.md"], "none of its own files is one"), ([], "a folder of nothing"),
    ([f"events_{c}.npy" for c in "txyp"], "x=np.load('events_x.npy')")])
def test_folders_name_what_to_pass(tmp_path: Path, names: list[str], said: str) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("0.1 3 4 1\n0.2 3 4 0\n" if name.endswith(".csv") else
                                     "40000\n" if name.endswith("times.txt") else "x")
    error = refused(tmp_path)
    assert (error.code, said.format(tmp_path) in str(error)) == ("EV008", True)
