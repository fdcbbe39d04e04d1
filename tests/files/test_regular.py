"""Pipes, devices and sockets are refused wherever a file is read, before they are opened."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import tables
from helpers.recordings import make, write_ijrr

from evflow.camera import Camera
from evflow.camera.perturb import read_noise_histogram
from evflow.errors import EvflowDataError
from evflow.files import regular
from evflow.files.archives import load_npz
from evflow.files.arrays import mapped
from evflow.io import read_recording
from evflow.io.source import open_frames
from evflow.network.weights import load_weights
from evflow.scenes import read_coco
from evflow.training.checkpoint import Checkpoints
from evflow.training.log import lines_until

Put = Callable[[Path], None]


def frames(path: Path, put: Put) -> None:
    put(path)
    open_frames(path, fps=25)


def times(path: Path, put: Put) -> None:
    np.save(path.with_name("a.npy"), np.zeros((2, 4, 4), np.uint8))
    put(path)
    open_frames(path.with_name("a.npy"), timestamps=path)


def beside(path: Path, put: Put) -> None:
    folder = write_ijrr(path.with_name("ijrr"), make(5, 2))
    (folder / "images.txt").unlink()
    put(folder / "images.txt")
    read_recording(folder, size=(64, 48))


def images(path: Path, put: Put) -> None:
    folder = tables.write(path.parent, "evreal", 5)
    (folder / "images.npy").unlink()
    put(folder / "images.npy")
    read_recording(folder)


def one(name: str, read: Callable[[Path], Any]) -> tuple[str, Any]:
    def reading(path: Path, put: Put) -> None:
        put(path)
        read(path)

    return name, reading


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def bound(path: Path) -> None:
    os.chdir(path.parent)  # names of sockets are short
    socket.socket(socket.AF_UNIX).bind(path.name)


@pytest.mark.timeout(60)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("put", [pipe, device, bound])
@pytest.mark.parametrize(("name", "read"), [
    ("a.npy", frames), ("a.npz", frames), ("a.mp4", frames), ("a.png", frames),
    ("times.txt", times), ("x", beside), ("x", images), one("a.h5", read_recording),
    one("a.raw", read_recording), one("camera.npz", Camera.load), one("a.json", read_coco),
    one("a.safetensors", load_weights), one("a.npy", read_noise_histogram),
    one("m.jsonl", lambda p: [*lines_until(p, 3)])])
def test_what_has_no_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, put: Put, name: str, read: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(EvflowDataError) as caught:
        read(tmp_path / name, put)
    assert caught.value.code == "EV016"
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(("name", "read"), [
    ("times.txt", times), ("x", beside), one("a.png", lambda p: open_frames(p.parent, fps=25)),
    one("a.safetensors", load_weights), one("a.json", read_coco),
    one("m.jsonl", lambda p: [*lines_until(p, 3)]),
    one("config.json", lambda p: Checkpoints(p.parent).check_config({}))])
def test_what_is_read_whole_is_not_too_large(tmp_path: Path, name: str, read: Any) -> None:
    """A sparse file of three bytes stands for more than there is memory."""
    def put(path: Path) -> None:
        path.write_bytes(b"{}\n")
        os.truncate(path, 1 << 36)

    with pytest.raises(EvflowDataError, match=r"EV009.*has 68,719,476,736 bytes") as caught:
        read(tmp_path / name, put)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("read", [
    Camera.load, load_npz, lambda path: mapped(path, (None,))], ids=["camera", "npz", "npy"])
def test_a_file_that_may_not_be_read_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], Any]
) -> None:
    def refused(path: Path, mode: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    path = tmp_path / "camera.npz"
    path.write_bytes(b"PK")
    monkeypatch.setattr(regular, "open", refused, raising=False)
    with pytest.raises(EvflowDataError, match=r"EV016.*cannot be opened \(Permission denied\)"):
        read(path)
