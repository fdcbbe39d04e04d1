"""What users of other simulators look for in `evflow simulate`: the pixels' circuit, the sensor's
size, slow motion, saccades."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import drifting

from evflow import Camera, read_events, read_recording, simulate
from evflow.camera import Summary
from evflow.camera.optics import Optics, as_arrays, summary_arrays
from evflow.camera.sensors import SENSORS, SecondOrder, SensorModel
from evflow.cli import main
from evflow.commands.pixels import Pixels
from evflow.commands.simulate import Simulate
from evflow.errors import EvflowDataError
from evflow.io.source import open_frames
from evflow.simulator.constants import Constants
from evflow.simulator.sensor import start
from evflow.types import Events

Run = tuple[Events, dict[str, Any]]
BASE = ["--fps", "100", "--no-interpolate"]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    np.save(tmp_path / "v.npy", drifting(10, (24, 32)))
    return tmp_path / "v.npy"


def run(video: Path, *options: str, capsys: pytest.CaptureFixture[str]) -> Run:
    out = video.with_name("out.h5")
    assert main(["simulate", str(video), "-o", str(out), "--json", "--overwrite", *options]) == 0
    return read_events(out), json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(("cutoff", "rate", "told"), [
    ("100", "100", True), ("100", "2000", False), ("0", "100", False)])
def test_frames_too_far_apart_for_the_low_pass_are_told(
    video: Path, capsys: pytest.CaptureFixture[str], cutoff: str, rate: str, told: bool
) -> None:
    facts = run(video, "--fps", rate, "--no-interpolate", "--cutoff-hz", cutoff, capsys=capsys)[1]
    assert ("frames.coarse" in [note["code"] for note in facts["notes"]]) == told


@pytest.mark.parametrize(("frames", "options"), [
    (np.uint8(40) * (drifting(6, (24, 32)) > 99), []),
    ((4 * drifting(6, (24, 32))).astype(np.uint16), ["--full-scale", "65535"])])
def test_a_night_has_events(tmp_path: Path, capsys: pytest.CaptureFixture[str],
                            frames: np.ndarray, options: list[str]) -> None:
    """Images whose light stays below 8 DN; what floats may be was settled when they were read."""
    (tmp_path / "night").mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / "night" / f"{i}.png"), frame)
    events = run(tmp_path / "night", *BASE, *options, capsys=capsys)[0]
    assert len(events) > 20


def test_a_recording_whose_sensor_is_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as f:
        for name, values in (("t", [1000, 2000]), ("x", [3, 4]), ("y", [5, 6]), ("p", [0, 1])):
            f[name] = values
        f["images"], f["image_ts"] = drifting(3, (24, 32)).astype(np.uint8), [0, 1500, 3000]
    assert main(["simulate", str(path), "-o", str(tmp_path / "o.h5")]) == 1
    assert "evflow convert takes them" in capsys.readouterr().err
    whole = str(tmp_path / "whole.h5")
    assert main(["convert", str(path), whole, "--size", "32x24"]) == 0
    assert main(["simulate", whole, "-o", str(tmp_path / "o.h5")]) == 0


def test_the_circuit_from_the_command_line() -> None:
    """Each option is that field of the sensor's model, and no other."""
    told = {"cutoff_hz": 80.0, "refractory_s": 0.002, "leak_hz": 0.5, "leak_jitter": 0.2,
            "leak_fpn_decades": 0.3, "shot_hz": 4.0}
    for name, number in told.items():
        model = Pixels(sensor="noisy", **{name: number}).model()
        assert getattr(model, name) == number
        for other in set(told) - {name}:
            assert getattr(model, other) == getattr(SENSORS["noisy"].model, other)
    assert Pixels().model().cutoff_hz == 0


