"""What a type checker sees of the public API: mypy on a small user's file, run once."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import evflow

ROOT = Path(evflow.__file__).parents[1]
START = """
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

import evflow as ef

key = jax.random.key(0)
frames, times_us = np.zeros((3, 4, 4), np.uint8), np.arange(3) * 1000
log_frames, voxels, dlogI = np.zeros((3, 4, 4)), np.zeros((4, 4, 32)), np.zeros((4, 4))
recording = ef.read_recording("flight.h5", stop_s=1.0, size=(346, 260))
events, camera, model = recording.events, ef.Camera.load("camera.npz"), ef.SensorModel()
params = ef.load_weights()
stats = ef.summarize(params, voxels, dlogI, window_s=0.05, intensity=dlogI)
summary = ef.finish(params, stats)[0]
code = ef.encode(params, voxels, dlogI, summary=summary)
found = ef.estimate_camera(recording, params, refine="off")
report = ef.check("flight.h5", partial=True)
noise = ef.read_noise_histogram("noise.npy")
writer = ef.open_writer("out.h5", events.size)
"""
# An expression of the user, and its type without the modules; "ndarray" is one of any dtype.
TYPES = {
    # files
    "recording": "Recording",
    "recording.events": "Events",
    "recording.frames": "ndarray",
    "ef.Recording(events, frames, times_us)": "Recording",
    "ef.Events(times_us, times_us, times_us, times_us, (346, 260))": "Events",
    "events.slice(0, 10)": "Events",
    "events.size": "tuple[int, int]",
    'ef.read_events("flight.h5", time_unit="us")': "Events",
    "ef.iter_windows(recording)": "Iterator[Window]",
    "next(ef.iter_windows(recording)).window_s": "float",
    "ef.Window(events, dlogI, dlogI, 0, 1, 0).events": "Events",
    'ef.linearised(recording, "srgb")': "Recording",
    'ef.write_events("out.h5", events)': "None",
    'ef.write_recording("out.h5", recording)': "None",
    "writer": "EventWriter",
    "writer.append(events)": "None",
    # checks and errors
    "report": "Report",
    "ef.Report(report.errors).strict()": "Report",
    "report.errors": "tuple[Finding, ...]",
    'ef.Finding("EV001", "error", "seen").error()': "EvflowDataError",
    'ef.EvflowDataError("EV001", "seen").code': "str",
    "report.as_dict()": "dict[str, list[dict[str, str]]]",
    # the camera
    "camera": "Camera",
    "camera.theta_on": "Array",
    "ef.Camera.constant((4, 4), theta_on=0.3)": "Camera",
    "ef.Camera.sample(key, (4, 4), ef.CameraPrior(noise='none'))": "Camera",
    'camera.save("camera.npz", mask=voxels)': "Path",
    "ef.with_faults(key, camera)": "Camera",
    "noise": "NoiseHistogram",
    "ef.with_noise_histogram(key, camera, noise, noise)": "Camera",
    "model": "SensorModel",
    'ef.SENSORS["v2e"]': "KnownSensor",
    'ef.SENSORS["v2e"].model': "SensorModel",
    "ef.CameraPrior().theta": "tuple[float, float]",
    # simulation
    "ef.simulate(key, frames, times_us, camera, model=model)": "Events",
    "ef.simulate(key, frames, times_us, camera, labels=True)": "tuple[Events, ndarray]",
    "ef.simulate_stream(key, frames, times_us, camera)": "Iterator[Events]",
    "ef.simulate_stream(key, frames, [0, 1, 2], camera, labels=True)":
        "Iterator[tuple[Events, ndarray]]",
    "ef.simulate_voxels(key, log_frames, camera, frame_dt_s=1e-3)": "Array",
    "ef.simulate_counts(key, log_frames, camera, frame_dt_s=1e-3)": "Array",
    "ef.compare(events, events)": "dict[str, Any]",
    # arrays and the network
    "ef.voxelize(events, 0, 50_000)": "ndarray",
    "ef.delta_log_intensity(frames[0], frames[1])": "Array",
    "params": "dict[str, Any]",
    'ef.save_weights("mine.safetensors", params, {})': "Path",
    "ef.estimate(params, voxels, dlogI, window_s=0.05)": "Camera",
    "ef.estimate_with_std(params, voxels, dlogI)": "tuple[Camera, Camera]",
    "stats + stats": "Stats",
    "ef.Stats": "def (active: Array, rates: Array, normal: Array, balance: Array, pixels: Array, "
                "pixels_active: Array, exposure: Array, events_on: Array, events_off: Array) "
                "-> Stats",
    "ef.finish(params, stats)": "tuple[Summary, Summary]",
    "ef.finish(params, sum(ef.summarize(params, v, d) for v, d in [(voxels, dlogI)]))":
        "tuple[Summary, Summary]",
    "ef.Summary(*6 * (jax.numpy.zeros(()),)).sigma_on": "Array",
    "code": "Code",
    "ef.Code(code.changes, code.summary, code.context).summary": "Summary",
    "ef.code_from_video(params, voxels, camera)": "Code",
    "ef.forward(params, voxels, code)": "tuple[Array, Array, Array]",
    "ef.inverse(params, voxels, voxels, code)": "Array",
    "ef.generate(params, key, camera, code)": "Array",
    "ef.log_prob(params, voxels, code)": "Array",
    "ef.squash(voxels)": "Camera",
    "ef.unsquash(camera)": "Array",
    # estimates
    "found": "CameraEstimate",
    "found.camera": "Camera",
    "found.std": "Camera",
    "found.summary": "Summary",
    "found.summary_std": "Summary",
    "found.valid": "ndarray",
    "found.n_events": "ndarray",
    "found.notes": "tuple[Note, ...]",
    "found.notes[0].code": "str",
    "found.undetermined": "tuple[str, ...]",
    "recording.notes": "tuple[Note, ...]",
    'found.save("camera.npz", overwrite=True)': "Path",
    'ef.estimate_camera("flight.h5").windows': "int",
    "isinstance(found, ef.CameraEstimate)": "bool",
    "ef.CameraEstimator().add(recording)": "int",
    "ef.CameraEstimator(params).estimate()": "CameraEstimate",
    'ef.write_report("report.html", found, recording)': "dict[str, Any]",
    "ef.__version__": "str",
}
MISTAKES = {  # what is wrong, and mypy's name for it
    "ef.estimate(1)": "call-arg",
    "ef.estimat(params, voxels, dlogI)": "attr-defined",
    "ef.estimate(params, voxels, dlogI, 0.05)": "call-arg",
    'ef.estimate(params, voxels, dlogI, window_s="50 ms")': "arg-type",
    "found.camara": "attr-defined",
    'ef.estimate_camera(recording, refine="none")': "arg-type",
    'ef.SensorModel(kind="v2")': "arg-type",
    "ef.CameraPrior(theta=0.2)": "arg-type",
    'ef.read_recording("flight.h5", start=1.0)': "call-arg",
    'ef.check("flight.h5", polarity=1)': "arg-type",
    "ef.simulate(key, frames, times_us, camera, True)": "call-overload",
    "ef.voxelize(recording, 0, 50_000)": "arg-type",
    "camera.theta_on = voxels": "misc",
}


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[int, list[str]]:
    """mypy's lines by the line of the user's file that they are about."""
    folder = tmp_path_factory.mktemp("typed")
    user = folder / "user.py"
    lines = [*START.splitlines(), *(f"reveal_type({e})" for e in TYPES), *MISTAKES]
    user.write_text("\n".join(lines) + "\n")
    # The project's own settings and cache: where `mypy` has run, little is left to do.
    # In a process of its own, which takes its millions of objects with it.
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml", "--cache-dir",
         ROOT / ".mypy_cache", "--no-pretty", user], capture_output=True, text=True, check=False)
    assert not done.stderr
    found: dict[int, list[str]] = {}
    for line in done.stdout.splitlines():
        if about := re.match(r".*user\.py:(\d+): (.*)", line):
            found.setdefault(int(about[1]), []).append(about[2])
    return found


def test_public_names_have_their_types(said: dict[int, list[str]]) -> None:
    first = len(START.splitlines()) + 1
    assert not [lines for number, lines in said.items() if number < first]
    for number, (expression, expected) in enumerate(TYPES.items(), first):
        assert [short(line) for line in said[number]] == [expected], expression
        assert "Any" not in expected.replace("dict[str, Any]", ""), expression


def short(note: str) -> str:
    """The type that a note of mypy reveals, without modules."""
    found = re.fullmatch(r'note: Revealed type is "(.*)"', note)
    assert found, note
    named = re.sub(r"\b(?:\w+\.)+(?=\w)", "", found[1])
    return re.sub(r"ndarray\[tuple\[[^\]]*\], dtype\[\w*(?:\[\w*\])?\]\]", "ndarray", named)


def test_every_public_name_is_used() -> None:
    used = set(re.findall(r"\bef\.(\w+)", START + "\n".join(TYPES)))
    assert used == {*evflow.__all__, "__version__"}


def test_mistakes_are_errors(said: dict[int, list[str]]) -> None:
    first = len(START.splitlines()) + len(TYPES) + 1
    for number, (mistake, kind) in enumerate(MISTAKES.items(), first):
        assert any(line.startswith("error: ") and line.endswith(f"[{kind}]")
                   for line in said.get(number, [])), (mistake, said.get(number))


def test_dir_is_the_public_api() -> None:
    stub = (ROOT / "evflow" / "__init__.pyi").read_text()
    assert sorted(dir(evflow)) == sorted(re.findall(r"import \w+ as (\w+)", stub))
    assert (ROOT / "evflow" / "py.typed").is_file()
