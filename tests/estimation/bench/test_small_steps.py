"""Steps of few thresholds, which noise makes less certain than its own events."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.bench.levels import SIZE_ERROR, size_error, small_steps


@pytest.mark.parametrize(("size", "noted"), [(0.3, True), (0.6, True), (0.8, False), (2.0, False)])
def test_smaller_steps_have_larger_errors(size: float, noted: bool) -> None:
    changes, theta = size * np.array([1.0, -1.0] * 6), np.array([0.25, 0.125])
    error = size_error(changes, theta, np.ones(12, bool))
    np.testing.assert_allclose(error, SIZE_ERROR / np.maximum(size / theta, 1.0) ** 2)
    notes = small_steps(error)
    assert [n.code for n in notes] == ["steps.small"] * noted
    if noted:
        assert f"of {size / 0.25:.1f} thresholds" in notes[0].text


def test_steps_of_one_direction_and_unknown_ones_say_nothing_of_the_other() -> None:
    up = np.full(6, 0.3)
    both = size_error(up, np.full(2, 0.3), np.ones(6, bool))
    assert both[0] == SIZE_ERROR
    assert both[1] < 0.02
    assert small_steps(size_error(up, np.full(2, 0.3), np.zeros(6, bool))) == []
