"""Parts of a sensor."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.recordings.region import bands, inside, rows_of
from evflow.types import Events, Window

EVENTS = Events(np.array([0, 4, 2, 3]), np.array([0, 2, 1, 2]), np.arange(4), np.array([1, 0, 1, 1],
                bool), (5, 3))


@pytest.mark.parametrize(("shape", "pixels", "heights"), [
    ((3, 5), 100, [3]), ((7, 10), 20, [1, 2, 2, 2]), ((4, 10), 1, [1, 1, 1, 1])])
def test_bands_are_every_row_once_and_of_two_heights_at_most(
    shape: tuple[int, int], pixels: int, heights: list[int]
) -> None:
    found = list(bands(shape, pixels))
    assert np.concatenate([np.arange(shape[0])[rows] for rows in found]).tolist() == list(
        range(shape[0]))
    assert sorted(rows.stop - rows.start for rows in found) == heights


def test_a_part_counts_from_its_first_pixel() -> None:
    part = inside(EVENTS, slice(1, 3), slice(2, 4))
    assert part.size == (2, 2)
    assert (part.x.tolist(), part.y.tolist(), part.t.tolist(), part.p.tolist()) == (
        [0, 1], [0, 1], [2, 3], [True, True])
    frame = np.arange(15.0).reshape(3, 5)
    rows = rows_of(Window(EVENTS, frame, frame + 1, 0, 4, 7), slice(2, 3))
    assert (rows.events.size, rows.events.t.tolist(), rows.index) == ((5, 1), [1, 3], 7)
    assert rows.frame1.tolist() == [[11, 12, 13, 14, 15]]
