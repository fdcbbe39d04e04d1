"""`evflow reconstruct`, `evflow flow` and `evflow estimate --reconstruct`."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.event_networks import EVEN, MOTION, even, saved, steady
from helpers.recordings import T0, make

from evflow import read_recording, write_events, write_recording
from evflow.cli import main
from evflow.downstream import video
from evflow.recordings.adjust import with_frames
from evflow.report.flow import GROUND, flow_colours, flow_image, wheel
from evflow.report.video import enlarged, write_video
from evflow.types import Events


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rec") / "flight.npz"
    write_events(path, make(count=12, span=700_000), format="npz")
    return path


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("weights")
    return {"images": str(saved(folder, even())), "flow": str(saved(folder, steady()))}


def pictures(path: Path) -> list[np.ndarray]:
    capture = cv2.VideoCapture(str(path))
    found = []
    while (read := capture.read())[0]:
        found.append(read[1][..., ::-1])
    capture.release()
    return found


@pytest.mark.parametrize("name", ["a.mp4", "a.avi", "a.gif"])
def test_reconstruct_films(
    flight: Path, weights: dict[str, str], tmp_path: Path, name: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["reconstruct", str(flight), "-o", str(tmp_path / name), "--json",
               "--weights", weights["images"]]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["images"] == 12
    assert found["scores"]["protocol"]["ssim"] == "evreal"
    assert found["scores"]["protocol"]["aggregate"] == "frames"
    assert found["scores"]["frames"] == 12 - found["scores"]["warm_up"]
    film = pictures(tmp_path / name)
    assert len(film) == (1 if name == "a.gif" else 12)  # a GIF shows equal pictures as one
    assert film[-1].shape == (480, 640, 3)
    assert abs(int(film[-1][100, 100, 0]) - 255 * EVEN) < 4
    assert main(command) == 1
    assert "EV013" in capsys.readouterr().err


def test_reconstruct_scores_against_the_frames(
    flight: Path, weights: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reconstruct", str(flight), "-o", str(tmp_path / "a.gif"), "--weights",
               weights["images"]]
    assert main([*command, "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)["scores"]
    frames = make(count=12, span=700_000).frames[scores["warm_up"]:] / 255.0
    assert scores["mse"] == pytest.approx(((frames - EVEN) ** 2).mean(), rel=1e-4)
    assert main([*command, "--overwrite", "--sync", "ms", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["images"] == 21
    assert found["scores"] is None  # the images are not at the frames' times


def test_frames_before_the_events_are_not_scored(
    weights: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made, command = make(count=12, span=700_000), ["reconstruct", str(tmp_path / "r.npz"), "-o",
                                                   str(tmp_path / "a.gif"), "--overwrite", "--json",
                                                   "--weights", weights["images"]]
    for moved in (300_000, 5_000_000):
        late = Events(made.events.x, made.events.y, made.events.t + moved, made.events.p,
                      made.events.size)
        write_recording(tmp_path / "r.npz", dataclasses.replace(made, events=late), "npz",
                        overwrite=True)
        amid = made.frame_times > late.t[0]
        if not amid.any():
            assert main(command) == 1
            assert "EV012" in capsys.readouterr().err
            continue
        assert main(command) == 0
        found = json.loads(capsys.readouterr().out)
        scores = found["scores"]
        assert scores["frames"] == amid.sum() - scores["warm_up"]
        assert any(f"{(~amid).sum()} of 12 frames" in note["text"] for note in found["notes"])
        frames = made.frames[amid][scores["warm_up"]:] / 255.0
        assert scores["mse"] == pytest.approx(((frames - EVEN) ** 2).mean(), rel=1e-4)


def test_reconstructed_folders_are_frames_for_other_commands(
    flight: Path, weights: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "images"
    command = ["reconstruct", str(flight), "-o", str(out), "--weights", weights["images"]]
    assert main([*command, "--sync", "events", "--window-events", "100"]) == 0
    assert len(list(out.glob("*.png"))) == 20
    assert main([*command, "--overwrite", "--sync", "ms", "--window-ms", "50"]) == 0
    assert len(list(out.glob("*.png"))) == 13
    capsys.readouterr()
    assert main(["info", str(flight), "--frames", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 13
    seen = read_recording(flight)
    assert not seen.frames_were_made
    assert with_frames(seen, out).frames_were_made
    assert with_frames(seen, out, timestamps=out / "timestamps.txt").frames_were_made
    assert with_frames(seen, out, fps=30.0, offset_us=T0).frames_were_made
    (out / "mine.txt").touch()
    assert main([*command, "--overwrite"]) == 1
    assert "EV013" in capsys.readouterr().err


def test_flow_films_and_scores(
    flight: Path, weights: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, truth = tmp_path / "flow.mp4", tmp_path / "truth.npz"
    command = ["flow", str(flight), "-o", str(out), "--weights", weights["flow"], "--json"]
    assert main([*command, "--sync", "ms", "--window-ms", "100"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["scores"]["convention"]["splat"] == "bilinear"
    assert found["scores"]["fwl"] > 0
    assert "aee" not in found["scores"]
    assert found["full_px"] == pytest.approx(np.hypot(*MOTION), rel=1e-4)
    assert len(pictures(out)) == found["scores"]["windows"] == 6
    edges = T0 + np.array([10_000, 110_000, 210_000])
    np.savez(truth, flow=np.zeros((2, 2, 48, 64), np.float32), edges_us=edges)
    assert main([*command, "--overwrite", "--truth", str(truth)]) == 0
    scores = json.loads(capsys.readouterr().out)["scores"]
    assert scores["aee"] == pytest.approx(np.hypot(*MOTION), rel=1e-4)
    assert scores["windows"] == 2
    assert scores["fwl_truth"] == pytest.approx(1.0)
    np.savez(truth, flow=np.full((2, 2, 48, 64), np.nan, np.float32), edges_us=edges)
    assert main([*command, "--overwrite", "--truth", str(truth)]) == 0
    assert json.loads(capsys.readouterr().out)["notes"][-1]["code"] == "truth.none"
    np.savez(truth, flow=np.zeros((2, 2, 48, 64), np.float32), edges_us=edges + 10**9)
    assert main([*command, "--overwrite", "--truth", str(truth)]) == 1
    assert "EV012" in capsys.readouterr().err


def test_flow_needs_no_weights_of_ones_own(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "flow.mp4"
    assert main(["flow", str(flight), "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["weights"] == "evflownet-small"
    assert np.isfinite(found["scores"]["fwl"])
    assert len(pictures(out)) == len(make(count=12).frames)  # one up to each frame


def test_colours_say_where_to_and_how_fast() -> None:
    right, still, left = (np.reshape(v, (2, 1, 1)) for v in ((2, 0), (0, 0), (-1, 0)))
    np.testing.assert_allclose(flow_colours(right, 2.0)[0, 0], [1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(flow_colours(still, 2.0)[0, 0], 1.0)
    np.testing.assert_allclose(flow_colours(left, 2.0)[0, 0], [0.5, 1, 1], atol=1e-5)
    np.testing.assert_allclose(flow_colours(9 * right, 2.0), flow_colours(right, 2.0))
    disc = wheel(21)
    np.testing.assert_allclose(disc[10, 20], [1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(disc[10, 10], 1.0)
    np.testing.assert_allclose(disc[0, 0], GROUND)
    events = Events([5], [30], [7], [True], (64, 48))
    image = flow_image(np.broadcast_to(right, (2, 48, 64)), events, 2.0)
    np.testing.assert_allclose(image[30, 5], [1, 0, 0], atol=1e-5)
    image[30, 5] = GROUND
    assert (image[9:] == GROUND).all()


@pytest.mark.parametrize(("said", "command"), [
    ("EV020", ["reconstruct", "REC", "-o", "a.png"]),
    ("EV020", ["reconstruct", "REC", "-o", "a.gif", "--codec", "vp9"]),
    ("EV020", ["reconstruct", "REC", "-o", "folder", "--fps", "3"]),
    ("EV020", ["reconstruct", "REC", "-o", "a.mp4", "--weights", "FLOW"]),
    ("EV020", ["reconstruct", "REC", "-o", "a.mp4", "--weights", "IMAGES", "--window-events", "9"]),
    ("EV018", ["reconstruct", "REC", "-o", "a.mp4", "--weights", "default"]),
    ("EV016", ["reconstruct", "REC", "-o", "a.mp4", "--weights", "no.pth.tar"]),
    ("EV020", ["flow", "REC", "-o", "folder", "--weights", "FLOW"]),
    ("EV020", ["flow", "REC", "-o", "a.mp4", "--weights", "IMAGES"]),
    ("EV020", ["flow", "REC", "-o", "a.mp4", "--weights", "FLOW", "--truth", "t.npz", "--sync",
               "ms"]),
    ("EV020", ["flow", "REC", "-o", "a.mp4", "--weights", "FLOW", "--full-px", "0"]),
    ("EV016", ["flow", "REC", "-o", "a.mp4", "--weights", "FLOW", "--truth", "no.npz"]),
    ("EV020", ["reconstruct", "REC", "-o", "-", "--weights", "IMAGES"]),
    ("EV020", ["reconstruct", "REC", "-o", "a.mp4", "--weights", "IMAGES", "--window-ms", "-3"]),
    ("EV020", ["reconstruct", "REC", "-o", "a.mp4", "--weights", "IMAGES", "--scale", "-3"]),
    ("EV020", ["reconstruct", "REC", "-o", "a.mp4", "--weights", "IMAGES", "--scale", "1000"]),
    ("EV020", ["flow", "REC", "-o", "a.mp4", "--weights", "FLOW", "--scale", "0"]),
    ("EV020", ["flow", "REC", "-o", "a.mp4", "--weights", "FLOW", "--fps", "0"]),
    ("EV020", ["estimate", "REC", "-o", "cam", "--no-plots", "--no-report", "--reconstruct"]),
    ("EV020", ["estimate", "REC", "-o", "cam", "--no-plots", "--no-report", "--protocol", "static",
               "--reconstruct"])])
def test_what_is_refused_leaves_nothing(
    flight: Path, weights: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch, said: str, command: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    known = {"REC": str(flight), "FLOW": weights["flow"], "IMAGES": weights["images"]}
    assert main([known.get(word, word) for word in command]) in (1, 2)
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("fps", [1e3 / 7, 1e6 / 9001, 146.259, 119.88, 23.976, 240.0, 0.1])
def test_films_of_any_rate_are_written(fps: float, tmp_path: Path) -> None:
    picture = np.zeros((32, 32, 3), np.uint8)
    write_video(tmp_path / "a.mp4", iter([picture] * 3), 3, fps=fps)
    capture = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-4)
    capture.release()


def test_frames_after_all_events_are_told(
    weights: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = make(count=12, span=700_000)
    t = made.events.t
    for shift, code in ((0, 0), (int(t[-1] - made.frame_times[0]) + 1, 1)):
        path, out = tmp_path / f"{shift}.npz", tmp_path / f"{shift}.mp4"
        moved = dataclasses.replace(made, frame_times=made.frame_times + shift)
        write_recording(path, moved, "npz")
        assert main(["flow", str(path), "-o", str(out), "--weights", weights["flow"]]) == code
        assert ("EV012" in capsys.readouterr().err) == bool(code)
    # All events lie between two frames: the second is made of them.
    between = dataclasses.replace(
        made, frames=made.frames[:2], frame_times=np.array([t[0] - 1, t[-1] + 1]))
    write_recording(tmp_path / "two.npz", between, "npz")
    assert main(["reconstruct", str(tmp_path / "two.npz"), "-o", str(tmp_path / "two.mp4"),
                 "--weights", weights["images"], "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scores"]["frames"] == 1


def test_narrow_sensors_are_not_enlarged_beyond_what_codecs_take(tmp_path: Path) -> None:
    for shape in ((29, 1, 3), (300, 10, 3)):
        picture = enlarged(np.zeros(shape))
        assert 3000 < picture.shape[0] <= 4096
        write_video(tmp_path / f"{shape[1]}.mp4", iter([picture, picture]), 2, fps=10.0)


@pytest.mark.slow
def test_estimate_of_made_frames_says_that_they_are(
    weights: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare.npz"
    write_events(bare, make(8000, span=700_000).events, format="npz")
    command = ["estimate", str(bare), "-o", str(tmp_path / "cam"), "--no-plots", "--no-report",
               "--no-checks", "--reconstruct", "--reconstruct-weights", weights["images"]]
    assert main(command) == 0
    assert "not measured light" in capsys.readouterr().out
    found = json.loads((tmp_path / "cam" / "camera.json").read_text())
    assert found["notes"][0]["code"] == "theta.guessed"
    for name in ("theta_on", "sigma_off"):
        assert found["summary_std"][name] > 0.9 * video.GUESS_ERROR * found["summary"][name]
    assert "frames.made" in [note["code"] for note in found["recording_notes"]]
