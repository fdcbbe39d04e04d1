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
    assert [t.get_text() for t in theta.get_legend().get_texts()] == ["one", "two: not measured"]
    assert len(theta.containers) == 1
    assert [line.get_xdata()[0] for line in eta.lines] == [pytest.approx(0.1), pytest.approx(0.48)]
