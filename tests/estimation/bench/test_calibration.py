"""Bench calibration on simulated screens: steps of several sizes, rests, noise."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.benches import CYCLES, SHAPE, STAIRS, bench, cameras

from evflow import Recording
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.rests import find_rests, steps_of_light
from evflow.estimation.bench.steps import storing
from evflow.io import write_recording
from evflow.notes import texts
from evflow.types import Events


def errors(found, camera: Camera, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the valid pixels, and in units of the std."""
    off = np.asarray(getattr(found.camera, name)) - np.asarray(getattr(camera, name))
    return off[found.valid], (off / np.asarray(getattr(found.std, name)))[found.valid]


@pytest.mark.usefixtures("known_levels", "even_remainders")
@pytest.mark.parametrize("levels", [CYCLES, STAIRS, [25, 225, 25]], ids=["cycles", "stairs", "two"])
@pytest.mark.parametrize("mismatch", [0.03, 0.1])
def test_steps_tell_every_pixels_thresholds(levels: list[float], mismatch: float) -> None:
    """Unbiased to .003, each pixel within its std; the literal ratio is biased by .02 and more."""
    camera = cameras(mismatch)
    recording = bench(camera, levels)
    found = calibrate_step(recording, fresh=True)
    literal = calibrate_step(recording, literal=True)
    assert found.valid.mean() > 0.98
    for name in ("theta_on", "theta_off"):
        off, sigmas = errors(found, camera, name)
        assert abs(off.mean()) < 0.003
        assert np.abs(off).mean() < 0.015
        assert 0.7 < np.sqrt((sigmas**2).mean()) < 1.4
        assert errors(literal, camera, name)[0].mean() > 0.02
        true = np.median(getattr(camera, name))
        assert float(getattr(found.summary, name)) == pytest.approx(true, abs=0.012)
        spread = float(getattr(found.summary, f"sigma_{name[6:]}"))
        assert spread == pytest.approx(mismatch, abs=0.015)


def test_a_running_camera_starts_anywhere() -> None:
    """Light that came down before the first rest: up to theta_off to go back. The std covers it."""
    camera = cameras(0.03)
    found = calibrate_step(bench(camera, CYCLES, before=(150.0, 60.0)))
    for name in ("theta_on", "theta_off"):
        off, sigmas = errors(found, camera, name)
        assert abs(off.mean()) < 0.006
        assert np.sqrt((sigmas**2).mean()) < 1.4


@pytest.mark.usefixtures("known_levels")
def test_quantisation_shrinks_with_the_step() -> None:
    """One step: the error is that of a count of dlogI / theta, the std says so."""
    camera = cameras(0.03)
    stds = []
    for top in (50, 100, 225):
        found = calibrate_step(bench(camera, [25, top]), fresh=True)
        _, sigmas = errors(found, camera, "theta_on")
        assert 0.6 < np.sqrt((sigmas**2).mean()) < 1.4
        stds.append(np.median(np.asarray(found.std.theta_on)[found.valid]))
        assert found.undetermined == ("theta_off",)
        assert "theta_off.undetermined" in [note.code for note in found.notes]
    assert stds[0] > 1.5 * stds[1] > 1.5 * stds[2]


def test_noise_is_taken_off_and_measured() -> None:
    camera = cameras(0.03, "eq12")
    found = calibrate_step(bench(camera, CYCLES), fresh=True)
    for name in ("theta_on", "theta_off"):
        off, sigmas = errors(found, camera, name)
        assert abs(off.mean()) < 0.004
        assert np.sqrt((sigmas**2).mean()) < 1.4
    rest = 0.56 * SHAPE[0] * SHAPE[1]  # pixel seconds
    for name in ("eta_on", "eta_off"):
        true = float(np.mean(getattr(camera, name)))
        seen = float(getattr(found.summary, name))
        assert abs(seen - true) < 3.5 * np.sqrt(true / rest)


@pytest.mark.usefixtures("known_levels")
@pytest.mark.parametrize("stores", [True, False])
@pytest.mark.parametrize("levels", [CYCLES, STAIRS], ids=["cycles", "stairs"])
def test_noise_that_stores_the_light_is_told_from_noise_that_does_not(
    levels: list[float], stores: bool
) -> None:
    """A pixel that starts anew at the light of a rest need not go back first."""
    camera = cameras(0.03)
    model = SensorModel(shot_hz=2.0, noise_resets_memory=stores)
    found = calibrate_step(bench(camera, levels, model=model), fresh=True)
    for name in ("theta_on", "theta_off"):
        off, sigmas = errors(found, camera, name)
        assert abs(off.mean()) < 0.007
        assert 0.7 < np.sqrt((sigmas**2).mean()) < 1.25


