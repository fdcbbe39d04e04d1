"""A sequence of a data set, its files, and what its users read."""

from __future__ import annotations

import dataclasses
import errno
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import CONFIG, assert_equal, refused, sequence

from evflow import dataset
from evflow.camera import PARAMETERS, CameraPrior
from evflow.dataset import (
    DatasetConfig,
    build,
    iter_sequences,
    make_sequence,
    read_sequence,
    sequence_paths,
    write_sequence,
)
from evflow.dataset.manifest import Manifests
from evflow.dataset.sequence import CAMERA
from evflow.dataset.store import SUFFIXES, _save
from evflow.io import read_recording
from evflow.recordings import iter_windows
from evflow.scenes.config import SceneConfig
from evflow.types import Events
from experiments import make_dataset

FORMATS = ("dsec", "npy")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set made in one process; read, never changed."""
    folder = tmp_path_factory.mktemp("whole")
    assert build(folder, CONFIG) == list(CONFIG.names)
    return folder


def test_events_are_sorted_inside_and_of_both_polarities(whole: Path) -> None:
    entries = Manifests.read(whole).claims
    for name, (entry,) in entries.items():
        s = read_sequence(whole / f"{name}.h5")
        assert (np.diff(s.events.t) >= 0).all()
        assert 0 <= s.events.t.min() <= s.events.t.max() < s.frame_times[-1] == 100_000
        assert entry["events_on"] == s.events.p.sum() > 0
        assert entry["events_off"] == (~s.events.p).sum() > 0
        assert sum(len(w.events) for w in iter_windows(s.recording)) == len(s.events)
    assert len(entries) == 6


def test_the_truth_is_consistent() -> None:
    s = sequence()
    intervals, (height, width) = CONFIG.intervals, CONFIG.shape
    assert s.frames.shape == (intervals + 1, height, width)
    assert s.flow.shape == (intervals, 2, height, width)
    assert s.frame_times.tolist() == [25_000 * i for i in range(intervals + 1)]
    # Frames are rounded and noisy: their own change is the true one, but for 0.8 DN (one sigma).
    bright = (s.frames > 40).all(0)
    assert bright.mean() > 0.2
    own = np.diff(np.log(np.maximum(s.frames, 1.0)), axis=0)
    assert (np.abs(own - s.changes) * s.frames[1:])[:, bright].max() < 6
    assert (np.abs(s.changes) * s.frames[1:])[:, bright].max() > 25
    for name in CAMERA:
        middle = float(np.median(s.camera[name]))
        assert middle == pytest.approx(s.nominal[name], abs=0.01)
    assert s.camera["theta_on"].std() == pytest.approx(s.nominal["sigma_on"], rel=0.15)
    assert CAMERA == PARAMETERS


def test_sequences_differ_and_follow_from_config_seed_and_number() -> None:
    assert_equal(make_sequence(CONFIG, 0, 0), sequence())
    # Neither more sequences nor a later test part change those before.
    assert_equal(make_sequence(dataclasses.replace(CONFIG, train=5, test=9), 0, 0), sequence())
    for other in (make_sequence(CONFIG, 1, 0), sequence(1)):
        assert not np.array_equal(other.frames, sequence().frames)
        assert other.nominal != sequence().nominal


def test_events_explain_the_changes() -> None:
    """Summed thresholds of a pixel's events are its intensity change, to less than one threshold
    at either end."""
    quiet = CameraPrior(theta=(0.04, 0.06), noise="none", mismatch=(0.0, 0.0))
    s = make_sequence(dataclasses.replace(CONFIG, prior=quiet), 0, 0)
    on, off = s.events.count_map().astype(np.float64)
    told = on * s.nominal["theta_on"] - off * s.nominal["theta_off"]
    change = s.changes.sum(0)
    bound = s.nominal["theta_on"] + s.nominal["theta_off"]
    assert np.abs(change).max() > 2 * bound
    assert np.abs(told - change).max() < bound + 1e-3


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("silent", [False, True])
def test_round_trip(tmp_path: Path, format: Any, silent: bool) -> None:
    s, none = sequence(), np.zeros(0, int)
    if silent:
        s = dataclasses.replace(s, events=Events(none, none, none, none, s.events.size))
    path = tmp_path / ("a.h5" if format == "dsec" else "a")
    by_columns = dataclasses.replace(
        s, camera={k: np.asfortranarray(v) for k, v in s.camera.items()})
    write_sequence(path, by_columns, format)
    back = read_sequence(path)
    assert_equal(back, s)
    back.flow[0] = 1.0  # the user's own copy
    assert_equal(read_sequence(path), s)
    with refused("EV013"):
        write_sequence(path, s, format)


def test_a_dsec_sequence_is_a_recording(whole: Path) -> None:
    recording, s = read_recording(whole / "train/00001.h5"), read_sequence(whole / "train/00001.h5")
    np.testing.assert_array_equal(recording.events.t, s.events.t)
    np.testing.assert_array_equal(recording.frames, s.frames)


def test_no_time_of_day_enters_a_file(tmp_path: Path) -> None:
    write_sequence(tmp_path / "a.h5", sequence(), "dsec")
    time.sleep(1.1)  # HDF5's clock counts seconds
    write_sequence(tmp_path / "b.h5", sequence(), "dsec")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_reading_needs_no_jax(whole: Path) -> None:
    program = f"""
