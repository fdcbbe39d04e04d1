"""HDF5 of which a part lies in other files is refused before those are opened: they may be absent,
which HDF5 reads as zeros, pipes, or the file itself."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.recordings import equal, make, refused
from helpers.tables import want, write

from evflow.io import read_recording, write_events
from evflow.io.registry import find_format

PLACES = {"dsec": ("events", "events/x", "frames", "frame_times"),
          "v2e": ("events", "frame", "frame_ts"),
          "mvsec": ("davis", "davis/left", "davis/left/events", "davis/left/image_raw_ts"),
          "event_utils": ("events", "events/ts", "images", "images/image000000001")}
Change = Callable[[h5py.Group, str, tuple[int, ...], str], None]


def link(f: h5py.Group, name: str, shape: tuple[int, ...], other: str) -> None:
    f[name] = h5py.ExternalLink(other, "/x")


def linked_link(f: h5py.Group, name: str, shape: tuple[int, ...], other: str) -> None:
    f["far"] = h5py.ExternalLink(other, "/")
    f[name] = h5py.SoftLink("/far/x")


def virtual(f: h5py.Group, name: str, shape: tuple[int, ...], other: str) -> None:
    layout = h5py.VirtualLayout(shape, "f8")
    layout[...] = h5py.VirtualSource(other, "x", shape)
    f.create_virtual_dataset(name, layout)


def growing(f: h5py.Group, name: str, shape: tuple[int, ...], other: str) -> None:
    """Of as many files as there are, which HDF5 looks for when it is asked for the shape."""
    made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    space = h5py.h5s.create_simple((9,), (h5py.h5s.UNLIMITED,))
    space.select_hyperslab((0,), (h5py.h5s.UNLIMITED,), (2,), (2,))
    made.set_virtual(space, other.encode(), b"x%b", h5py.h5s.create_simple((2,)))
    h5py.h5d.create(f.id, name.encode(), h5py.h5t.NATIVE_DOUBLE, space, made)


def outside(f: h5py.Group, name: str, shape: tuple[int, ...], other: str) -> None:
    f.create_dataset(name, shape, "f8", external=[(other, 0, 1 << 20)])


@pytest.mark.parametrize("other", ["absent.h5", "pipe", "a.h5", "."])
@pytest.mark.parametrize("change", [link, linked_link, virtual, growing, outside])
@pytest.mark.parametrize("kind", PLACES)
def test_what_lies_in_other_files_is_refused(
    tmp_path: Path, sound: dict[str, bytes], kind: str, change: Change, other: str
) -> None:
    os.mkfifo(tmp_path / "pipe")
    for index, place in enumerate(PLACES[kind]):
        path = tmp_path / f"{index}.h5"
        path.write_bytes(sound[kind])
        with h5py.File(path, "a") as f:
            shape = getattr(f[place], "shape", (9,))
            del f[place]
            change(f, place, shape, path.name if other == "a.h5" else other)
        error = refused(path)
        assert error.code == "EV009"
        assert str(path) in error.seen
        assert any(word in error.seen for word in ("other file", "another file", "outside of it"))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("sound")
    write_events(folder / "dsec.h5", make(50, 2))
    return {"dsec": (folder / "dsec.h5").read_bytes()} | {
        kind: write(folder, kind, 50).read_bytes() for kind in PLACES if kind != "dsec"}


def test_the_advice_makes_a_file_that_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, "v2e")
    path.with_name("far.h5").write_bytes(path.read_bytes())
    with h5py.File(path, "a") as f:
        del f["events"]
        f["events"] = h5py.ExternalLink("far.h5", "/events")
    assert refused(path).fix.endswith("f[name] = values.")
    with h5py.File(path, "a") as f:
        values = f["events"][:]
        del f["events"]
        f["events"] = values
    equal(read_recording(path).events, want("v2e").events)


def test_links_within_the_file_are_followed(tmp_path: Path) -> None:
    path = write(tmp_path, "v2e")
    with h5py.File(path, "a") as f:
        f.move("events", "deep/down/values")
        f["deep/near"] = h5py.SoftLink("./down//values")
        f["other"] = f["deep"]
        f["events"] = h5py.SoftLink("/other/near")
    assert find_format(path).NAME == "v2e"
    equal(read_recording(path).events, want("v2e").events)
    np.testing.assert_array_equal(read_recording(path).frames, want("v2e").frames)