@pytest.mark.parametrize(("sent", "expected"), [((3.0, 2.5), 1.0), ((3.0, 3.0), 0.0)])
def test_counts_after_noise_tell_whether_it_stores_the_light(
    sent: tuple[float, float], expected: float
) -> None:
    """Of two steps up, pixels with noise between send half an event less the second time."""
    noisy = np.zeros((3, 4, 4), bool)
    noisy[1, :2] = True
    n = np.zeros((2, 2, 4, 4))
    n[:, 0] = np.where(noisy[1], sent[1], sent[0])
    up, none = np.array([True, True]), np.zeros(n[:, 0].shape, bool)
    assert storing(n, up, noisy, np.array([0.2, 0.3]), none) == pytest.approx(expected)
    assert storing(n, up, np.zeros_like(noisy), np.array([0.2, 0.3]), none) == 0.0
    back = np.where(noisy[1], 3.0 + 0.5 * 0.2 / 0.3 * expected, 3.0)
    n[:, 1] = back
    turned = storing(n, np.array([True, False]), noisy, np.array([0.2, 0.3]), none)
    assert turned == pytest.approx(expected)


def test_light_may_be_given_instead_of_frames() -> None:
    camera = cameras(0.03)
    recording = bench(camera, CYCLES)
    times = recording.frame_times
    rests = [(int(times[a]), int(times[b])) for a, b in find_rests(recording)]
    assert len(rests) == len(CYCLES)
    alone = calibrate_step(Recording.of_events(recording.events), rests_us=rests,
                           light=[4.0 * x for x in CYCLES], fresh=True)
    framed = calibrate_step(recording, fresh=True)
    np.testing.assert_allclose(alone.camera.theta_on, framed.camera.theta_on, atol=1e-4)


def test_results_are_written_like_an_estimate(tmp_path: Path) -> None:
    found = calibrate_step(bench(cameras(0.03), [25, 225, 25]), fresh=True)
    path = found.save(tmp_path / "camera.npz")
    np.testing.assert_array_equal(Camera.load(path).theta_on, found.camera.theta_on)
    assert found.as_dict()["windows"] == 2


def test_what_is_no_bench_is_refused() -> None:
    recording = bench(cameras(0.03), [25, 225])
    none = np.zeros(0, np.int64)
    empty = Events(none, none, none, none, (SHAPE[1], SHAPE[0]))
    cases = {
        "EV001": lambda: calibrate_step(Recording.of_events(empty)),
        "EV011": lambda: calibrate_step(Recording.of_events(recording.events), lux=[1, 2]),
        "EV017": lambda: calibrate_step(bench(cameras(0.03, "eq12"), [100, 105])),
        "EV020": lambda: calibrate_step(recording, rests_us=[(0, 10), (5, 20)], light=[1, 2]),
    }
    for code, call in cases.items():
        with pytest.raises(EvflowDataError, match=code):
            call()
    with pytest.raises(EvflowDataError, match="EV020"):
        calibrate_step(recording, rests_us=[(0, 10), (15, 20)], light=[1, 0])
    swapped = dataclasses.replace(recording.events, p=~recording.events.p)
    with pytest.raises(EvflowDataError, match="EV021"):
        calibrate_step(dataclasses.replace(recording, events=swapped))


def test_inverted_polarity_is_told_from_steps_too_small_and_lux_out_of_order() -> None:
    """Steps of 15 % send noise only, of either sign."""
    noisy = Camera.constant(SHAPE, 0.3, 0.3, 1.0, 1.0)
    for levels in ([100, 115] * 3, [115, 100] * 3):
        small = bench(noisy, levels)
        with pytest.raises(EvflowDataError, match=r"EV017.*5 steps of light, of 15% at most"):
            calibrate_step(small)
    light = [40, 100, 55, 220, 40]
    alone = Recording.of_events(bench(noisy, light).events)
    edges = 1000 * (100 + 120 * np.arange(4))
    with pytest.raises(EvflowDataError, match=r"EV021.*Is the light of the rests, --lux, in order"):
        calibrate_step(alone, lux=[100, 40, 220, 55, 100], triggers_us=edges)


