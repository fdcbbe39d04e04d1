"""evflow export: maps, scripts and words for other simulators."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.recordings import SIZE, T0

from evflow.camera import Camera, CameraPrior
from evflow.camera.exports import TARGETS, export_camera
from evflow.camera.exports.common import LIGHT, NOISE
from evflow.camera.exports.iebcs import FREQUENCIES, spectrum
from evflow.camera.optics import Optics
from evflow.camera.sensors import DeadContrast, SensorModel
from evflow.cli import main
from evflow.io.source import open_frames
from evflow.light.response import linear_light
from evflow.simulator import simulate


def run(capsys: pytest.CaptureFixture[str], *command: object) -> tuple[int, str, str]:
    code = main([str(word) for word in command])
    printed = capsys.readouterr()
    return code, printed.out, printed.err



@pytest.fixture
def camera(tmp_path: Path) -> Path:
    drawn = Camera.sample(jax.random.key(0), (48, 64), CameraPrior(
        (0.2, 0.3), (0.03, 0.03), noise="independent", eta_spread=0.3))
    return drawn.save(tmp_path / "camera.npz")


@pytest.mark.parametrize("to", list(TARGETS))
def test_light_that_frames_do_not_show_is_told(to: str) -> None:
    camera = Camera.constant((4, 6))
    assert "DN more than" not in export_camera(camera, to)[0].text
    told = export_camera(camera, to, optics=Optics(18.7, 0.0, 4.6))[0].text
    assert told.rstrip().endswith("other videos do not need it.")
    assert "18.7 DN more than" in told


@pytest.mark.parametrize("to", list(TARGETS))
def test_a_prior_is_not_called_measured(to: str, tmp_path: Path) -> None:
    none, known = (export_camera(Camera.constant((4, 6)), to, undetermined=names)[0].text
                   for names in ((), ("theta_on", "theta_off")))
    assert known.startswith("NOT MEASURED: theta_on and theta_off")
    assert known.endswith(none)


@pytest.mark.parametrize("to", list(TARGETS))
def test_v2e_is_told_that_its_logarithm_is_another(to: str) -> None:
    told = [export_camera(Camera.constant((4, 6)), to, sensor=SensorModel(log_map=log_map))[0].text
            for log_map in ("linlog", "log_eps")]
    assert "logarithm is linear below 20 DN" not in told[0]
    assert ("logarithm is linear below 20 DN" in told[1]) == (to == "v2e")


@pytest.mark.parametrize("to", list(TARGETS))
def test_what_dead_time_and_shot_noise_lose_is_told(to: str) -> None:
    sensors = SensorModel(refractory_s=1e-3), SensorModel(shot_hz=1.5)
    told = [export_camera(Camera.constant((4, 6)), to, sensor=sensor)[0].text for sensor in sensors]
    assert ("within the dead time is lost" in told[0]) == (to != "v2e")
    assert "1.500 Hz in the dark" not in told[0]
    assert ("1.500 Hz in the dark" in told[1] and "light is\n  lost" in told[1]) == (to != "v2e")


@pytest.mark.parametrize("to", list(TARGETS))
def test_how_a_dead_time_differs_from_the_camera_is_told(to: str) -> None:
    """Of a camera that keeps contrast in it, drops its events, or begins anew at its end."""
    drops = "begin anew" if to == "iebcs" else "as by this camera's"
    for law, lost in (("keeps", "keep it for later"), ("drops", drops), ("resets", "begin anew")):
        sensor = SensorModel(refractory_s=1e-3, dead_contrast=law)
        told = export_camera(Camera.constant((4, 6)), to, sensor=sensor)[0].text
        kept = "dead time is kept for later" in told
        assert kept == (to == "v2e" and law != "keeps")
        assert (lost in told) == (to != "v2e")


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


def scalars(camera: Camera, **circuit: float) -> dict[str, float]:
    """The numbers on v2e's command line."""
    words = export_camera(camera, "v2e", sensor=SensorModel(**circuit))[0].text.split()
    return {name: float(words[words.index(f"--{name}") + 1]) for name in (
        "pos_thres", "neg_thres", "sigma_thres", "leak_rate_hz", "shot_noise_rate_hz")}