import sys
from evflow.dataset import iter_sequences
assert sum(1 for s in iter_sequences({str(whole)!r}, "train") if s.flow.size) == 4
assert "jax" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_what_others_left_in_a_set_is_no_sequence(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    for name in ("README", "notes.txt", ".00001.part"):
        (tmp_path / "train" / name).write_text("hi")
    with refused("EV016"):
        sequence_paths(tmp_path)
    for i, format in enumerate(FORMATS):
        write_sequence(tmp_path / f"train/{i}{SUFFIXES[format]}", sequence(), format)
    assert [p.name for p in sequence_paths(tmp_path)] == ["0.h5", "1"]
    assert len(list(iter_sequences(tmp_path))) == 2


def test_sequences_are_listed_by_split(whole: Path, tmp_path: Path) -> None:
    assert [p.name for p in sequence_paths(whole, "test")] == ["00000.h5", "00001.h5"]
    assert_equal(next(iter_sequences(whole, "train")), sequence())
    with refused("EV016"):
        next(iter_sequences(tmp_path))
    with refused("EV020"):
        sequence_paths(whole, "validation")
    with refused("EV016"):
        read_sequence(whole / "train/00099.h5")
    assert {*dataset.__all__} >= {"build", "verify", "read_sequence"}
    with pytest.raises(AttributeError):
        _ = dataset.nothing


@pytest.mark.parametrize("format", FORMATS)
def test_damaged_sequences_are_refused(tmp_path: Path, format: Any) -> None:
    path = tmp_path / ("a.h5" if format == "dsec" else "a")
    write_sequence(path, sequence(), format)
    target = path if format == "dsec" else path / "flow.npy"
    target.write_bytes(target.read_bytes()[: target.stat().st_size // 2])
    with refused("EV009", target.name):
        read_sequence(path)
    if format == "npy":
        np.save(target, sequence().flow[1:])
        with refused("EV009", "a: flow is"):
            read_sequence(path)
        target.unlink()
        with refused("EV008", "flow"):
            read_sequence(path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_keeps_its_number() -> None:
    """numpy.save raises an OSError without errno for more than a buffer; so would we not know."""
    with pytest.raises(OSError, match="No space") as raised:
        _save(Path("/dev/full"), sequence().flow)
    assert raised.value.errno == errno.ENOSPC


def test_options_out_of_range(tmp_path: Path) -> None:
    for bad in ("4/4", "1", "a/b", "-1/4", "0/0"):
        with refused("EV020", "--shard"):
            make_dataset.parse_shard(bad)
    assert make_dataset.parse_shard("17/64") == (17, 64)
    for options in ({"shard": (2, 2)}, {"workers": 0}):
        with refused("EV020"):
            build(tmp_path, CONFIG, **options)  # type: ignore[arg-type]
    for change in ({"train": 0, "test": 0}, {"frame_hz": 30}, {"render_hz": 7}, {"seconds": 0.0},
                   {"seconds": float("nan")}, {"width": 4}, {"textures": 0, "photos": 0},
                   {"lead_s": -1.0}):
        with refused("EV020", next(iter(change))):
            dataclasses.replace(CONFIG, **change)
    assert (DatasetConfig().train, DatasetConfig().test) == (300, 30)


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = make_dataset.Options(tmp_path, "debug", test=0, train=2, seconds=0.05)
    assert make_dataset.main(options) == 0
    assert "2 sequences made" in capsys.readouterr().out
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert {"jax", "h5py", "scikit-image"} <= set(manifest["made_by"][0]["versions"])
    assert manifest["sequences"]["train/00001"]["duration_s"] == pytest.approx(0.05)
    check = dataclasses.replace(options, verify=True)
    assert make_dataset.main(check) == 0
    (tmp_path / "train/00001.h5").unlink()
    assert make_dataset.main(check) == 1
    assert "train/00001: 00001.h5 is missing" in capsys.readouterr().out


def test_scenes_of_the_night_are_simulated_as_they_are() -> None:
    """Whose frames look like fractions of white, which `simulate` otherwise refuses."""
    dark = SceneConfig(foregrounds=0, contrast=(0.1, 0.15), gamma=(8.0, 8.0),
                       brightness=(0.0, 0.02))
    found = make_sequence(dataclasses.replace(CONFIG, scene=dark), 0, 0)
    assert found.frames.max() <= 8
