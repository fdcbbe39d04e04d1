"""The report on a camera: its panels, nothing from outside, and words that follow the numbers."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
import shutil
import subprocess
import types
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from helpers.networks import hidden
from PIL import Image

import evflow
from evflow import CameraEstimate, EvflowDataError, Recording, SensorModel
from evflow.commands.pixels import Pixels
from evflow.estimation import pipeline
from evflow.estimation.drift import Third
from evflow.estimation.extent import Extent
from evflow.estimation.refine import stretches
from evflow.notes import Note
from evflow.recordings.bunches import Bunch
from evflow.report import camera, page, plots, resimulate
from evflow.report.extent import extent_panel
from evflow.report.resimulate import busiest, usable_runs
from evflow.report.verdict import judge_estimate, judge_stream, known, overall, poorer, worst

PANELS = ("verdict", "maps", "on-off", "rates", "images", "counts", "intervals", "receptor",
          "faults", "extent", "held-out", "assumptions")


@pytest.fixture(scope="module")
def measured() -> tuple[CameraEstimate, Recording]:
    """Of the first half alone: the programs are those that the held-out half runs again."""
    recording = hidden(15, 440)[0]
    times = recording.frame_times
    half = Recording(recording.events.slice(int(times[0]), int(times[5])), recording.frames[:6],
                     times[:6])
    return evflow.estimate_camera(half), recording


@pytest.fixture(scope="module")
def report(
    measured: tuple[CameraEstimate, Recording], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    path = tmp_path_factory.mktemp("report") / "report.html"
    steps: list[tuple[int, int]] = []
    numbers = evflow.write_report(
        path, *measured, command="evflow estimate flight.h5 -o cam/",
        progress=lambda done, total: steps.append((done, total)))
    assert steps == [(i, camera.STAGES) for i in range(1, camera.STAGES + 1)]
    return path, numbers


def test_all_panels_are_there_and_nothing_is_loaded(report: tuple[Path, dict[str, Any]]) -> None:
    text = report[0].read_text()
    assert re.findall(r'<section id="([\w-]+)">', text) == list(PANELS)
    sources = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert len(sources) >= 8 + 4 + 2 + 2 + 3 + 2 + 2 + 1  # maps, histograms, ...
    assert all(s.startswith("data:") for s in sources)
    assert not re.search(r"https?://|@import|url\(", text)
    assert "evflow estimate flight.h5 -o cam/" in text
    assert len(re.findall(r"sha256 [0-9a-f]{64}", text)) == 1  # the weights; no file was named
    assert len(text) < 1_500_000


def test_every_picture_opens(report: tuple[Path, dict[str, Any]]) -> None:
    text = report[0].read_text()
    kinds = {"png": 0, "svg+xml": 0}
    for kind, data in re.findall(r'"data:image/(png|svg\+xml);base64,([^"]+)"', text):
        kinds[kind] += 1
        raw = base64.b64decode(data)
        if kind == "png":
            with Image.open(io.BytesIO(raw)) as image:
                assert image.size == (64, 48)
        else:
            assert ET.fromstring(raw).tag.endswith("svg")
            hrefs = re.findall(rb'href="([^"]*)"', raw)
            assert all(h.startswith((b"#", b"data:")) for h in hrefs)
    assert kinds["png"] == 8 + 3 + 1
    assert kinds["svg+xml"] == 4 + 2 + 2 + 2 + 2 + 1


def test_the_numbers_lie_in_the_page(report: tuple[Path, dict[str, Any]]) -> None:
    path, numbers = report
    inside = re.search(r'id="numbers">(.*?)</script>', path.read_text(), re.S)
    assert inside
    assert json.loads(inside[1]) == json.loads(json.dumps(numbers))
    trial, held = numbers["trial"], numbers["held_out"]
    assert 0.6 < trial["rate_hz"]["ratio"]["both"] < 1.6  # the right camera, interpolated frames
    assert trial["counts"]["r"]["both"] > 0.5
    assert trial["ceiling"]["both"] > trial["counts"]["r"]["both"]
    assert held["span_us"][0] >= trial["span_us"][0]
    assert numbers["grade"] in ("good", "fair", "poor")


def test_it_opens_in_a_browser(report: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which(
        "google-chrome")
    if not browser:
        pytest.skip("no chromium at hand")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
               f"--user-data-dir={tmp_path / 'profile'}", "--window-size=390,844"]
    url = report[0].as_uri()
    done = subprocess.run([*command, "--dump-dom", url], capture_output=True, text=True,
                          timeout=120, check=True)
    assert re.findall(r'<section id="([\w-]+)">', done.stdout) == list(PANELS)
    assert "CONSOLE" not in done.stderr
    shot = tmp_path / "shot.png"
    subprocess.run([*command, f"--screenshot={shot}", url], capture_output=True, timeout=120,
                   check=True)
    with Image.open(shot) as image:
        assert np.asarray(image.convert("L")).std() > 10


def changed(found: CameraEstimate, **summary: float) -> CameraEstimate:
    values = {k: jnp.float32(v) for k, v in summary.items()}
    return dataclasses.replace(found, summary=dataclasses.replace(found.summary, **values))


def test_without_frames_it_says_why(
    measured: tuple[CameraEstimate, Recording], tmp_path: Path
) -> None:
    found, recording = measured
    noise = dataclasses.replace(
        found, windows=0, valid=np.zeros_like(found.valid), hot=np.zeros_like(found.hot),
        notes=(Note("frames.none", "no frames."),), undetermined=("theta_on", "theta_off"))
    numbers = evflow.write_report(
        tmp_path / "noise.html", noise, Recording.of_events(recording.events))
    text = (tmp_path / "noise.html").read_text()
    assert re.findall(r'<section id="([\w-]+)">', text) == list(PANELS)
    assert numbers["trial"] is None
    assert text.count("Absent: ") == 5
    assert text.count("Not determined by this recording.") == 2
    assert "Not all of the camera is known." in text
    assert "of a static scene" in text


def test_what_the_estimate_has_made_of_the_first_half_is_shared(
    measured: tuple[CameraEstimate, Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second stretch is left out, and the first says what it says when estimated alone."""
    alone, recording = measured
    monkeypatch.setattr(stretches, "INTERVALS", 5)
    made = pipeline.measure(recording)
    assert made.first is not None
    assert made.first.rest == (5, 10)
    assert made.first.rest_of(recording) == (5, 10)
    twice = dataclasses.replace(  # as it was before every second frame was left out
        recording, frames=np.repeat(recording.frames, 2, 0)[:-1], frame_times=np.arange(
            recording.frame_times[0], recording.frame_times[-1] + 1, 20_000))
    assert made.first.rest_of(twice) == (10, 20)
    monkeypatch.setattr(resimulate, "estimate_camera", None)  # nothing is estimated again
    numbers = evflow.write_report(
        tmp_path / "shared.html", made.found, recording, first=made.first)
    assert numbers["held_out"]["span_us"][1] == recording.frame_times[10]
    text = (tmp_path / "shared.html").read_text()
    assert "from 5 windows of its first part" in text
    first = made.first.estimate()
    np.testing.assert_allclose(first.camera.theta_on, alone.camera.theta_on, rtol=1e-3)
    np.testing.assert_allclose(first.std.theta_off, alone.std.theta_off, rtol=1e-3)


