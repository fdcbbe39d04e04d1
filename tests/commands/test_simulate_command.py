"""evflow simulate, end to end: every kind of input, colour, interruption, bounded memory."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.videos import drifting

from evflow import read_events, write_events
from evflow.camera import PARAMETERS, Camera
from evflow.cli import main
from evflow.io.images.frames import FrameSource
from evflow.light.colour import mosaic
from evflow.types import Events, Recording

SHAPE = (24, 32)
COUNT = 10


def colour_frames(count: int = COUNT, speed: float = 0.5) -> np.ndarray:
    """(T, H, W, 3) BGR: red moves, green is dim, blue is the negative of red."""
    red = drifting(count, SHAPE, speed).astype(np.uint8)
    return np.stack([255 - red, red // 4, red], -1)


def simulate(capsys: pytest.CaptureFixture[str], source: Path, out: Path,
             *options: str) -> tuple[Events, dict[str, Any], str]:
    """The events, the facts printed as JSON and stderr of one run."""
    assert main(["simulate", str(source), "-o", str(out), "--json", *options]) == 0
    printed = capsys.readouterr()
    facts = json.loads(printed.out)
    events = read_events(out)
    assert facts["events"] == len(events)
    return events, facts, printed.err


def same(a: Events, b: Events) -> bool:
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("x", "y", "t", "p"))


def test_every_kind_of_input_gives_the_same_events(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One video as stack, archive, folder with times, lossless video and recording."""
    bgr = colour_frames()
    grey = np.stack([cv2.cvtColor(f, cv2.COLOR_BGR2GRAY) for f in bgr])
    times = 10_000 * np.arange(COUNT)
    np.save(tmp_path / "a.npy", bgr[..., ::-1])
    np.savez(tmp_path / "a.npz", frames=grey, times=times)
    (tmp_path / "a").mkdir()
    for i, frame in enumerate(bgr):
        cv2.imwrite(str(tmp_path / "a" / f"{i}.png"), frame)
    (tmp_path / "a" / "timestamps.txt").write_text("\n".join(map(str, times / 1000)))
    none = np.zeros(0, int)
    write_events(tmp_path / "a.h5", Recording(
        Events(none, none, none, none, SHAPE[::-1]), grey, times))
    linear = ["--response", "linear"]
    runs = {"a.npy": ["--fps", "100"], "a.npz": [], "a": linear, "a.h5": []}
    writer = cv2.VideoWriter(
        str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"FFV1"), 100.0, SHAPE[::-1])
    if writer.isOpened():  # not every build of OpenCV can
        for frame in bgr:
            writer.write(frame)
        runs["a.avi"] = linear
    writer.release()
    made = {name: simulate(capsys, tmp_path / name, tmp_path / f"{name}.out.h5", *options)
            for name, options in runs.items()}
    events = made["a.npy"][0]
    assert len(events) > 200
    assert events.t[-1] <= 90_000
    for name, (other, facts, _) in made.items():
        assert facts["frames"] == COUNT
        if name != "a.avi":  # whose codec rounds colours by a DN
            assert same(other, events), name
    if "a.avi" in made:
        assert abs(len(made["a.avi"][0]) / len(events) - 1) < 0.05
    assert "read in ms (100 frames/s)" in made["a"][2]
    assert made["a"][1]["notes"][0]["text"] in made["a"][2]


@pytest.mark.parametrize("interpolate", [True, False])
def test_a_colour_camera(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], interpolate: bool
) -> None:
    """Red brightens where blue darkens; raw mosaics give the same events as colour frames."""
    bgr = colour_frames()
    np.save(tmp_path / "rgb.npy", bgr[..., ::-1])
    np.save(tmp_path / "raw.npy", np.stack([mosaic(f, "grbg") for f in bgr]))
    options = ["--fps", "100", "--colour", "grbg",
               *([] if interpolate else ["--no-interpolate"])]
    events, facts, _ = simulate(capsys, tmp_path / "rgb.npy", tmp_path / "rgb.h5", *options)
    raw, _, err = simulate(capsys, tmp_path / "raw.npy", tmp_path / "raw.h5", *options)
    assert facts["colour"] == "grbg"
    assert "mosaic" in err
    if interpolate:
        assert abs(len(raw) / len(events) - 1) < 0.2
    else:
        assert same(raw, events)
    on, off = events.count_map().astype(float)
    net = on - off
    red, blue = net[0::2, 1::2], net[1::2, 0::2]
    assert np.corrcoef(red.ravel(), blue.ravel())[0, 1] < -0.5
    grey, _, _ = simulate(capsys, tmp_path / "rgb.npy", tmp_path / "grey.h5", "--fps", "100")
    assert len(grey) != len(events)