def test_what_becomes_of_contrast_in_the_dead_time(tmp_path: Path) -> None:
    """As told, else as the camera was measured, else the sensor's own."""
    dead = {"refractory_s": 0.002}
    for options, law in (({}, "keeps"), ({"dead_contrast": "drops"}, "drops"),
                         ({"photoreceptor": "second-order"}, "resets"),
                         ({"sensor": "esim"}, "drops")):
        assert Pixels(**dead, **options).model().in_dead_time == law
    path = tmp_path / "camera.npz"
    measured = SensorModel(refractory_s=1e-3, cutoff_hz=90.0, dead_contrast="resets")
    Camera.constant((4, 5)).save(path, **as_arrays(measured, {}, Optics()))
    assert Pixels(camera=path).model().in_dead_time == "resets"
    assert Pixels(camera=path, dead_contrast="keeps").model().in_dead_time == "keeps"
    assert Pixels(camera=path, photoreceptor="second-order").model().in_dead_time == "resets"
    for wrong in ({"dead_contrast": "drops"}, {**dead, "dead_contrast": "keeps", "sensor": "esim"},
                  {**dead, "dead_contrast": "keeps", "photoreceptor": "second-order"}):
        with pytest.raises(EvflowDataError, match=r"EV020.*--dead-contrast"):
            Pixels(**wrong).model()


def test_a_photoreceptor_of_second_order_has_the_corner_of_the_first() -> None:
    for options, expected in (({}, SecondOrder()), ({"cutoff_hz": 80.0}, SecondOrder().at(80.0)),
                              ({"sensor": "noisy"}, SecondOrder().at(30.0))):
        pixels = Pixels(photoreceptor="second-order", **options)
        assert pixels.model().photoreceptor == expected
        assert pixels.model().cutoff_hz == pixels.seen_by(False).tau_s == 0
    assert Pixels().model().photoreceptor is None


def test_thresholds_that_differ_from_pixel_to_pixel() -> None:
    uneven = Pixels(theta_on=0.3, mismatch=0.04, eta_off=2.0).pixels((200, 100))
    for name, middle in (("theta_on", 0.3), ("theta_off", SENSORS["clean"].theta)):
        values = np.asarray(getattr(uneven, name))
        assert np.mean(values) == pytest.approx(middle, abs=0.002)
        assert np.std(values) == pytest.approx(0.04, rel=0.05)
    assert abs(np.corrcoef(np.ravel(uneven.theta_on), np.ravel(uneven.theta_off))[0, 1]) < 0.05
    assert float(np.median(uneven.eta_off)) == 2.0
    assert float(np.max(uneven.eta_on)) == 0.0


@pytest.mark.parametrize("mismatch", [None, 0.05])
def test_thresholds_are_drawn_apart_from_leak_and_noise(mismatch: float | None) -> None:
    """Correlations over 5,000 pixels: 4 standard deviations are .057."""
    options = Pixels(sensor="noisy", mismatch=mismatch, seed=3)
    camera, model = options.pixels((100, 50)), options.model()
    whole, _ = start(jax.random.key(options.seed), jnp.full((50, 100), 4.0), camera,
                     Constants.of(model), None)
    assert whole.leaking is not None
    pattern = np.log(whole.leaking / camera.theta_on.ravel())
    for theta in (camera.theta_on, camera.theta_off):
        for drawn in (pattern, whole.words.astype(jnp.float32)):
            assert abs(np.corrcoef(drawn, np.ravel(theta))[0, 1]) < 0.057


def test_a_drawn_camera_is_no_more_uneven_for_a_median_that_is_not_known(tmp_path: Path) -> None:
    path, shape = tmp_path / "camera.npz", (50, 60)
    values, errors = (Summary(*jnp.float32([theta, theta, eta, 0, sigma, sigma]))
                      for theta, eta, sigma in ((0.187, 0.1, 0.025), (0.187, 0.05, 0.02)))
    std = {"theta_on": np.hypot(0.187, 0.02), "theta_off": np.hypot(0.187, 0.02),
           "eta_on": 0.05, "eta_off": 0.0}
    Camera.constant(shape, 0.187, 0.187, 0.1).save(
        path, **summary_arrays(values, errors),
        **{f"{name}_std": np.full(shape, value, np.float32) for name, value in std.items()})
    drawn = [Pixels(camera=path, draw=True, seed=i).pixels((60, 50)) for i in range(4)]
    for camera in drawn:
        for theta in (camera.theta_on, camera.theta_off):
            assert float(theta.std() / theta.mean()) == pytest.approx(0.107, rel=0.1)
        assert float(camera.eta_on.std()) == pytest.approx(0, abs=1e-4)
    medians = np.array([np.median(camera.theta_on) for camera in drawn])
    assert np.ptp(np.log(medians)) > 0.2