def textured(shift_px: int, part: float = 1.0) -> Recording:
    """A texture under CYCLES, which moves `shift_px` per frame; only `part` of it is the screen."""
    base = bench(cameras(0.03), CYCLES)
    texture = np.exp(0.2 * cv2.GaussianBlur(
        np.random.default_rng(0).standard_normal((SHAPE[0], 4096)), (0, 0), 2.0) * 7.0)
    light = np.asarray(base.frames)[:, 0, 0]
    frames = np.stack([255 * np.roll(texture, i * shift_px, 1)[:, :SHAPE[1]] / texture.max()
                       * light[i] / light.max() for i in range(len(light))])
    frames[:, :, round(part * SHAPE[1]):] = 40.0
    return dataclasses.replace(base, frames=frames.astype(np.float32))


def test_frames_must_show_a_screen_that_steps() -> None:
    """A still texture does as well; one that moves, or that most pixels do not see, does not."""
    assert len(find_rests(textured(0))) == len(CYCLES)
    assert calibrate_step(textured(0, part=0.7)).valid.any()
    with pytest.raises(EvflowDataError, match=r"EV017.*the scene moves while the light rests"):
        calibrate_step(textured(2))
    with pytest.raises(EvflowDataError, match="EV017"):
        calibrate_step(textured(0, part=0.3))
    several = textured(0, part=0.3)
    rests = [(0, 90_000), (120_000, 210_000)]
    with pytest.raises(EvflowDataError, match=r"EV017.*step 1 of 1 does not fill the view"):
        calibrate_step(several, rests_us=rests)


def dim(levels: list[float], noise_dn: float = 1.0, screen_part: float = 1.0) -> Recording:
    """Whole grey levels of a screen that a lens darkens towards its corners, with frame noise."""
    rng = np.random.default_rng(0)
    base = bench(cameras(0.03), levels)
    y, x = (np.linspace(-1, 1, n) for n in SHAPE)
    lens = 1 / (1 + 0.6 * (y[:, None] ** 2 + x[None] ** 2)) ** 2
    frames = np.asarray(base.frames) * lens
    frames[:, :, round(screen_part * SHAPE[1]):] = 4.0
    noisy = np.clip(frames + noise_dn * rng.standard_normal(frames.shape), 0, 255)
    return dataclasses.replace(base, frames=np.round(noisy).astype(np.uint8))


@pytest.mark.parametrize("recording", [
    dim([8, 40, 8, 40, 8]), dim([4, 16, 4, 16, 4]), dim([25, 225, 25, 225, 25], 3.0),
    dim([25, 225, 25, 225, 25], screen_part=0.6)], ids=["dim", "dark", "noisy", "part"])
def test_few_grey_levels_and_a_lens_are_no_motion(recording: Recording) -> None:
    """One DN is .15 log units at 6 DN: the median pixel jumps where the light rests."""
    steps = len(find_rests(recording)) - 1
    assert steps == 4
    assert len(calibrate_step(recording).camera.shape) == 2


@pytest.mark.parametrize(("recording", "steps"), [
    (dim([8, 40, 8, 40, 8]), 4), (dim([25, 225, 25, 225, 25], screen_part=0.3), 0),
    (textured(2), 0), (dim([100, 100, 100]), 0)], ids=["dim", "part", "motion", "static"])
def test_a_bench_is_recognised_at_a_glance(recording: Recording, steps: int) -> None:
    assert steps_of_light(recording) == steps


def test_a_lamp_that_settles_is_no_motion() -> None:
    base = bench(cameras(0.03), [25, 225, 25])
    light = np.asarray(base.frames)[:, 0, 0]
    since = np.arange(len(light)) - np.r_[0, 1 + np.flatnonzero(np.diff(light) > 20)][-1]
    settling = light * np.where(since >= 0, 1 + 0.15 * np.exp(-np.maximum(since, 0) / 5.0), 1.0)
    frames = np.broadcast_to(np.minimum(settling, 255)[:, None, None], base.frames.shape)
    assert len(find_rests(dataclasses.replace(base, frames=frames.astype(np.float32)))) >= 2


def test_light_that_changes_while_frames_rest_is_told() -> None:
    """A camera that regulates its exposure shows rests where there are none."""
    base = bench(cameras(0.03), CYCLES)
    frames = np.asarray(base.frames).copy()
    half = len(frames) // 2
    frames[:half], frames[half:] = 100.0, 200.0
    found = calibrate_step(dataclasses.replace(base, frames=frames))
    assert "scene.restless" in [note.code for note in found.notes]
    quiet = calibrate_step(bench(cameras(0.03, "eq12"), CYCLES))
    assert "scene.restless" not in [note.code for note in quiet.notes]
    assert quiet.undetermined == ()