def test_scalars_are_the_nearest(camera: Path) -> None:
    given = scalars(Camera.load(camera))
    known = {n: np.asarray(v) for n, v in vars(Camera.load(camera)).items()}
    assert given["sigma_thres"] == pytest.approx(0.03, rel=0.05)
    assert given["pos_thres"] == pytest.approx(np.median(known["theta_on"]), abs=1e-4)


@pytest.mark.parametrize(("on", "off"), [(0.9, 0.3), (0.5, 0.4), (0.4, 0.0)])
def test_v2e_makes_the_measured_noise_of_its_scalars(on: float, off: float) -> None:
    """v2e's pixel at rest at 128 DN: its shot noise takes back what has leaked."""
    given = scalars(Camera.constant((4, 6), eta_on=on, eta_off=off))
    leak, shot = given["leak_rate_hz"], given["shot_noise_rate_hz"]
    frames, times = np.full((602, 40, 50), 128, np.float32), np.arange(602) * 100_000
    quiet = Camera.constant((40, 50), eta_on=0.0, eta_off=0.0)
    model = SensorModel(leak_hz=leak, shot_hz=shot, noise_resets_memory=True)
    p = simulate(jax.random.key(0), frames, times, quiet, model=model).p
    seen = np.array([p.sum(), (~p).sum()]) / (40 * 50 * 60.1)
    np.testing.assert_allclose(seen, (on, off), rtol=0.03)


@pytest.mark.parametrize(("circuit", "words"), [
    ({}, ["at 128 DN, that of maps.npz."]),
    ({"leak_hz": 0.8}, ["its sum is right at 128 DN, 0.2700 Hz of each", "was ON 0.3400 and",
                        "at 128 DN, that of maps.npz, ON without 0.5600"]),
    ({"shot_hz": 1.5}, ["it is as measured, 0.4473 Hz of each", "0.813 times that of maps.npz."])])
def test_v2e_is_told_which_noise_is_right(circuit: dict[str, float], words: list[str]) -> None:
    camera = Camera.constant((4, 6), eta_on=0.9, eta_off=0.2)
    text = " ".join(export_camera(camera, "v2e", sensor=SensorModel(**circuit))[0].text.split())
    assert [word for word in [*words, "at most one noise event"] if word not in text] == []


def test_openeb_is_given_no_rate_of_noise_that_it_does_not_make(camera: Path) -> None:
    export = export_camera(Camera.load(camera), "openeb")[0]
    words = export.text.split()
    assert words[words.index("--shot_noise_rate_hz") + 1] == "0"
    assert "add_noise.py" in export.scripts
    assert "the busiest pixel" in export.text


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


def test_the_table_of_the_scripts_is_that_of_evflow() -> None:
    names = {"np": np}
    exec(LIGHT, names)
    every = np.arange(256, dtype=np.uint8)[None]
    assert names["light_of"].dtype == np.float32
    np.testing.assert_allclose(names["light_of"], linear_light(every, "srgb")[0], rtol=2e-6)


class Remembers:
    """In the place of a simulator: keeps every frame that it is given."""

    def __init__(self) -> None:
        self.frames: list[np.ndarray] = []
        self.cur_th_pos, self.cur_th_neg = np.zeros((2, 48, 64))
        self.event_maker = types.SimpleNamespace()

    def __call__(self, *args: Any, **options: Any) -> Remembers:
        return self

    def given(self, frame: np.ndarray, *rest: Any) -> None:
        self.frames.append(np.array(frame))

    def get_events(self) -> np.ndarray:
        return np.zeros(0, [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "i2")])

    generate_events = image_callback = init_image = update = given
    set_shape = set_dvs_sensor = init_bgn_hist = increase_ev = write = __call__