def test_a_sensor_s_size_and_slow_motion(
    video: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, _ = run(video, *BASE, capsys=capsys)
    small, facts = run(video, *BASE, "--sensor-size", "16x12", "--slow-motion", "10", capsys=capsys)
    assert small.size == (16, 12)
    assert plain.t[-1] > 80_000 > 9_000 >= small.t[-1] > 8_000
    assert {"frames.laid", "frames.slowed"} <= {note["code"] for note in facts["notes"]}


def test_the_blur_of_an_exposure_is_taken_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a texture that moves by 8 px a frame, exposed for half of the frame interval, more events
    come back than the blur leaves; at most what the sharp video makes."""
    fine = drifting(81, (48, 64), speed=0.4)  # 20 pictures a frame
    means = [fine[k:k + 11].mean(0) for k in range(5, 70, 20)]
    counts = {}
    for name, frames, options in (("blurred", means, ()), ("sharp", fine[10:76:20], ()),
                                  ("mended", means, ("--exposure-ms", "20"))):
        np.save(tmp_path / "v.npy", np.stack(frames).astype(np.float32))
        events, facts = run(tmp_path / "v.npy", "--fps", "25", *options, capsys=capsys)
        counts[name] = len(events)
        codes = [note["code"] for note in facts["notes"]]
        assert ("frames.exposure" in codes) == bool(options)
    assert counts["blurred"] < 0.9 * counts["sharp"]
    assert abs(counts["mended"] / counts["sharp"] - 1) < 0.3 * (
        1 - counts["blurred"] / counts["sharp"])


def test_frames_that_are_written_keep_their_exposure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begin, path, out = 40_000 * np.arange(1, 5), tmp_path / "v.npz", tmp_path / "out.h5"
    np.savez(path, frames=drifting(4, (24, 32)).astype(np.float32),
             frame_times=np.stack([begin, begin + 8_001], 1))
    for options, exposure_us in (((), 8001), (("--slow-motion", "2"), 4000),
                                 (("--exposure-ms", "3.001"), 3001), (("--exposure-ms", "0"), 0)):
        facts = run(path, "--frames-too", *options, capsys=capsys)[1]
        assert read_recording(out).exposure_us == exposure_us
        said = [note["text"] for note in facts["notes"] if note["code"] == "frames.exposure"]
        assert len(said) == bool(exposure_us)
        assert all(f"exposed for {exposure_us / 1e3:g} ms" in text for text in said)
    facts = run(path, "--frames-too", "--no-interpolate", capsys=capsys)[1]
    assert read_recording(out).exposure_us == 8001
    assert all(note["code"] != "frames.exposure" for note in facts["notes"])  # it stays blurred


def test_a_picture_by_saccades(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each of the three moves is seen; at rest between them hardly anything is."""
    cv2.imwrite(str(tmp_path / "cat.png"), drifting(1, (24, 32))[0])
    events, facts = run(tmp_path / "cat.png", "--saccades", "4", capsys=capsys)
    assert "frames.swept" in {note["code"] for note in facts["notes"]}
    rates = np.histogram(events.t, 30, (0, 300_000))[0].reshape(3, 10)
    assert (rates.sum(1) > 100).all()
    assert (rates[:, [0, 9]].max(1) < 0.2 * rates.max(1)).all()
    part = run(tmp_path / "cat.png", "--saccades", "4", "--start", "0.1", "--stop", "0.2",
               capsys=capsys)[0].t
    assert 100_000 < part[0] < part[-1] < 200_000
    for option in (["--fps", "100"], ["--time-unit", "ms"], ["--start", "0.4"]):
        assert main(["simulate", str(tmp_path / "cat.png"), "-o", str(tmp_path / "a.h5"),
                     "--saccades", "4", *option])
        said = capsys.readouterr().err
        assert "EV020" in said if option[0] != "--start" else "They last 0.3 s" in said


@pytest.mark.parametrize("suffix", [".h5", ".npz"])
def test_noise_is_told_from_signal(video: Path, suffix: str) -> None:
    """As `simulate(labels=True)` tells it, in the order of the events."""
    out = video.with_name(f"out{suffix}")
    assert main(["simulate", str(video), "-o", str(out), *BASE, "--theta-on", "0.3", "--theta-off",
                 "0.3", "--eta-on", "20", "--labels"]) == 0
    camera = Camera.constant((24, 32), 0.3, 0.3, 20.0, 0.0)
    events, noise = simulate(
        jax.random.key(0), np.load(video), 10_000 * np.arange(10), camera,
        model=Pixels().model(), labels=True)
    if suffix == ".npz":
        labels = np.load(out)["noise"]
    else:
        with h5py.File(out) as f:
            labels = f["events/noise"][:].astype(bool)
    np.testing.assert_array_equal(labels, noise)
    assert [n.code for n in read_recording(out).notes if "labels" in n.text] == ["events.unread"]
    assert 0 < noise.sum() < len(noise)
    again = read_events(out)
    np.testing.assert_array_equal(again.t, events.t)


def test_a_film_beside_the_events(video: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = video.with_name("out.mp4")
    _, facts = run(video, *BASE, "--preview", str(film), capsys=capsys)
    assert "times slower than life" in facts["preview"]
    capture = cv2.VideoCapture(str(film))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 60  # two seconds of it
    capture.release()


def test_without_events_there_is_no_film(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    still, film = tmp_path / "still.npy", tmp_path / "out.mp4"
    np.save(still, np.full((6, 20, 30), 90, np.uint8))
    assert main(["simulate", str(still), "-o", str(tmp_path / "out.h5"), *BASE, "--preview",
                 str(film)]) == 0
    said = capsys.readouterr().err
    assert f"no events, so {film} is not made" in said
    assert "no pixel sent an event" in said
    assert not film.exists()


def test_events_outlive_a_film_that_is_interrupted(
    video: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("evflow.report.movie.write_film", interrupted)
    out, film = video.with_name("out.h5"), video.with_name("out.mp4")
    with pytest.raises(KeyboardInterrupt):
        Simulate(video=video, out=out, fps=100.0, interpolate=False, preview=film).run()
    told = capsys.readouterr().err
    assert f"{out} is complete. The film alone: evflow render {out} -o {film} --slow" in told
    assert len(read_events(out))


def test_frames_of_light_in_a_format_of_bytes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    for i, frame in enumerate(drifting(3, (24, 32))):
        cv2.imwrite(str(tmp_path / f"{i}.png"), frame)
    out = tmp_path / "out.aedat4"
    assert main(["simulate", str(tmp_path), "-o", str(out), *BASE, "--frames-too"]) == 0
    assert "rounded to 8 bits" in capsys.readouterr().err
    frames = read_recording(out).frames
    light = np.stack([f for f, _ in open_frames(tmp_path, fps=100, response="srgb").open()])
    np.testing.assert_array_equal(frames, np.rint(light))


@pytest.mark.parametrize(("options", "code"), [
    (["--labels", "--format", "event_utils"], "EV020"), (["--preview", "a.png"], "EV020"),
    (["--shot-hz", "-1"], "EV020"), (["--sensor", "esim", "--cutoff-hz", "30"], "EV020"),
    (["--mismatch", "-0.1"], "EV020"), (["--mismatch", "0.1", "--theta-on", "0"], "EV014"),
    (["--saccades", "5"], "EV020"), (["--crop", "99x9"], "EV020"),
    (["--slow-motion", "0"], "EV020"), (["--leak-jitter", "0.1"], "EV020"),
    (["--photoreceptor", "second-order", "--cutoff-hz", "0"], "EV020"),
    (["--photoreceptor", "second-order", "--sensor", "esim"], "EV020"),
    (["--photoreceptor", "second-order", "--no-cutoff-by-light"], "EV020"),
    (["--no-cutoff-by-light"], "EV020"),
    (["--sensor", "noisy", "--cutoff-hz", "0", "--no-cutoff-by-light"], "EV020")])
def test_options_out_of_range(
    video: Path, options: list[str], code: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", str(video), "-o", str(video.with_name("out.h5")), *BASE, *options])
    assert capsys.readouterr().err.startswith(code)


def test_parts_that_a_sensor_lacks_are_options_in_the_message(
    video: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["simulate", str(video), "-o", str(video.with_name("a.h5")), *BASE, "--sensor",
               "dvs346", "--cutoff-hz"]
    assert main([*command, "100"]) == 2
    said = capsys.readouterr().err
    assert "--cutoff-hz" in said
    assert "--sensor dvs346 has no such part; clean, noisy and v2e do" in said
    assert "SensorModel" not in said
    assert main([*command, "0"]) == 0


def test_the_law_of_a_cutoff_needs_one(video: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, law = video.with_name("out.npz"), "--no-cutoff-by-light"
    camera = Camera.constant((24, 32)).save(video.with_name("camera.npz"), sensor_cutoff_hz=40.0)
    simulate = ["simulate", str(video), "-o", str(out), "--overwrite", *BASE]
    events = []
    for options in (["--cutoff-hz", "20"], ["--cutoff-hz", "20", law]):
        assert main([*simulate, *options]) == 0
        events.append(len(read_events(out)))
    assert events[0] != events[1]
    assert main([*simulate, "--sensor", "noisy", law]) == 0
    assert main([*simulate, "--camera", str(camera), "--cutoff-hz", "20", law]) == 0
    for options, why in (([], "no cutoff without --cutoff-hz"),
                         (["--camera", str(camera)], "own cutoff keeps its measured law")):
        capsys.readouterr()
        assert main([*simulate, *options, law]) == 2
        assert why in capsys.readouterr().err


@pytest.mark.parametrize(("shape", "change", "code", "said"), [
    ((30, 40), {}, 1, "--sensor-size 40x30 to scale"),
    ((32, 24), {}, 1, "saved as (W, H)? Transpose them."),
    ((1, 24, 32), {}, 1, "Save one camera, of maps (H, W)"),
    ((24, 32), {"theta_on": np.nan}, 1, "not measured? Give them the median"),
    ((24, 32), {"theta_off": -0.2}, 1, "leave out the sign"),
    ((24, 32), {"theta_off": 0.0}, 1, "Clamp thresholds at 0.01"),
    ((24, 32), {"eta_on": -0.2}, 1, "finite and >= 0."),
    ((24, 32), {"theta_on": 20.0}, 0, "was it given in percent?"),
    ((24, 32), {"theta_on": 0.5}, 0, "")])
def test_cameras_that_others_made(
    video: Path, capsys: pytest.CaptureFixture[str], shape: tuple[int, ...],
    change: dict[str, float], code: int, said: str
) -> None:
    maps = {name: np.full(shape, change.get(name, 0.2)) for name in (
        "theta_on", "theta_off", "eta_on", "eta_off")}
    camera = video.with_name("camera.npz")
    np.savez(camera, **maps)
    out = video.with_name("out.npz")
    assert main(["simulate", str(video), *BASE, "--camera", str(camera), "-o", str(out)]) == code
    err = capsys.readouterr().err
    assert said in err
    assert ("percent" in err) == (said.endswith("percent?"))


def test_cameras_of_two_sizes_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(Camera.constant((4, n)).save(tmp_path / f"{n}.npz")) for n in (5, 6)]
    assert main(["compare", *paths]) == 0
    assert "(4, 5) and (4, 6)" in capsys.readouterr().err


@pytest.mark.parametrize(("sensor", "noise"), [
    ("esim", "adds no noise"), ("paper", "adds no noise"), ("dvs346", "own noise comes on top"),
    ("v2e", "leak and shot noise come on top"), ("clean", "")])
def test_what_a_sensor_takes_from_a_camera_is_told(
    video: Path, capsys: pytest.CaptureFixture[str], sensor: str, noise: str
) -> None:
    camera = Camera.constant((24, 32)).save(
        video.with_name("camera.npz"), sensor_cutoff_hz=155.0, sensor_refractory_s=1e-3)
    Pixels(camera=camera, sensor=sensor).pixels((32, 24))  # type: ignore[arg-type]
    said = capsys.readouterr().err
    assert noise in said
    assert ("(cutoff 155 Hz, dead time 1.00 ms) is replaced" in said) == bool(noise)
