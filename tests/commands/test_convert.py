"""evflow convert, voxel and export, and simulate into every format, end to end."""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path
from typing import Any, get_args

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.recordings import SIZE, T0, equal, make, write_ijrr
from helpers.videos import drifting

from evflow.camera import Camera, CameraPrior
from evflow.camera.exports import TARGETS, export_camera
from evflow.camera.exports.common import NOISE
from evflow.camera.exports.iebcs import FREQUENCIES, spectrum
from evflow.cli import main
from evflow.commands.writing import Format
from evflow.io import read_events, read_recording, write_recording
from evflow.io.registry import WRITERS
from evflow.light.log_maps import delta_log_intensity
from evflow.recordings import plan_windows
from evflow.types import Events, Recording
from evflow.voxel import voxelize


def run(capsys: pytest.CaptureFixture[str], *command: object) -> tuple[int, str, str]:
    code = main([str(word) for word in command])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    write_recording(tmp_path / "flight.h5", make(3000))
    return tmp_path / "flight.h5"


def test_formats_of_the_command_line_are_those_of_the_library() -> None:
    assert set(get_args(Format)) == {"auto", *WRITERS}


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "folder", "a.zip", "a.aedat4"])
def test_convert_there_and_back(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    if name == "a.aedat4":
        pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    code, out, err = run(capsys, "convert", flight, tmp_path / name, "--json")
    assert code == 0
    facts = json.loads(out)
    got, want = read_recording(tmp_path / name), make(3000)
    equal(got.events, want.events)
    assert facts["events"] == 3000
    assert facts["frames"] == len(got.frames) == (0 if name == "a.zip" else 6)
    if name == "a.zip":
        assert "holds events only: the 6 frames were left out" in err
        assert [note["text"] for note in facts["notes"]] == [err.removeprefix("note: ").strip()]
    assert run(capsys, "convert", tmp_path / name, flight, "--overwrite")[0] == 0
    equal(read_events(flight), want.events)


def test_convert_a_part_as_another_format(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "part.h5"
    code, text, _ = run(capsys, "convert", flight, out, "--format", "event_utils", "--start",
                        "0.1", "--stop", "0.2", "--polarity", "invert")
    assert code == 0
    assert "(event_utils)" in text
    events = make(3000).events
    first = int(events.t[0])
    want = events.slice(first + 100_000, first + 200_000)
    got = read_recording(out)
    np.testing.assert_array_equal(got.events.t, want.t)
    np.testing.assert_array_equal(got.events.p, ~want.p)
    assert len(got.frames) == 2


def test_frames_that_a_format_cannot_hold_are_left_out_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "deep.h5", make(50, dtype=np.uint16))
    code, _, err = run(capsys, "convert", tmp_path / "deep.h5", tmp_path / "a.aedat4")
    assert code == 0
    assert "aedat4 holds frames of uint8, not uint16: the 6 frames were left out" in err


def test_convert_errors(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Recording.of_events(Events([1], [1], [-5], [1], SIZE))
    write_recording(tmp_path / "before.npz", before)
    (tmp_path / "there.npz").write_text("dear to me")
    for code, command in (
        ("EV020", [flight, tmp_path / "a.csv"]),
        ("EV016", [tmp_path / "no.h5", tmp_path / "a.npz"]),
        ("EV013", [flight, tmp_path / "there.npz"]),
        ("EV001", [flight, tmp_path / "a.npz", "--start", "9"]),
        ("EV003", [tmp_path / "before.npz", tmp_path / "a.zip"]),
        ("EV003", [tmp_path / "before.npz", tmp_path / "a.aedat4"]),
    ):
        status, _, err = run(capsys, "convert", *command)
        assert status == (2 if code == "EV020" else 1)
        assert err.splitlines()[-1].startswith(code)
        assert "Traceback" not in err
    assert not list(tmp_path.glob("*a.*"))
    assert (tmp_path / "there.npz").read_text() == "dear to me"


@pytest.mark.parametrize("verb", ["convert", "voxel", "simulate", "link"])
def test_what_is_read_is_never_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    source = out = tmp_path / "only.npz"
    write_recording(source, make(3000))
    if verb == "link":
        verb, out = "convert", tmp_path / "other.npz"
        out.symlink_to(source)
    before = source.read_bytes()
    target = [out] if verb == "convert" else ["-o", out]
    status, _, err = run(capsys, verb, source, *target, "--overwrite")
    assert status == 2
    assert "EV020" in err
    assert "is what is read" in err
    assert source.read_bytes() == before


def test_parts_of_what_is_read_are_never_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, times = tmp_path / "ijrr", tmp_path / "times.txt"
    write_ijrr(folder, make(300))
    times.write_text("\n".join(str(0.05 * i) for i in range(6)))
    before = {path: path.read_bytes() for path in (folder / "events.txt", times)}
    for command in (["convert", folder, folder / "events.txt"],
                    ["simulate", folder / "images", "--timestamps", times, "-o", times]):
        status, _, err = run(capsys, *command, "--overwrite")
        assert status == 2
        assert "is what is read" in err
    assert before == {path: path.read_bytes() for path in before}


@pytest.mark.parametrize("name", ["a.h5", "a.npz", "folder", "a.zip", "a.aedat4"])
def test_simulate_into_any_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """The same events in each, and the video's frames where they are asked for."""
    if name == "a.aedat4":
        pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    frames = drifting(8, (24, 32)).astype(np.uint8)
    np.save(tmp_path / "video.npy", frames)
    command = ["simulate", tmp_path / "video.npy", "--fps", "100", "--json"]
    assert run(capsys, *command, "-o", tmp_path / "want.h5")[0] == 0
    want = read_recording(tmp_path / "want.h5")
    assert len(want.events) > 100
    assert not want.has_frames
    out = tmp_path / "out" / name
    code, text, err = run(capsys, *command, "-o", out, "--frames-too")
    if name == "a.zip":
        assert code == 2
        assert "EV020" in err
        assert list(out.parent.iterdir()) == []
        assert run(capsys, *command, "-o", out)[0] == 0
        equal(read_events(out), want.events)
        return
    assert code == 0
    got = read_recording(out)
    equal(got.events, want.events)
    assert json.loads(text)["frames"] == 8
    np.testing.assert_array_equal(got.frames, frames)
    np.testing.assert_array_equal(got.frame_times, 10_000 * np.arange(8))


def test_simulate_refuses_an_unknown_extension(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "video.npy", drifting(4, (24, 32)))
    command = ["simulate", tmp_path / "video.npy", "--fps", "100"]
    code, _, err = run(capsys, *command, "-o", tmp_path / "a.raw")
    assert code == 2
    assert "EV020" in err
    code, _, _ = run(capsys, *command, "-o", tmp_path / "a.raw", "--format", "npz")
    assert code == 0
    assert len(read_events(tmp_path / "a.raw")) > 0


def covered() -> Recording:
    """Events that span six frames, 50 ms apart."""
    recording = make(3000)
    return Recording(recording.events, recording.frames, recording.frame_times + 9_000)


def test_voxels_of_windows_between_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = covered()
    write_recording(tmp_path / "a.npz", recording)
    code, text, _ = run(capsys, "voxel", tmp_path / "a.npz", "-o", tmp_path / "v.npz",
                        "--bins", "5", "--window-ms", "60")
    assert code == 0
    pairs = plan_windows(recording, 60_000).pairs
    assert len(pairs) == 2
    assert "2 windows" in text
    with np.load(tmp_path / "v.npz") as data:
        assert data["voxels"].shape == (2, 48, 64, 10)
        assert data["voxels"].dtype == data["dlogI"].dtype == np.float32
        for i, (first, last) in enumerate(pairs):
            t0, t1 = recording.frame_times[[first, last]]
            assert (data["t0_us"][i], data["window_us"][i]) == (t0, t1 - t0)
            np.testing.assert_array_equal(
                data["voxels"][i], voxelize(recording.events, t0, t1 - t0, 5))
            np.testing.assert_array_equal(data["dlogI"][i], delta_log_intensity(
                recording.frame_dn(first), recording.frame_dn(last)))


def test_voxels_without_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every event but those of the last, unfinished window is in exactly one grid."""
    events = make(3000).events
    write_recording(tmp_path / "a.npz", Recording.of_events(events))
    code, _, err = run(capsys, "voxel", tmp_path / "a.npz", "-o", tmp_path / "v.npz")
    assert code == 0
    assert "without dlogI" in err
    first = int(events.t[0])
    with np.load(tmp_path / "v.npz") as data:
        assert set(data) == {"voxels", "t0_us", "window_us"}
        assert data["t0_us"].tolist() == [first + 40_000 * i for i in range(7)]
        count = len(events.slice(first, first + 280_000))
        assert data["voxels"].sum(dtype=float) == pytest.approx(count, abs=0.01)


def test_voxel_errors(tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_recording(tmp_path / "bare.npz", Recording.of_events(make(50).events))
    write_recording(tmp_path / "none.npz", Recording.of_events(Events([], [], [], [], SIZE)))
    for code, command in (
        ("EV020", [flight, "--bins", "1"]), ("EV020", [flight, "--window-ms", "0"]),
        ("EV020", [flight, "--window-ms", "nan"]), ("EV017", [flight, "--window-ms", "900"]),
        ("EV017", [tmp_path / "bare.npz", "--window-ms", "900"]),
        ("EV001", [tmp_path / "none.npz"]),
    ):
        status, _, err = run(capsys, "voxel", *command, "-o", tmp_path / "v.npz")
        assert status == (2 if code == "EV020" else 1)
        assert err.splitlines()[-1].startswith(code), err
    assert not list(tmp_path.glob("*v.npz*"))


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    drawn = Camera.sample(jax.random.key(0), (48, 64), CameraPrior(
        (0.2, 0.3), (0.03, 0.03), noise="independent", eta_spread=0.3))
    return drawn.save(tmp_path / "camera.npz")


@pytest.mark.parametrize("to", ["v2e", "esim", "openeb", "iebcs"])
def test_export_has_maps_scripts_and_words(
    tmp_path: Path, camera: Path, capsys: pytest.CaptureFixture[str], to: str
) -> None:
    out = tmp_path / "there"
    code, text, _ = run(capsys, "export", camera, "--to", to, "-o", out)
    assert code == 0
    readme = (out / "README.txt").read_text()
    assert readme in text
    assert "cannot represent" in readme
    assert (out / f"run_{to}.py").is_file()
    known = Camera.load(camera)
    with np.load(out / "maps.npz") as maps:
        for name, values in maps.items():
            np.testing.assert_array_equal(values, getattr(known, name))
            assert values.dtype == np.float32
    assert f"{np.median(known.theta_on):.4f}" in readme
    for script in out.glob("*.py"):
        compile(script.read_text(), str(script), "exec")
    assert run(capsys, "export", camera, "--to", to, "-o", out)[0] == 1
    for other in ("iebcs", to):  # what another simulator was given goes
        assert run(capsys, "export", camera, "--to", other, "-o", out, "--overwrite")[0] == 0
    assert (out / "noise_pos.npy").exists() == (to == "iebcs")


def test_the_spread_is_that_of_the_camera_not_of_its_estimates() -> None:
    """Half of what makes pixels differ is in the maps, half in their errors."""
    true = Camera.sample(jax.random.key(0), (60, 80), CameraPrior(mismatch=(0.05, 0.05)))
    middle = jax.tree.map(lambda m: jnp.full_like(m, jnp.median(m)), true)
    maps = jax.tree.map(lambda m, mid: mid + (m - mid) * 0.5**0.5, true, middle)
    std = jax.tree.map(lambda m: jnp.full_like(m, 0.05 * 0.5**0.5), true)
    words = export_camera(maps, "v2e", std)[0].text.split()
    assert float(words[words.index("--sigma_thres") + 1]) == pytest.approx(0.05, rel=0.05)


def test_scalars_are_the_nearest(camera: Path) -> None:
    export, _ = export_camera(Camera.load(camera), "v2e")
    words = export.text.split()
    given = {n: float(words[words.index(f"--{n}") + 1]) for n in (
        "pos_thres", "neg_thres", "sigma_thres", "leak_rate_hz", "shot_noise_rate_hz")}
    known = {n: np.asarray(v) for n, v in vars(Camera.load(camera)).items()}
    assert given["sigma_thres"] == pytest.approx(0.03, rel=0.05)
    assert given["pos_thres"] == pytest.approx(np.median(known["theta_on"]), abs=1e-4)
    # what v2e then makes at 128 DN: shot noise by halves, and leak of ON
    half = given["shot_noise_rate_hz"] / 2 * (1 - 0.75 * 148 / 275)
    on, off = np.median(known["eta_on"]), np.median(known["eta_off"])
    assert 2 * half + given["leak_rate_hz"] == pytest.approx(on + off, rel=1e-2)


def test_v2e_script_replaces_what_v2e_draws(
    tmp_path: Path, camera: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run with an emulator that only remembers, in the shape of v2e's."""
    seen: list[Any] = []

    class EventEmulator:
        def __init__(self, **options: Any) -> None:
            seen.append(options)

        def generate_events(self, frame: np.ndarray, t: float) -> np.ndarray | None:
            seen.append((frame.shape, t, dict(vars(self))))
            return None if t == 0 else np.ones((3, 4), np.float32)

    for name, module in (("torch", types.SimpleNamespace(tensor=np.asarray)),
                         ("v2ecore", types.ModuleType("v2ecore")),
                         ("v2ecore.emulator", types.SimpleNamespace(EventEmulator=EventEmulator))):
        monkeypatch.setitem(sys.modules, name, module)
    assert run(capsys, "export", camera, "--to", "v2e", "-o", tmp_path / "x")[0] == 0
    video = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 50, SIZE)
    for i in range(3):
        video.write(np.full((48, 64, 3), 60 * i, np.uint8))
    video.release()
    script = tmp_path / "x" / "run_v2e.py"
    words = ["run", str(tmp_path / "a.avi"), "50", str(tmp_path / "e.npy")]
    monkeypatch.setattr(sys, "argv", words)
    exec(compile(script.read_text(), str(script), "exec"), {"__file__": str(script)})
    options, first, second, _ = seen
    known = Camera.load(camera)
    assert first == ((48, 64), 0.0, {})
    assert second[1] == pytest.approx(0.02)
    for theirs, ours in (("pos_thres", "theta_on"), ("neg_thres", "theta_off"),
                         ("pos_thres_pre_prob", "eta_on"), ("neg_thres_pre_prob", "eta_off")):
        np.testing.assert_array_equal(second[2][theirs], getattr(known, ours))
    assert options["shot_noise_rate_hz"] / 2 * (1 - 0.75 * 148 / 275) == pytest.approx(1, rel=1e-4)
    assert np.load(tmp_path / "e.npy").shape == (6, 4)


def test_noise_that_is_added_has_the_measured_rates() -> None:
    home: dict[str, Any] = {}
    exec(NOISE, home)
    maps = {"eta_on": np.full((20, 30), 2.0), "eta_off": np.zeros((20, 30))}
    maps["eta_on"][:10] = 0.5
    x, y, t, p = home["add_noise"](
        np.array([3, 4]), np.array([5, 6]), np.array([T0 + 10, T0 + 1000]), np.array([0, 0]), maps,
        T0, T0 + 10_000_000)
    assert (np.diff(t) >= 0).all()
    assert T0 <= t[0] < t[-1] < T0 + 10_000_000
    assert (p == 0).sum() == 2
    assert (x[p == 0].tolist(), y[p == 0].tolist()) == ([3, 4], [5, 6])
    for rows, rate in (((y < 10) & (p == 1), 0.5), ((y >= 10) & (p == 1), 2.0)):
        expected = rate * 10 * 300
        assert abs(rows.sum() - expected) < 5 * expected**0.5
    assert x.max() < 30
    nothing = [np.zeros(0, np.int64)] * 4  # a scene at rest sends noise alone
    assert len(home["add_noise"](*nothing, maps, 0, 10_000_000)[2]) == pytest.approx(7500, rel=0.1)


def test_iebcs_spectra_have_the_measured_rates() -> None:
    """Drawn as IEBCS draws: the first bin whose cumulative share reaches a uniform number."""
    rates = np.array([[0.02, 0.3, 5.0]], np.float32)
    table = spectrum(rates)
    assert table.shape == (1, 3, 72)
    u = np.random.default_rng(0).random(20_000)
    for rate, share in zip(rates[0], table[0], strict=True):
        assert (share[-2:] == [1, 0]).all()
        assert (np.diff(share[:-1]) >= 0).all()
        interval = 1 / FREQUENCIES[np.searchsorted(share[:-1], u)]
        assert interval.mean() == pytest.approx(1 / rate, rel=0.05)


def test_export_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    several = Camera.constant((2, 4, 4))
    several.save(tmp_path / "two.npz")
    code, _, err = run(capsys, "export", tmp_path / "two.npz", "--to", "v2e", "-o", tmp_path / "x")
    assert (code, err[:5]) == (1, "EV002")
    code, _, err = run(capsys, "export", tmp_path / "no.npz", "--to", "v2e", "-o", tmp_path / "x")
    assert (code, err[:5]) == (1, "EV016")
    assert not (tmp_path / "x").exists()
    assert set(TARGETS) == {"v2e", "esim", "openeb", "iebcs"}
    from evflow.errors import EvflowDataError

    with pytest.raises(EvflowDataError, match="EV020"):
        export_camera(Camera.constant((4, 4)), "airsim")


@pytest.mark.parametrize("verb", ["convert", "voxel", "export"])
def test_help_has_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([verb, "--help"])
    assert caught.value.code == 0
    assert f"Example: evflow {verb}" in " ".join(capsys.readouterr().out.split())