def test_it_is_simulated_as_the_command_simulates_it(
    measured: tuple[CameraEstimate, Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With leak and shot noise as parts of eta, and the dead time; the low-pass is in the frames.
    Noise of the options is added to all of eta."""
    found, recording = measured
    sensor = SensorModel(cutoff_hz=40.0, cutoff_by_light=False, refractory_s=2e-3, leak_hz=0.1,
                         shot_hz=1.5, eta_is_all=True, noise_resets_memory=True)
    found = dataclasses.replace(found, sensor=sensor)
    path = found.save(tmp_path / "camera.npz")
    models = []

    def watched(key: Any, frames: Any, times: Any, camera: Any, *, model: SensorModel,
                full_scale: float) -> Any:
        assert full_scale == 255  # frames in DN, however dark
        models.append(model)
        return iter([recording.events])

    monkeypatch.setattr(resimulate, "simulate_stream", watched)
    resimulate.resimulate(recording, found, (0, 2), 0)
    made = Pixels(camera=path)
    behind = made.model()
    assert models == [behind, behind]
    assert (behind.leak_hz, behind.shot_hz, behind.refractory_s, behind.cutoff_hz) == (
        0.1, 1.5, 2e-3, 0.0)
    assert behind.eta_is_all
    assert made.seen_by(recorded=True).cutoff_hz == pytest.approx(40.0)
    assert not made.seen_by(recorded=True).by_light
    added = Pixels(camera=path, shot_hz=2.0).model()
    assert (added.leak_hz, added.shot_hz, added.eta_is_all) == (0.0, 2.0, False)
    assert Pixels(camera=path, sensor="v2e").model().leak_hz == 0.01


def test_pictures_of_a_part_are_those_of_the_whole(
    measured: tuple[CameraEstimate, Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    """While they are few; else a part is interpolated by itself."""
    recording = measured[1]
    begin, end = (int(recording.frame_times[i]) for i in (2, 4))
    pictures = resimulate.Pictures(recording)
    whole = list(pictures.of((0, 5)))
    part = list(pictures.of((2, 4)))
    assert [id(frame) for frame, _ in part] == [id(f) for f, t in whole if begin <= t <= end]
    assert (part[0][1], part[-1][1]) == (begin, end)
    monkeypatch.setattr(resimulate, "MOST_KEPT", 1)
    pictures = resimulate.Pictures(recording)
    list(pictures.of((0, 5)))
    assert not pictures.kept
    alone = [t for _, t in pictures.of((2, 4))]
    assert (alone[0], alone[-1]) == (begin, end)


def test_what_comes_with_the_frames_is_not_compared(
    measured: tuple[CameraEstimate, Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, recording = measured
    monkeypatch.setattr(resimulate, "simulate_stream", lambda *_, **__: iter([recording.events]))
    monkeypatch.setattr(resimulate, "bunch", lambda _: Bunch(-2_000, 1_000, 0.2, 0.0))
    trial = resimulate.resimulate(recording, found, (0, 2), 0)
    inside = recording.events.slice(*trial.span_us)
    near = (inside.t[:, None] - recording.frame_times >= -2_000) & (
        inside.t[:, None] - recording.frame_times < 1_000)
    assert near.any()
    for events in (trial.real, trial.made):
        np.testing.assert_array_equal(events.t, inside.t[~near.any(1)])


def test_too_short_for_halves_says_so(
    measured: tuple[CameraEstimate, Recording], tmp_path: Path
) -> None:
    found, recording = measured
    two = Recording(recording.events, recording.frames[:2], recording.frame_times[:2])
    numbers = evflow.write_report(tmp_path / "short.html", found, two)
    assert numbers["trial"] is not None
    assert numbers["held_out"] is None
    assert "cannot be halved" in (tmp_path / "short.html").read_text()


def test_what_is_refused(measured: tuple[CameraEstimate, Recording], tmp_path: Path) -> None:
    found, recording = measured
    (tmp_path / "there.html").write_text("mine")
    bare = Recording.of_events(recording.events)
    noise = dataclasses.replace(found, windows=0)
    with pytest.raises(EvflowDataError, match="EV013"):
        evflow.write_report(tmp_path / "there.html", noise, bare)
    other = Recording.of_events(dataclasses.replace(recording.events, size=(80, 48)))
    with pytest.raises(EvflowDataError, match="EV015"):
        evflow.write_report(tmp_path / "a.html", found, other)
    assert (tmp_path / "there.html").read_text() == "mine"


def stream(ratio: float | None, r: float | None) -> dict[str, Any]:
    both = {"on": ratio, "off": ratio}
    rates = {"real": {p: both[p] is not None for p in both}, "synthetic": {p: 1.0 for p in both}}
    return {"rate_hz": {"ratio": both, **rates}, "counts": {"r": {"on": r, "off": r}}}


@pytest.mark.parametrize(("ratio", "r", "grades"), [
    (1.0, 0.9, ["good", "good"]), (1.3, 0.9, ["fair", "good"]), (1 / 1.3, 0.6, ["fair", "fair"]),
    (0.4, 0.2, ["poor", "poor"]), (2.5, None, ["poor"]), (None, None, ["poor"]),
    (0.0, None, ["poor"]),
])
def test_grades_follow_the_numbers(
    ratio: float | None, r: float | None, grades: list[str]
) -> None:
    judged = judge_stream(stream(ratio, r), "on", "re-simulated", {"on": 1.0, "off": 1.0})
    assert [j.grade for j in judged] == grades
    assert all(bool(j.advice) == (j.grade != "good") for j in judged)
    assert all(j.about == "ON" for j in judged)


def test_r_is_held_against_what_is_possible() -> None:
    judged = judge_stream(stream(1.0, 0.45), "on", "re-simulated", {"on": 0.5, "off": 0.5})
    assert [j.grade for j in judged] == ["good", "good"]


def test_a_known_reason_comes_before_all_others() -> None:
    ceiling = {"on": 1.0, "off": 1.0}
    clocked, lost = (judge_stream(stream(0.7, 0.9), "on", "re-simulated", ceiling, gone)[0].advice
                  for gone in (False, True))
    assert "clocks" in clocked
    assert "higher frame rate, comes first" in lost


def test_what_could_not_be_tested_is_fair_at_best() -> None:
    assert [overall([], tested=tested) for tested in (True, False)] == ["good", "fair"]


def test_hot_pixels_are_not_compared(measured: tuple[CameraEstimate, Recording]) -> None:
    """Their own rates agree wherever the frames are: r of counts would be theirs."""
    found, recording = measured
    hot = np.zeros_like(found.hot)
    hot[4:8, 3] = True
    eta = jnp.where(hot, 2000.0, found.camera.eta_on)
    noisy = dataclasses.replace(
        found, hot=hot, camera=dataclasses.replace(found.camera, eta_on=eta))
    trial = resimulate.resimulate(recording, noisy, (0, 4), seed=0)
    assert not trial.made.count_map()[:, hot].any()
    assert not trial.real.count_map()[:, hot].any()
    assert trial.made.count_map()[:, ~hot].any()


def test_the_poorer_polarity_is_named(measured: tuple[CameraEstimate, Recording]) -> None:
    found = measured[0]
    loose = dataclasses.replace(found, summary_std=dataclasses.replace(
        found.summary_std, theta_off=0.5 * found.summary.theta_off))
    judged = judge_estimate(loose, None, None)
    assert poorer(judged) == "OFF"
    assert worst(judged) == "poor"
    far = dataclasses.replace(found, notes=(Note("theta_on.extrapolated", "far off"),))
    assert poorer(judge_estimate(far, None, None)) == "ON"
    lost = changed(found, theta_on=float("nan"))
    assert next(iter(judge_estimate(lost, None, None))).short == "undetermined"
    half = dataclasses.replace(found, undetermined=("theta_off",))
    assert [known(half, key) for key in ("on", "off")] == [True, False]


def test_a_frame_just_before_the_first_event_is_at_zero() -> None:
    """Not at -0.000 s."""
    recording: Any = types.SimpleNamespace(
        events=types.SimpleNamespace(t=np.array([1400])), frame_times=np.array([1000, 976_000]))
    trial: Any = types.SimpleNamespace(frames=(0, 1), span_us=(1000, 976_000), notes=())
    assert "(0.000 to 0.975 s after" in camera._stretch(recording, trial)


def test_the_busiest_stretch_is_bounded_and_without_gaps() -> None:
    recording = hidden(15, 440)[0]
    runs = usable_runs(recording)
    assert runs == [(0, len(recording.frames) - 1)]
    first, last = busiest(recording, runs, seconds=0.1)
    assert last - first == 2  # frames come every 40 ms
    times = recording.frame_times
    counts = [len(recording.events.slice(int(times[i]), int(times[i + 2])))
              for i in range(len(times) - 2)]
    assert first == int(np.argmax(counts))
    assert busiest(recording, [(3, 5)]) == (3, 5)


def test_words_and_tables_are_escaped() -> None:
    assert page.text("<b>&") == "&lt;b&gt;&amp;"
    assert "<script>" not in page.bullets(["<script>alert(1)</script>"])
    assert page.number(None) == page.number(float("nan")) == "–"
    assert page.number(0.01234) == "0.0123"
    assert page.number(12345.6) == "12,346"
    assert page.number(-0.25, 2) == "−0.25"
    assert page.spread(0.3949, 0.0092) == "0.3949 ± 0.0092"
    assert page.spread(0.448, 0.013) == "0.448 ± 0.013"


def test_large_maps_are_shown_in_blocks() -> None:
    small, k = page.blocks(np.arange(16.0).reshape(4, 4), 2)
    assert k == 2
    np.testing.assert_array_equal(small, [[2.5, 4.5], [10.5, 12.5]])
    same, k = page.blocks(np.ones((3, 5)), 5)
    assert (same.shape, k) == ((3, 5), 1)


def test_histograms_are_of_the_pixels_with_events(
    measured: tuple[CameraEstimate, Recording]
) -> None:
    """The others all show the camera's summary: a spike that hides the rest."""
    found = dataclasses.replace(measured[0], valid=np.arange(
        measured[0].valid.size).reshape(measured[0].valid.shape) % 10 == 0)
    axis = plots.new_figure(2.0, 2.0).subplots()
    plots._histogram(axis, found, "theta_on", None)
    drawn = axis.patches[0].get_xy()[:, 1].max()
    assert 0 < drawn <= found.valid.sum()
    assert axis.get_legend().get_texts()[0].get_text() == "10%, with events"


def test_what_was_read_and_its_thirds_are_laid_side_by_side(
    measured: tuple[CameraEstimate, Recording]
) -> None:
    thirds = tuple(Third(k * 10_000_000, (k + 1) * 10_000_000, 4, 0.2, theta, 0.004, 0.004)
                   for k, theta in enumerate((0.2, 0.2, 0.25)))
    found = dataclasses.replace(measured[0], thirds=thirds,
                                extent=Extent(2.5, 30.0, 12, 94, 0.04))
    body = extent_panel(found).body
    assert "20.0 to 30.0 s" in body
    assert "θ OFF changed" in body
    assert "θ ON changed" not in body
    assert "2.5 of 30.0 s were read" in body
    assert "4% smaller" in body
    same = dataclasses.replace(found, thirds=thirds[:1] * 3)
    assert "agree within their errors" in extent_panel(same).body
    assert "Too few stretches" in extent_panel(measured[0]).body