def test_few_measured_pixels_are_told() -> None:
    """Steps of a threshold and a half: one event each, of which a direction needs two."""
    found = calibrate_step(bench(Camera.constant(SHAPE, 0.45, 0.45), [60, 120, 60]), fresh=True)
    assert not found.valid.any()
    assert "0% of the pixels sent enough events" in " ".join(texts(found.notes))


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The bench by the command line: a screen's steps, and what its noise sends at rest."""
    from evflow.cli import main
    even = Camera.constant(SHAPE, 0.2, 0.25, 1.0, 0.5)
    by = 1.0 + 0.05 * np.random.default_rng(0).standard_normal(SHAPE).astype(np.float32)
    camera = dataclasses.replace(even, theta_on=by * even.theta_on, theta_off=by * even.theta_off)
    source, still = tmp_path / "screen.npz", tmp_path / "still.npz"
    write_recording(source, bench(camera, CYCLES))
    dark = Recording(bench(camera, [100] * 20).events, np.zeros((0, *SHAPE), np.uint8), np.zeros(0))
    write_recording(still, dark)

    def run(path: Path, protocol: str, *more: str) -> tuple[int, str]:
        code = main(["estimate", str(path), "-o", str(tmp_path / protocol), "--protocol", protocol,
                     "--no-plots", "--json", *more])
        return code, capsys.readouterr().out

    edges = tmp_path / "edges.txt"
    edges.write_text("".join(f"{0.099 + 0.12 * k}\n" for k in range(len(CYCLES) - 1)))
    code, out = run(source, "step", "--triggers", str(edges))
    said = json.loads(out)
    assert (code, said["protocol"], said["grade"]) == (0, "step", "fair")  # of two levels alone
    assert [level["light"] for level in said["bench"]["levels"]] == pytest.approx([25, 225])
    page = (tmp_path / "step" / "report.html").read_text()
    # A ramp of 2.2 log units in 20 ms: a threshold, and the half that is left after a turn.
    down, up = said["bench"]["latency"]
    assert up["seconds"] == pytest.approx(1.5 * 0.2 / 2.2 * 0.02, rel=0.3)
    assert down["seconds"] == pytest.approx(1.5 * 0.25 / 2.2 * 0.02, rel=0.3)
    assert page.count("<section") == 10
    assert "% of contrast" not in page  # the terminal's word
    for word in ("2 levels of light", "one size", "S-curves", "light [DN]", "Latency against"):
        assert word in page
    found = Camera.load(tmp_path / "step" / "camera.npz")
    assert abs(float(jnp.median(found.theta_on)) - 0.2) < 0.01
    assert abs(float(jnp.median(found.theta_off)) - 0.25) < 0.01
    code, out = run(still, "static", str(still), "--lux", "40", "5")
    said = json.loads(out)
    assert code == 0
    assert said["summary"]["eta_on"] == pytest.approx(1.0, rel=0.1)
    assert [level["light"] for level in said["bench"]["levels"]] == [5, 40]  # darkest first
    assert said["bench"]["levels"][0]["eta_off"] == pytest.approx(said["summary"]["eta_off"])
    assert "light [lux]" in (tmp_path / "static" / "report.html").read_text()
    assert run(source, "static")[0] == 1  # a screen that steps is no scene at rest
    assert run(source, "step", "--overwrite", "--window-ms", "30")[0] == 2


