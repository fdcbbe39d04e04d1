"""The page of two cameras."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from evflow.camera import Camera
from evflow.metrics.cameras import compare_cameras
from evflow.report import cameras as pages


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The axes of every picture."""
    from matplotlib.figure import Figure

    axes: list[Any] = []

    def keep(draw: Any, width: float, height: float) -> bytes:
        axes.append(Figure().subplots())
        draw(axes[-1])
        return b""

    monkeypatch.setattr(pages, "svg", keep)
    return axes


def test_what_was_not_measured_is_not_drawn(drawn: list[Any]) -> None:
    """Its map holds the prior; the lines are the values of the table, not the maps' medians."""
    a, b = (Camera.constant((4, 5), theta) for theta in (0.2, 0.325))
    uneven = np.float32([[0.1, 0.1, 0.1, 0.1, 2.0]] * 4)
    b = dataclasses.replace(b, eta_on=jnp.asarray(uneven))
    numbers = compare_cameras(
        a, b, a_known={"theta_on": (0.2, 0.01), "eta_on": (0.1, 0.01)},
        b_known={"eta_on": (0.48, 0.01)})
    pages.histograms((a, b), "theta_on", ("one", "two"), numbers["theta_on"])
    pages.histograms((a, b), "eta_on", ("one", "two"), numbers["eta_on"])
    theta, eta = drawn
    for axis in drawn:  # more labels run together
        low, high = axis.get_xlim()
        assert sum(low <= at <= high for at in axis.get_xticks()) <= 6
    assert [t.get_text() for t in theta.get_legend().get_texts()] == ["one", "two: not measured"]
    assert len(theta.containers) == 1
    assert [line.get_xdata()[0] for line in eta.lines] == [pytest.approx(0.1), pytest.approx(0.48)]


def test_cutoffs_of_two_laws_are_compared_at_one_light() -> None:
    """155 Hz at 255 DN, proportional to light, is 83.4 Hz at 128 DN."""
    camera = Camera.constant((4, 5))
    known = [{"theta_on": (0.2, 0.01), "cutoff_hz": pair} for pair in ((155.0, 15.0), (83.4, 8.0))]
    numbers = compare_cameras(camera, camera, a_known=known[0], b_known=known[1], b_by_light=False)
    row = numbers["cutoff_hz"]
    assert (row["at_dn"], row["a_by_light"], row["b_by_light"]) == (128.0, 1.0, 0.0)
    assert row["a"] == pytest.approx(83.4, rel=1e-2)
    assert abs(row["apart"] or 9.0) < 0.1
    text = pages.describe_cameras(numbers, ("one", "two"))
    assert "cutoff_hz at 128 DN" in text
    assert "of one is proportional to light, that of two is the same in any" in text
    assert "differ in cutoff_hz" not in text
    for law, words in ((True, "cutoff_hz at 255 DN"), (False, "cutoff_hz in any light")):
        numbers = compare_cameras(camera, camera, a_known=known[0], b_known=known[1],
                                  a_by_light=law, b_by_light=law)
        assert numbers["cutoff_hz"]["a"] == 155.0
        text = pages.describe_cameras(numbers, ("one", "two"))
        assert words in text
        assert "proportional" not in text
        assert "differ in cutoff_hz" in text
