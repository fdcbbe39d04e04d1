"""What of a measured camera is not per pixel, in camera.npz."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from evflow.camera import Camera, Summary
from evflow.camera.leak import without_leak
from evflow.camera.optics import (
    Optics,
    as_arrays,
    read_sensor,
    read_shared,
    read_summary,
    read_undetermined,
    summary_arrays,
)
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError


@pytest.mark.parametrize("log_map", ["linlog", "log_eps"])
@pytest.mark.parametrize("by_light", [True, False])
def test_it_is_read_as_it_was_written(
    by_light: bool, log_map: Literal["linlog", "log_eps"], tmp_path: Path
) -> None:
    sensor = SensorModel(cutoff_hz=150.0, cutoff_by_light=by_light, refractory_s=2e-3, leak_hz=0.1,
                         shot_hz=2.0, shot_eta_hz=0.7, log_map=log_map, eta_is_all=True,
                         noise_resets_memory=True)
    optics = Optics(20.0, 1e-3, 4.0, 5e-4, 0.012, 3e-3)
    path = tmp_path / "camera.npz"
    Camera.constant((4, 5)).save(path, **as_arrays(sensor, {"cutoff_hz": 30.0}, optics))
    assert read_sensor(path) == (sensor, optics)
    assert float(np.load(path)["sensor_cutoff_hz_std"]) == 30.0


def test_what_shot_noise_refers_to_is_that_of_the_summary_in_older_files(tmp_path: Path) -> None:
    sensor, path = SensorModel(shot_hz=2.0, leak_hz=0.1), tmp_path / "camera.npz"
    summary = Summary(*np.array([0.2, 0.3, 0.5, 0.4, 0.0, 0.0]))
    arrays = as_arrays(sensor, {}, Optics()) | summary_arrays(summary, summary)
    del arrays["sensor_shot_eta_hz"]
    Camera.constant((4, 5)).save(path, **arrays)
    expected = 0.5 * (float(without_leak(np.float64(0.5), 0.4, 0.1)) + 0.4)
    assert read_sensor(path)[0].shot_eta_hz == pytest.approx(expected)


@pytest.mark.parametrize("law", ["keeps", "drops", "resets"])
def test_what_becomes_of_contrast_in_the_dead_time_is_read_as_written(
    law: Literal["keeps", "drops", "resets"], tmp_path: Path
) -> None:
    path, sensor = tmp_path / "camera.npz", SensorModel(refractory_s=2e-3, dead_contrast=law)
    Camera.constant((4, 5)).save(path, **as_arrays(sensor, {}, Optics()))
    assert read_sensor(path)[0].in_dead_time == law


@pytest.mark.parametrize("number", [3.0, -1.0, 0.5])
def test_an_unknown_loss_of_contrast_is_refused(number: float, tmp_path: Path) -> None:
    Camera.constant((4, 5)).save(tmp_path / "camera.npz", sensor_dead_contrast=np.float64(number))
    with pytest.raises(EvflowDataError, match=r"EV009.*sensor_dead_contrast is .*resets"):
        read_sensor(tmp_path / "camera.npz")


def test_a_camera_without_any_has_an_ideal_pixel(tmp_path: Path) -> None:
    Camera.constant((4, 5)).save(tmp_path / "camera.npz")
    sensor, optics = read_sensor(tmp_path / "camera.npz")
    assert sensor.cutoff_hz == sensor.refractory_s == optics.offset_dn == optics.delay_s == 0


def test_what_pixels_share_is_the_relative_error_of_the_summary(tmp_path: Path) -> None:
    path = tmp_path / "camera.npz"
    Camera.constant((4, 5)).save(path)
    assert read_shared(path) == {}
    values, std = (Summary(*map(np.float32, row)) for row in (
        (0.25, 0.5, 2, 0, 0.03, 0.03), (0.125, np.nan, 1, 0.1, 0.01, 0.01)))
    Camera.constant((4, 5)).save(path, overwrite=True, **summary_arrays(values, std))
    assert read_shared(path) == {"theta_on": 0.5, "eta_on": 0.5}


@pytest.mark.parametrize("value", [np.nan, np.zeros(2), "fast"])
def test_what_is_no_number_is_refused(tmp_path: Path, value: object) -> None:
    Camera.constant((4, 5)).save(tmp_path / "camera.npz", sensor_cutoff_hz=np.asarray(value))
    with pytest.raises(EvflowDataError, match=r"EV009.*sensor_cutoff_hz"):
        read_sensor(tmp_path / "camera.npz")
    for read in (read_sensor, read_summary, read_undetermined):
        with pytest.raises(EvflowDataError, match=r"EV016.*absent\.npz"):
            read(tmp_path / "absent.npz")