@pytest.mark.parametrize(("words", "said"), [
    (["two.npz", "--lux", "1", "2"], "2 recordings with --protocol motion"),
    (["--lux", "1", "2"], "--lux with --protocol motion"),
    (["two.npz", "--protocol", "step"], "2 recordings with --protocol step"),
    (["two.npz", "--protocol", "static"], "0 values of --lux for 2 recordings"),
    (["--protocol", "static", "--lux", "1", "2"], "2 values of --lux for 1 recording"),
    (["--protocol", "static", "--lux", "-1"], "--lux -1"),
    (["--protocol", "static", "--triggers", "t.txt"], "only useful with --protocol step"),
])
def test_illuminances_go_with_recordings(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from evflow.cli import main

    assert main(["estimate", "one.npz", "-o", str(tmp_path / "out"), *words]) == 2
    assert said in capsys.readouterr().err


def test_noise_and_thresholds_join_in_one_camera(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from evflow.camera.optics import read_undetermined
    from evflow.cli import main

    camera = Camera.constant(SHAPE, 0.2, 0.25, 1.0, 0.5)
    still, steps = tmp_path / "still.npz", tmp_path / "steps" / "camera.npz"
    write_recording(still, Recording(
        bench(camera, [100] * 20).events, np.zeros((0, *SHAPE), np.uint8), np.zeros(0)))
    steps.parent.mkdir()
    calibrate_step(bench(camera, CYCLES)).save(steps)
    base = ["estimate", str(still), "--protocol", "static", "--no-plots", "-o"]
    assert main([*base, str(tmp_path / "alone")]) == 0
    alone = tmp_path / "alone" / "camera.npz"
    assert read_undetermined(alone) == ("theta_on", "theta_off")
    capsys.readouterr()
    assert main(["export", str(alone), "--to", "v2e", "-o", str(tmp_path / "v2e")]) == 0
    assert "theta_on and theta_off of this camera were not measured" in capsys.readouterr().err

    assert main([*base, str(tmp_path / "both"), "--thresholds", str(steps)]) == 0
    both = Camera.load(tmp_path / "both" / "camera.npz")
    assert read_undetermined(tmp_path / "both" / "camera.npz") == ()
    np.testing.assert_array_equal(both.theta_on, Camera.load(steps).theta_on)
    np.testing.assert_array_equal(both.eta_on, Camera.load(alone).eta_on)
    capsys.readouterr()
    assert main([*base, str(tmp_path / "no"), "--thresholds", str(alone)]) == 2
    assert "EV020" in capsys.readouterr().err


def test_doubts_of_further_recordings_are_kept(tmp_path: Path) -> None:
    from evflow.cli import main

    for name, off_hz in (("a", 0.5), ("b", 0.0)):
        write_recording(tmp_path / f"{name}.npz", Recording.of_events(
            bench(Camera.constant(SHAPE, 0.2, 0.25, 1.0, off_hz), [100] * 20).events))
    both, out = [str(tmp_path / f"{name}.npz") for name in "ab"], tmp_path / "out"
    assert main(["estimate", *both, "--protocol", "static", "--lux", "5", "200", "--no-plots",
                 "--no-checks", "-o", str(out)]) == 0
    notes = json.loads((out / "camera.json").read_text())["notes"]
    assert [n["code"] for n in notes if n["text"].startswith(both[1])] == ["EV022"]


def test_triggers_and_light_of_each_rest_take_the_place_of_frames() -> None:
    """With both edges of a pulse at each step, and one after the events."""
    camera = cameras(0.05)
    recording = bench(camera, STAIRS)
    alone = Recording.of_events(recording.events)
    edges = 1000 * (100 + 120 * np.arange(len(STAIRS) - 1))
    triggers = [*edges, *(edges + 500), recording.events.t[-1] + 5]
    found = calibrate_step(alone, lux=[0.3 * v for v in STAIRS], triggers_us=triggers, fresh=True)
    seen = calibrate_step(recording, fresh=True)
    for name in ("theta_on", "theta_off"):
        assert float(getattr(found.summary, name)) == pytest.approx(
            float(getattr(seen.summary, name)), rel=0.01)
    assert found.bench is not None
    assert (found.bench.unit, found.bench.levels[0].light) == ("lux", pytest.approx(7.5))
    with pytest.raises(EvflowDataError, match=r"EV020.*10 edges of light.*each of the 11 rests"):
        calibrate_step(alone, lux=[1, 2], triggers_us=triggers)
    # in the middle of each edge, and of a part of the recording
    lux = 0.3 * np.array(STAIRS)
    late = calibrate_step(alone, lux=lux, triggers_us=edges + 8000, fresh=True)
    assert float(late.summary.theta_on) == pytest.approx(float(found.summary.theta_on), rel=1e-4)
    begin, end = int(edges[2]) + 60_000, int(alone.events.t[-1])
    part = Recording.of_events(alone.events.slice(begin, end))
    some, own = (calibrate_step(part, lux=lux[3:], triggers_us=of) for of in (triggers, edges[3:]))
    np.testing.assert_array_equal(some.camera.theta_on, own.camera.theta_on)
    np.testing.assert_array_equal(some.camera.eta_on, own.camera.eta_on)
    none = Recording.of_events(alone.events.slice(0, 0))
    with pytest.raises(EvflowDataError, match="EV001"):
        calibrate_step(none, lux=lux, triggers_us=triggers)
    with pytest.raises(EvflowDataError, match="EV020"):
        calibrate_step(alone, light=[1, 2], rests_us=[(0, 0), (100_000, 200_000)])