def test_interpolation_and_its_limit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A bar that moves 4 px per frame: interpolated, its events spread over its way; by whole
    frames they pile up. Motion beyond all measure is warned of."""
    def bar(step: int, count: int = 4) -> np.ndarray:
        frames = np.full((count, 48, 160), 40, np.uint8)
        texture = np.random.default_rng(0).integers(120, 250, (48, 20), np.uint8)
        for i in range(count):
            frames[i, :, 10 + step * i : 30 + step * i] = cv2.GaussianBlur(texture, (0, 0), 1.5)
        return frames

    np.save(tmp_path / "a.npy", bar(4))
    made = {}
    for option in ("--interpolate", "--no-interpolate"):
        made[option], facts, _ = simulate(
            capsys, tmp_path / "a.npy", tmp_path / f"{option}.h5", "--fps", "25", option)
        assert facts["frames"] == 4
    finer, _, _ = simulate(capsys, tmp_path / "a.npy", tmp_path / "fine.h5", "--fps", "25",
                           "--max-motion", "0.25")
    off, _, _ = simulate(capsys, tmp_path / "a.npy", tmp_path / "off.h5", "--fps", "25",
                         "--max-motion-px", "0")
    assert same(off, made["--no-interpolate"])
    assert not same(finer, made["--interpolate"])
    # The front reaches column 31..33 within the first frame, one column each 10 ms.
    late = [made[o].slice(0, 40_000) for o in ("--interpolate", "--no-interpolate")]
    spread = [np.polyfit(e.x[e.p & (e.x >= 30) & (e.x < 34)],
                         e.t[e.p & (e.x >= 30) & (e.x < 34)], 1)[0] for e in late]
    assert spread[0] > 5000
    assert abs(spread[1]) < 0.4 * spread[0]
    np.save(tmp_path / "far.npy", bar(60, 2))
    _, facts, err = simulate(capsys, tmp_path / "far.npy", tmp_path / "far.h5", "--fps", "25",
                             "--max-motion", "0.1")
    assert "too fast to interpolate well" in err
    assert [note["code"] for note in facts["notes"]][-2:] == ["frames.fast", "frames.flow"]


def test_errors_leave_nothing_and_exit_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.h5"
    np.save(tmp_path / "one.npy", colour_frames(1))
    np.save(tmp_path / "late.npy", np.where(np.arange(8)[:, None, None] == 6, np.nan,
                                            drifting(8, SHAPE)))
    np.savez(tmp_path / "times.npz", frames=drifting(3, SHAPE), t=np.array([0, 5, 5]))
    for code, name, options in (
        ("EV001", "one.npy", ["--fps", "10"]), ("EV007", "late.npy", ["--fps", "10"]),
        ("EV020", "one.npy", []), ("EV020", "one.npy", ["--fps", "0"]),
        ("EV004", "times.npz", ["--time-unit", "ms"]), ("EV016", "none.mp4", []),
        ("EV016", "one.npy", ["--timestamps", str(tmp_path / "no.txt")]),
    ):
        status = main(["simulate", str(tmp_path / name), "-o", str(out), *options])
        assert status == (2 if code == "EV020" else 1)
        error = capsys.readouterr().err
        assert error.startswith(code), error
        assert "Traceback" not in error
        assert not list(tmp_path.glob("*out*")), "a file, whole or half, was left"


def test_nothing_is_overwritten_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "a.npy", drifting(4, SHAPE))
    out = tmp_path / "out.h5"
    out.write_text("dear to me")
    command = ["simulate", str(tmp_path / "a.npy"), "-o", str(out), "--fps", "100"]
    assert main(command) == 1
    assert "EV013" in capsys.readouterr().err
    assert out.read_text() == "dear to me"
    assert main([*command, "--overwrite"]) == 0
    assert len(read_events(out)) > 0


def endless() -> Iterator[tuple[np.ndarray, int]]:
    frames = drifting(20, SHAPE).astype(np.uint8)
    for i in itertools.count():
        yield frames[i % 20], 1000 * i


def test_ctrl_c_leaves_no_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted() -> Iterator[tuple[np.ndarray, int]]:
        yield from itertools.islice(endless(), 150)
        assert list(tmp_path.glob(".out.h5*"))  # it is being written
        raise KeyboardInterrupt

    monkeypatch.setattr("evflow.io.source.open_frames",
                        lambda *_, **__: FrameSource(SHAPE[::-1], 0, interrupted))
    assert main(["simulate", "x", "-o", str(tmp_path / "out.h5")]) == 130
    assert "no half-written file" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_terminated_from_outside_it_leaves_no_file(tmp_path: Path) -> None:
    """SIGTERM, as a scheduler sends it, to a run that would never end."""
    work = tmp_path / "out"
    work.mkdir()
    script = (
        "import sys; sys.path[:0] = ['tests/commands', 'tests', '.']\n"
        "import evflow.io.source, evflow.cli\n"
        "from evflow.io.images.frames import FrameSource\n"
        "from test_simulate_command import endless, SHAPE\n"
        "evflow.io.source.open_frames = lambda *_, **__: FrameSource(SHAPE[::-1], 0, endless)\n"
        f"sys.exit(evflow.cli.main(['simulate', 'x', '-o', {str(work / 'out.h5')!r}]))\n")
    with subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE,
                          cwd=Path(__file__).parents[2], env=os.environ) as run:
        try:
            deadline = time.monotonic() + 100
            while run.poll() is None and not list(work.iterdir()):
                assert time.monotonic() < deadline
                time.sleep(0.05)
            run.terminate()
            _, err = run.communicate(timeout=60)
        finally:
            run.kill()
    assert run.returncode == 130, err.decode()
    assert list(work.iterdir()) == []


@pytest.mark.parametrize("colour", ["luma", "rggb"])
def test_a_long_video_holds_few_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, colour: str
) -> None:
    """400 frames pass; alive at once are three blocks of eight, and a few on their way."""
    alive, most = set(), 0

    def watched() -> Iterator[tuple[np.ndarray, int]]:
        nonlocal most
        for i, (frame, t) in enumerate(itertools.islice(endless(), 400)):
            fresh = frame.copy() if colour == "luma" else np.stack([frame] * 3, -1)
            alive.add(i)
            weakref.finalize(fresh, alive.discard, i)
            most = max(most, len(alive))
            yield fresh, t
            del fresh

    monkeypatch.setattr("evflow.io.source.open_frames",
                        lambda *_, **__: FrameSource(SHAPE[::-1], 400, watched))
    out = tmp_path / "out.h5"
    assert main(["simulate", "x", "-o", str(out), "--colour", colour, "--no-interpolate"]) == 0
    assert 1 <= most <= 3 * 8 + 8
    assert len(alive) <= 1
    assert read_events(out).t[-1] > 390_000


def test_help_shows_examples(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["simulate", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "Example: evflow simulate ride.mp4" in text
    for option in ("--timestamps", "--colour", "--fps", "--max-motion", "--no-interpolate",
                   "--partial", "--full-scale", "--time-unit", "--overwrite"):
        assert option in text, option


@pytest.mark.parametrize("sensor", ["noisy", "esim", "dvs240"])
def test_sensors_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str], sensor: str) -> None:
    """Each by its own thresholds; one threshold given replaces that one."""
    np.save(tmp_path / "a.npy", colour_frames()[..., 1])
    options = ["--fps", "100", "--sensor", sensor]
    events, facts, _ = simulate(capsys, tmp_path / "a.npy", tmp_path / "a.h5", *options)
    assert facts["sensor"] == sensor
    assert len(events) > 200
    fewer, _, _ = simulate(capsys, tmp_path / "a.npy", tmp_path / "b.h5", *options,
                           "--theta-on", "0.6")
    assert fewer.p.sum() < 0.7 * events.p.sum()


def test_a_measured_camera_is_drawn_only_where_it_has_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "v.npy", colour_frames())
    plain, estimate = tmp_path / "plain.npz", tmp_path / "estimate.npz"
    camera = Camera.constant(SHAPE, 0.2, 0.2)
    camera.save(plain)
    camera.save(estimate, **{f"{n}_std": np.full(SHAPE, 0.05, np.float32) for n in PARAMETERS})
    given = (tmp_path / "v.npy", "--fps", "100", "--no-interpolate")
    even, uneven, again = (
        simulate(capsys, given[0], tmp_path / f"{i}.h5", *given[1:], "--camera", str(estimate),
                 *more)[0] for i, more in enumerate(((), ("--draw",), ("--draw",))))
    assert not same(even, uneven)
    assert same(uneven, again)
    for options in (("--camera", str(plain), "--draw"),
                    ("--camera", str(plain), "--theta-on", "0.3"),
                    ("--camera", str(plain), "--eta-off", "1")):
        assert main(["simulate", *map(str, given), "-o", str(tmp_path / "no.h5"), *options]) == 2
        assert "EV020" in capsys.readouterr().err


def test_an_exposure_that_the_estimate_saw_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is the recording's, not the camera's: other frames may have another."""
    none = np.zeros(0, int)
    frames = drifting(COUNT, SHAPE, 0.5).astype(np.uint8)
    write_events(tmp_path / "own.h5", Recording(
        Events(none, none, none, none, SHAPE[::-1]), frames, 40_000 * np.arange(COUNT)))
    np.save(tmp_path / "other.npy", frames)
    Camera.constant(SHAPE, 0.2, 0.2).save(
        tmp_path / "camera.npz", optics_exposure_s=np.asarray(0.0188),
        optics_exposure_s_std=np.asarray(0.003))
    camera = "--camera", str(tmp_path / "camera.npz")
    for source, options, told in (("own.h5", camera, True), ("own.h5", (), False),
                                  ("own.h5", (*camera, "--exposure-ms", "19"), False),
                                  ("other.npy", (*camera, "--fps", "25"), False)):
        _, facts, _ = simulate(capsys, tmp_path / source, tmp_path / "out.h5", "--overwrite",
                               *options)
        said = [note["text"] for note in facts["notes"] if note["code"] == "frames.blur"]
        assert len(said) == told
        assert all("--exposure-ms 19 takes the blur out" in text for text in said)
