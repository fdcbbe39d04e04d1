"""Events of a frame's readout part those of their pixel, and are none of its evidence."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.refine import receptor_data
from evflow.estimation.refine.readouts import without_readouts
from evflow.estimation.refine.sightings import Sightings, sight
from evflow.recordings.bunches import Bunch
from evflow.types import Events

TIMES = np.array([0, 40_000, 80_000, 120_000])
READOUT = Bunch(-500, 1_500, 0.2, 0.05)


def seen(t: list[int], pixel: list[int], steps: int = 4) -> Sightings:
    """Events at times t (us) of pixels of one row of two."""
    x, none = np.array(pixel), np.zeros(len(t), int)
    path = np.linspace(3.0, 4.0, 3 * steps + 1, dtype=np.float32)[:, None, None]
    return sight(Events(x, none, np.array(t), np.arange(len(t)) % 2 == 0, (2, 1)), TIMES,
                 np.broadcast_to(path, (len(path), 1, 2)), steps)


@pytest.mark.parametrize(("t", "pixel", "kept", "disturbed"), [
    ([10_000, 39_400, 39_600, 41_400, 41_600, 79_000], [0] * 6, [10_000, 39_400, 41_600, 79_000],
     [0, 0, 2, 2]),
    ([500, 20_000, 40_100, 60_000, 70_000], [0, 1, 0, 1, 0], [70_000, 20_000, 60_000], [2, 2, 2]),
    ([119_499, 119_500, 119_999], [1] * 3, [119_499], [0]),
], ids=["one pixel", "two pixels", "before the last frame"])
def test_what_comes_with_a_readout(
    t: list[int], pixel: list[int], kept: list[int], disturbed: list[int]
) -> None:
    left, before = without_readouts(seen(t, pixel), TIMES, READOUT)
    found = TIMES[left.interval] + left.fraction * 40_000
    np.testing.assert_allclose(found, kept)
    assert before.tolist() == disturbed
    assert left.pixel[left.first].tolist() == sorted(set(left.pixel.tolist()))


def test_without_readouts_all_is_as_it_was() -> None:
    s = seen([10_000, 39_600], [0, 0])
    left, before = without_readouts(s, TIMES, None)
    assert left is s
    assert before.tolist() == [0, 0]


def test_a_readout_begins_another_group(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receptor_data, "ENOUGH", 0)
    monkeypatch.setattr(receptor_data, "LEAST", 0)
    t = [35_000, 38_000, 40_200, 45_000, 60_000, 75_000, 79_800, 90_000]
    parts = [(np.full((13, 1, 2), 100.0), np.full(12, 0.01),
              *without_readouts(seen(t, [0] * 8), TIMES, found), np.zeros(2, bool))
             for found in (None, READOUT)]
    groups, counts = [], []
    for part in parts:
        data = receptor_data.sample([part])
        assert data is not None
        used = np.asarray(data.weight[0]) > 0
        groups.append(np.asarray(data.group[0])[used].tolist())
        counts.append((np.asarray(data.on) - np.asarray(data.off))[0, used].tolist())
    assert groups == [[0] * 8, [0, 0, 1, 1, 1, 2]]
    assert counts == [list(range(1, 9)), list(range(1, 7))]
