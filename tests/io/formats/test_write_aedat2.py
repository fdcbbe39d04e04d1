"""AEDAT 2 is written as jAER's specification has it, and read back bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.sources import message

from evflow import Events, read_events, write_events

SIZES = ((346, 260), (240, 180), (640, 480), (128, 128))


def some(size: tuple[int, int], count: int = 500) -> Events:
    rng = np.random.default_rng(0)
    width, height = size
    x, y = rng.integers(0, width, count), rng.integers(0, height, count)
    x[:2], y[:2] = (0, width - 1), (0, height - 1)  # the corners
    return Events(x, y, np.sort(rng.integers(0, 2**31 - 1, count)), rng.random(count) < 0.5, size)


@pytest.mark.parametrize("size", SIZES)
def test_addresses_are_those_of_the_chip(tmp_path: Path, size: tuple[int, int]) -> None:
    events = some(size)
    write_events(tmp_path / "a.aedat", events, "aedat2")
    data = (tmp_path / "a.aedat").read_bytes()
    assert data.startswith(b"#!AER-DAT2.0\r\n")
    table = np.frombuffer(data[data.index(b"Header\r\n") + 8 :], ">u4").reshape(-1, 2)
    address, t = table.T.astype(np.int64)
    x, y, on = (((address >> 1) & 127, (address >> 8) & 127, 1 - (address & 1)) if size[0] == 128
                else ((address >> 12) & 1023, (address >> 22) & 511, (address >> 11) & 1))
    np.testing.assert_array_equal(size[0] - 1 - x, events.x)
    np.testing.assert_array_equal(size[1] - 1 - y, events.y)
    np.testing.assert_array_equal(on, events.p)
    np.testing.assert_array_equal(t, events.t)
    again = read_events(tmp_path / "a.aedat")
    assert again.size == size
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(again, name), getattr(events, name))


def test_what_jaer_cannot_hold_is_refused(tmp_path: Path) -> None:
    for events in (Events([1], [1], [0], [1], (64, 48)), Events([1], [1], [2**31], [1], (240, 180)),
                   Events([1], [1], [-1], [1], (240, 180))):
        error = message(lambda e=events: write_events(tmp_path / "a.aedat", e, "aedat2"))
        assert error.startswith("EV003")
        assert ("36 minutes from 0" in error) == (events.size == (240, 180))
    assert list(tmp_path.iterdir()) == []