@pytest.mark.parametrize("response", ["srgb", "linear"])
@pytest.mark.parametrize("to", ["v2e", "openeb", "iebcs"])
def test_scripts_see_the_light_that_evflow_sees(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: str, response: str
) -> None:
    video = str(tmp_path / "a.avi")
    film = cv2.VideoWriter(video, cv2.VideoWriter.fourcc(*"MJPG"), 50, SIZE)
    for image in np.random.default_rng(0).integers(0, 256, (3, 6, 8, 3), dtype=np.uint8):
        film.write(cv2.resize(image, SIZE))
    film.release()
    at = export_camera(Camera.constant((48, 64)), to)
    np.savez(tmp_path / "maps.npz", **at[1])
    fake = Remembers()
    noise = types.SimpleNamespace(add_noise=lambda x, y, t, p, *rest: (x, y, t, p))
    for name, module in {
            "torch": types.SimpleNamespace(tensor=np.asarray), "add_noise": noise,
            "v2ecore": types.ModuleType("v2ecore"),
            "v2ecore.emulator": types.SimpleNamespace(EventEmulator=fake),
            "metavision_core_ml": types.ModuleType("metavision_core_ml"),
            "metavision_core_ml.video_to_event": types.ModuleType("video_to_event"),
            "metavision_core_ml.video_to_event.simulator":
                types.SimpleNamespace(EventSimulator=fake),
            "dvs_sensor": types.SimpleNamespace(DvsSensor=fake),
            "event_buffer": types.SimpleNamespace(EventBuffer=fake)}.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "argv", ["run", video, "50", str(tmp_path / "out"),
                                      *(["--linear"] if response == "linear" else [])])
    exec(at[0].scripts[f"run_{to}.py"], {"__file__": str(tmp_path / f"run_{to}.py")})
    larger = export_camera(Camera.constant((60, 80)), to)[0].scripts[f"run_{to}.py"]
    with pytest.raises(SystemExit, match="64x48 pixels, the camera 80x60"):
        exec(larger, {"__file__": str(tmp_path / f"run_{to}.py")})
    seen = np.stack(fake.frames) / (1e4 / 255 if to == "iebcs" else 1)
    assert len(seen) == 3
    light = np.stack([frame for frame, _ in open_frames(video, fps=50, response=response).open()])
    # without a curve to undo evflow rounds luma to whole DN
    np.testing.assert_allclose(seen, light, rtol=1e-5, atol=0.51 if response == "linear" else 1e-4)


def test_images_for_esim_are_made_linear(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = export_camera(Camera.constant((4, 4)), "esim")[0].scripts["linear_images.py"]
    there, out = tmp_path / "images", tmp_path / "linear"
    there.mkdir()
    images = np.random.default_rng(0).integers(0, 256, (2, 16, 16, 3), dtype=np.uint8)
    for name, image in zip(("10.bmp", "2.png"), images, strict=True):
        cv2.imwrite(str(there / name), image)
    (there / "times.txt").write_text("0\n")
    monkeypatch.setattr(sys, "argv", ["linear", str(there), str(out)])
    exec(script, {})
    names = sorted(path.name for path in out.iterdir())  # as ESIM reads them
    light = [frame for frame, _ in open_frames(there, fps=50, response="srgb").open()]
    for name, want in zip(names, light, strict=True):
        found = cv2.imread(str(out / name), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(found, np.rint(want))


def test_esim_torch_is_given_the_folder_that_it_reads() -> None:
    """generate_events.py takes folders of exactly imgs/ and timestamps.txt."""
    text = export_camera(Camera.constant((4, 4)), "esim")[0].text
    for line in ("linear_images.py IMAGES FOLDER/imgs\n", "FOLDER/timestamps.txt\n", "-i FOLDER "):
        assert line in text
    assert "t in nanoseconds" in text


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


@pytest.mark.parametrize(("contrast", "said"), [
    ("drops", "This camera's drop the events"), ("resets", "as this camera's"),
    ("auto", "the pixels of v2e and")])
def test_iebcs_begins_anew_after_the_dead_time(contrast: DeadContrast, said: str) -> None:
    """Its pixels take the light at the end of their dead time into memory."""
    sensor = SensorModel(refractory_s=2e-3, dead_contrast=contrast)
    camera = Camera.sample(jax.random.key(0), (24, 32))
    assert said in export_camera(camera, "iebcs", sensor=sensor)[0].text
