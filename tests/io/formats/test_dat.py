"""DAT: types, versions and headers; N-CARS."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.recordings import equal, refused
from helpers.streams import clustered, dat

from evflow.io import read_events
from evflow.io.registry import find_format


def test_headers_and_types(tmp_path: Path) -> None:
    path, events = tmp_path / "a.dat", clustered(50)
    for header in (b"% Data file containing CD events.\n% Version 2\n% Date x\n", b"% Date x\n"):
        path.write_bytes(dat(events, header))
        assert refused(path).code == "EV015"
        equal(read_events(path, size=(240, 180)), events)
        path.write_bytes(dat(events, header).replace(b"\x0c\x08", b"\x00\x08", 1))
        equal(read_events(path, size=(240, 180)), events)
    path.write_bytes(dat(events).replace(b"\x0c\x08", b"\x0e\x08", 1))
    assert "triggers" in str(refused(path))
    path.write_bytes(dat(events).replace(b"Version 2", b"Version 1"))
    assert "version '1'" in str(refused(path))
    path.write_bytes(dat(events).replace(b"\x0c\x08", b"\x0c\x09", 1))
    assert "expected an event type and the size 8" in str(refused(path))
    path.write_bytes(b"% Version 2\n\x0c")
    assert refused(path).code == "EV009"


def test_polarity_beyond_one_is_told_with_its_byte(tmp_path: Path) -> None:
    path, sound = tmp_path / "a.dat", dat(clustered(50))
    path.write_bytes(sound + struct.pack("<2I", 10**6, 3 << 28))
    error = refused(path)
    assert error.code == "EV009"
    assert f"at byte {len(sound):,} of" in str(error)
    assert "polarity 3" in str(error)


def test_real_ncars(data_file: Callable[[str], Path]) -> None:
    path = data_file("data/formats/sample_ncars.dat")
    assert find_format(path).NAME == "dat"
    assert "x=77, y=41" in str(refused(path))
    got = read_events(path, size=(120, 100))
    assert len(got) == 2009 == (path.stat().st_size - 94 + 1) // 8
    assert (got.t[0], got.t[-1]) == (0, 99_952)
    assert got.p.mean() == pytest.approx(0.67, abs=5e-3)
