"""The simulator's experiments, small: counts keep to their laws, pages are drawn."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from evflow.camera.sensors import SENSORS, SensorModel
from experiments import models, noise
from experiments.shared import laws


def drawn(path: Path) -> bool:
    page = cv2.imread(str(path))
    return page is not None and min(page.shape[:2]) > 600


def test_steady_rise_is_a_count_of_thresholds_without_noise() -> None:
    theta = np.array([0.1, 0.3, 0.7, 3.0])
    time = np.linspace(0, 1, 50)
    found = laws.steady_rise(theta, np.full(4, 2.0), time, 0 * time, np.ones(4))
    np.testing.assert_array_equal(found, [20, 6, 2, 0])


def test_steady_rise_with_noise_agrees_with_a_walk_through_time() -> None:
    """20,000 pixels with a reset of the memory at Poisson times: mean counts to 4 sd."""
    rng = np.random.default_rng(2)
    steps, pixels, hz, total = 2000, 20_000, 3.0, 2.0
    time = np.arange(steps + 1) / steps  # one second
    for theta, path in ((0.1, time), (0.45, time**2)):
        contrast, fired = np.zeros(pixels), np.zeros(pixels)
        for k in range(steps):
            contrast += total * (path[k + 1] - path[k])
            passed = contrast >= theta - 1e-9
            fired += passed
            contrast -= theta * passed
            contrast[rng.random(pixels) < hz / steps] = 0.0
        expected = laws.steady_rise(np.array([theta]), np.array([total]), path, hz * time,
                                    np.ones(1))[0]
        assert fired.mean() == pytest.approx(expected, abs=4 * fired.std() / np.sqrt(pixels))
        assert expected < 0.97 * np.floor(total / theta)  # noise does cost events


def test_leak_and_passages_in_their_limits() -> None:
    """Without pattern or noise a leak fires floor(rate x time); frequent noise ends it; a pattern
    of .1 decades has a mean of 1.027. A passage is certain at last, and half done near its mean."""
    leak = SensorModel(leak_hz=0.5)
    assert laws.leaked(leak, 3.0, 21.0) == 10.0
    resetting = SensorModel(leak_hz=0.5, noise_resets_memory=True)
    assert laws.leaked(resetting, 20.0, 21.0) < 1e-9
    many = laws.leaked(SensorModel(leak_hz=0.5, leak_fpn_decades=0.1), 0.0, 2000.0)
    assert many == pytest.approx(1027 - 0.5, abs=0.5)
    mean, shape = 2.0, 4000.0
    assert laws.passage(np.array([1.8, 2.0, 2.2, 99.0]), mean, shape) == pytest.approx(
        [0, 0.5, 1, 1], abs=0.03)


@pytest.mark.slow
def test_noise_keeps_to_its_laws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every sum of at least 10,000 events within 2 % of its law, the single cells within 4.5
    standard deviations; Eq. 12 falls with light and threshold."""
    result = noise.main(noise.Options(out=tmp_path))
    text = capsys.readouterr().out
    assert "2,850,599" in text
    assert len(result["totals"]) > 200
    for name, cell in result["totals"].items():
        assert cell["law"] >= 10_000, name
        assert abs(cell["deviation"]) < 0.02, name
    assert result["cells"]["standard deviations"] < 4.5
    rows = result["figure 5"]["paper"]
    rates = np.array([[c["events"] / r["seconds"] for c in r["on"]] for r in rows])
    assert (np.diff(rates, axis=0) < 0).all()
    assert (rates[:, 0] > 2 * rates[:, -1]).all()
    for name in ("noise", "events", "sources"):
        assert drawn(tmp_path / f"{name}.png")
    saved = json.loads((tmp_path / "noise.json").read_text())
    assert saved["result"]["totals"] == result["totals"]


@pytest.mark.slow
def test_models_are_compared_on_one_page(tmp_path: Path) -> None:
    result = models.main(models.Options(out=tmp_path))
    assert set(SENSORS) < set(result)
    clean, slots = result["clean"], result["clean, slots"]
    assert (clean["on"], clean["off"]) == (slots["on"], slots["off"])
    assert slots["distinct"] < 0.02 * clean["distinct"]
    assert result["esim"]["noise"] == 0
    assert result["noisy"]["noise"] > 1000
    shape = models.Options().shape
    for row in result.values():
        events = 5e-3 * shape[0] * shape[1] * (sum(row["rate_on"]) + sum(row["rate_off"]))
        assert events == pytest.approx(row["on"] + row["off"], rel=1e-6)
    assert drawn(tmp_path / "models.png")
    assert json.loads((tmp_path / "models.json").read_text())["result"] == result
