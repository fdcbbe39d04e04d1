"""Paired gains of networks: differences between conditions, their intervals, and their tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from experiments.shared import gains


def scores(means: list[float], spread: float = 0.1) -> dict[int, np.ndarray]:
    """Clips of each seed, around its mean."""
    offsets = spread * np.linspace(-1, 1, 6)
    return {seed: mean + offsets for seed, mean in enumerate(means)}


def test_gains_are_paired_and_their_interval_is_students() -> None:
    default, ours = [0.40, 0.50, 0.45, 0.47], [0.46, 0.57, 0.52, 0.52]
    rows = {"default": {"ssim": scores(default)}, "wide": {"ssim": scores([0.45] * 4)},
            "evflow": {"ssim": scores(ours)},
            "oracle": {"ssim": scores([d + 0.08 for d in default])}}
    found = gains.compared(rows)
    change = found["evflow"]["ssim"]["to default"]
    test = stats.ttest_rel(ours, default).confidence_interval()
    assert change["mean"] == pytest.approx(0.0625)
    assert change["mean"] - change["ci"] == pytest.approx(test.low)
    assert change["mean"] + change["ci"] == pytest.approx(test.high)
    np.testing.assert_allclose(change["clips"], 0.0625)  # the same for all clips
    share = found["evflow"]["ssim"]["share"]
    assert share["mean"] == pytest.approx(0.0625 / 0.08)
    assert share["interval"][0] < share["mean"] < share["interval"][1]
    assert "share" not in found["oracle"]["ssim"]
    assert "to default" not in found["default"]["ssim"]


def test_less_error_is_better_and_nothing_is_claimed_of_a_single_seed() -> None:
    fewer = {"mean": -0.2, "ci": 0.1}
    assert gains.better("mse", fewer)
    assert not gains.better("ssim", fewer)
    assert not gains.better("mse", {"mean": -0.2, "ci": 0.3})
    rows = {name: {"mse": scores([value])} for name, value in (
        ("default", 0.3), ("evflow", 0.2), ("oracle", 0.1))}
    found = gains.compared(rows)
    assert found["evflow"]["mse"]["to default"]["ci"] is None
    assert "share" not in found["evflow"]["mse"]
    text = gains.report({"high noisy": found}, "video", {}, 3)
    assert "3 trainings are missing" in text
    assert "-0.1000" in text
    assert "**" not in text
    assert ".052/.704/.266" in text  # Table V


def test_of_nothing_there_is_no_picture(tmp_path: Path) -> None:
    gains.picture({"high noisy": {}}, tmp_path / "none.png")
    gains.examples({}, tmp_path / "none.png")
    assert list(tmp_path.iterdir()) == []


def test_measures_that_one_lacks_are_not_compared(tmp_path: Path) -> None:
    """As after LPIPS was installed: older trainings have no such scores."""
    old, new = ({"ssim": scores([0.3, value])} for value in (0.4, 0.5))
    for rows in ({"default": old, "evflow": new | {"lpips": scores([0.2, 0.3])}},
                 {"default": new | {"lpips": scores([0.2, 0.3])}, "evflow": old, "wide": old}):
        found = gains.compared(rows)
        assert found["evflow"]["ssim"]["to default"]["seeds"] == 2
        assert "to default" not in found["evflow"].get("lpips", {})
        gains.picture({"high noisy": found}, tmp_path / "gains.png")
        assert "LPIPS" in gains.report({"high noisy": found}, "video", {}, 0)


def test_seeds_without_a_partner_are_left_out() -> None:
    some = {k: v for k, v in scores([0.2, 0.4, 0.9]).items() if k != 1}
    change = gains.difference(some, scores([0.1, 5.0]))
    assert change is not None
    assert change["seeds"] == 1
    assert change["mean"] == pytest.approx(0.1)
    assert gains.difference({7: np.ones(3)}, scores([0.1])) is None


def test_ablations_are_shown_beside_the_paper() -> None:
    rows = {"default": {"ssim": scores([0.3, 0.4])}, "8 steps": {"ssim": scores([0.4, 0.5])}}
    text = gains.report({"high noisy": gains.compared(rows)}, "video", {}, 0)
    assert ".093/.630/.394/1.611" in text
    assert "missing" not in text
