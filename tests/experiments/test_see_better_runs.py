"""What `see_better` keeps in its folder is of the files and names of the command that goes on."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import recordings

from evflow.camera import Camera
from evflow.errors import EvflowDataError
from evflow.network.weights import save_weights
from experiments.shared import targets
from experiments.shared.conditions import Condition, Files, Workshop, conditions
from experiments.shared.same_runs import same_setting
from experiments.shared.scored_on import Recorded
from experiments.shared.see_better_settings import preset_of
from experiments.shared.trainings import Trainings, run_card

SHAPE = (24, 32)


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Trainings:
    """Trainings of one seed that are over at once."""
    def train(_: Trainings, condition: Condition, seed: int, path: Path) -> None:
        save_weights(path, {"a": np.ones(1)}, run_card(condition, None, seed=seed))

    monkeypatch.setattr(Trainings, "train", train)
    monkeypatch.setattr(Trainings, "score", lambda *_: {"ssim": np.ones(2)})
    return Trainings(dataclasses.replace(preset_of("video", "debug"), seeds=1), tmp_path)


def cameras(folder: Path) -> dict[str, Path]:
    """Two camera files."""
    return {name: Camera.constant(SHAPE, theta_on=theta).save(folder / f"{name}.npz")
            for name, theta in (("x", 0.2), ("y", 0.3))}


def workshop(folder: Path) -> Workshop:
    return Workshop(SHAPE, 4, folder, lambda _: recordings.make(), None)


def test_finished_runs_of_other_files_are_refused(runs: Trainings, tmp_path: Path) -> None:
    files, target = cameras(tmp_path), targets.target("high", "noisy", SHAPE)

    def go_on(path: Path, source: str = "") -> int:
        seen = dataclasses.replace(target, source=source)
        return runs.complete_all(conditions(
            workshop(tmp_path), [seen], (), Files(cameras={"a": path})), math.inf)

    assert go_on(files["x"]) == go_on(files["x"]) == 0
    with pytest.raises(EvflowDataError, match=r"EV013.*rests on another a\."):
        go_on(files["y"])
    with pytest.raises(EvflowDataError, match=r"EV013.*rests on another high noisy\."):
        go_on(files["x"], "another recording")
    (tmp_path / "runs/a/0/weights.safetensors").unlink()
    with pytest.raises(EvflowDataError, match=r"EV013.*rests on another a\."):
        go_on(files["y"])


@pytest.mark.parametrize(("names", "given", "seen"), [
    ((), ("my cam", "my_cam"), r"two conditions are called \['my cam', 'my_cam'\]"),
    ((), ("raw",), r"a file is called \['raw'\]"),
    ((), ("ecc_median",), r"a file is called \['ecc_median'\]"),
    (("evflow",), ("high noisy evflow",), "two runs are called")])
def test_names_that_would_share_a_folder_are_refused(
    names: tuple[str, ...], given: tuple[str, ...], seen: str, tmp_path: Path
) -> None:
    path, target = cameras(tmp_path)["x"], targets.target("high", "noisy", SHAPE)
    with pytest.raises(EvflowDataError, match=f"EV020.*{seen}"):
        conditions(workshop(tmp_path), [target], names, Files(cameras=dict.fromkeys(given, path)))


def test_targets_that_would_share_a_file_are_refused(tmp_path: Path) -> None:
    both = [Recorded(name, "", recordings.make()) for name in ("a b", "a_b")]
    with pytest.raises(EvflowDataError, match=r"EV020.*two targets"):
        conditions(workshop(tmp_path), both, ("default",))


def test_what_video_is_trained_by_is_part_of_the_setting(tmp_path: Path) -> None:
    small, full = (preset_of("video", preset) for preset in ("debug", "full"))
    for name, setting in (("small", small), ("full", full)):
        same_setting(tmp_path / name, "video", "default", setting, lpips=False)
    same_setting(tmp_path / "small", "video", "default", small, lpips=True)  # scored by it alone
    with pytest.raises(EvflowDataError, match=r"EV013.*lpips_in_loss"):
        same_setting(tmp_path / "full", "video", "default", full, lpips=True)
    path = tmp_path / "full" / "setting.json"
    older = json.loads(path.read_text())
    del older["config"]["lpips_in_loss"]
    path.write_text(json.dumps(older))
    same_setting(tmp_path / "full", "video", "default", full, lpips=True)


def test_a_measurement_is_that_of_its_recording(tmp_path: Path) -> None:
    one, other = (Recorded("real", source, recordings.make()) for source in ("one", "other"))

    def measure(_: Any) -> Camera:
        return Camera.constant(SHAPE)

    shop = workshop(tmp_path / "cameras")
    path = shop.kept(one, "s2r", measure, one.source)
    assert shop.kept(one, "s2r", measure, one.source) == path
    with pytest.raises(EvflowDataError, match=r"EV013.*another real or by another s2r"):
        shop.kept(other, "s2r", measure, other.source)
    path.with_suffix(".json").unlink()  # as it was before these were written
    assert shop.kept(other, "s2r", measure, other.source) == path
