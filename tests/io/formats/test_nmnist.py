"""N-MNIST's .bin: bits by hand, overflows, the two sizes; and other files of that name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.recordings import refused
from helpers.streams import listed

from evflow.io import read_events, read_recording
from evflow.io.decode.stream import CHUNK
from evflow.notes import texts


def test_bits_by_hand(tmp_path: Path) -> None:
    """ON at 0x012345 us, OFF one later; y = 240 adds 8192 us to what comes behind."""
    path = tmp_path / "00001.bin"
    path.write_bytes(bytes([33, 2, 0x81, 0x23, 0x45, 4, 33, 0x01, 0x23, 0x46, 0, 240, 0, 0, 0,
                            0, 0, 0x81, 0x23, 0x47]))
    found = read_recording(path)
    assert listed(found.events) == [
        (33, 2, 0x12345, 1), (4, 33, 0x12346, 0), (0, 0, 0x12347 + 8192, 1)]
    assert found.events.size == (34, 34)
    assert texts(found.notes) == [
        "assumed the sensor size of N-MNIST, 34x34: events reach 33"]
    assert read_recording(path, size=(64, 48)).notes == ()


def test_the_larger_size_and_chunks(tmp_path: Path, monkeypatch: object) -> None:
    rng = np.random.default_rng(0)
    n = 5000
    t = np.sort(rng.integers(0, 300_000, n))
    x, y, p = rng.integers(0, 240, n), rng.integers(0, 180, n), rng.integers(0, 2, n)
    rows = np.stack([x, y, p << 7 | t >> 16, t >> 8 & 255, t & 255], 1).astype(np.uint8)
    path = tmp_path / "image_0001.bin"
    path.write_bytes(rows.tobytes())
    for chunk in (1 << 18, 64):
        monkeypatch.setattr("evflow.io.decode.stream.CHUNK", chunk)  # type: ignore[attr-defined]
        got = read_events(path)
        assert got.size == (240, 180)
        assert listed(got) == list(zip(*(c.tolist() for c in (x, y, t, p)), strict=True))
    path.write_bytes(rows.tobytes()[:-2])
    assert "at byte 24,995 of 24,998" in str(refused(path))
    back = rows.copy()
    back[4000, 2:] = 0
    path.write_bytes(back.tobytes())
    assert (refused(path).code, "at byte 20,000" in str(refused(path))) == ("EV004", True)


def test_a_few_bytes_behind_a_whole_chunk(tmp_path: Path) -> None:
    """What is read last is less than an event."""
    n = CHUNK // 5
    rows = np.zeros((n, 5), np.uint8)
    t = np.arange(n) // 2
    rows[:, 2:] = np.stack([t >> 16, t >> 8 & 255, t & 255], 1)
    path = tmp_path / "00001.bin"
    path.write_bytes(rows.tobytes() + b"\1\2")
    error = refused(path)
    assert (error.code, "the file ends 2 bytes into a word" in str(error)) == ("EV009", True)
    assert read_events(path, partial=True).t.tolist() == t.tolist()


def test_other_files_of_that_name(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(np.random.default_rng(0).bytes(5000))
    assert refused(tmp_path / "a.bin").code == "EV008"
