"""Folders of .npy arrays: EVREAL and EVIMO2."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.recordings import equal, refused
from helpers.tables import want, write

from evflow.io import read_events, read_recording


def test_evreal_without_images_and_with_lies(tmp_path: Path) -> None:
    path = write(tmp_path, "evreal")
    (path / "images.npy").unlink()
    equal(read_events(path), want("evreal").events)
    (path / "metadata.json").write_text("{}")
    assert "sensor_resolution" in str(refused(path))
    (path / "metadata.json").unlink()
    assert refused(path).code == "EV015"
    np.save(path / "events_p.npy", np.zeros(7, np.uint8))
    assert "different length" in str(refused(path))
    np.save(path / "events_p.npy", np.array([None] * 2000), allow_pickle=True)
    assert "pickles are refused" in str(refused(path))
    header = b"{'descr': '<i8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117)
    (path / "events_p.npy").write_bytes(b"\x93NUMPY\x01\x00\x76\x00" + header + b"\n" + bytes(16))
    assert "claims (1000000000000,)" in str(refused(path))
    (path / "events_p.npy").unlink()
    assert refused(path).code == "EV016"


def test_evimo2_turns_the_samsung_camera_alone(tmp_path: Path) -> None:
    samsung = write(tmp_path, "evimo2")
    other = tmp_path / "left_camera"
    samsung.rename(other)
    got, events = read_recording(other), want("evimo2").events
    np.testing.assert_array_equal(got.events.p, ~events.p)
    assert got.notes == ()
    assert got.events.size == (640, 480)
    other.rename(tmp_path / "elsewhere")
    assert refused(tmp_path / "elsewhere").code == "EV015"
