"""Films and sheets of events: they open again, show what happened, and are never half-written."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.recordings import make
from PIL import Image

from evflow import Events, EvflowDataError, Recording, write_events
from evflow.cli import main
from evflow.report import movie
from evflow.report.caption import captioned
from evflow.report.movie import Film, write_film, write_sheet
from evflow.report.plots import new_figure, save_figure
from evflow.report.video import write_video


def two_corners() -> Recording:
    """ON at the top left for 100 ms, then OFF at the bottom right, every millisecond; frames grey
    below and brighter above."""
    t = np.arange(200) * 1000
    late = t >= 100_000
    events = Events(np.where(late, 60, 3), np.where(late, 40, 2), t, ~late, (64, 48))
    frames = np.full((3, 48, 64), 60, np.uint8)
    frames[:, :24] = 120
    return Recording(events, frames, np.array([0, 100_000, 200_000]))


def pictures(path: Path, gif_ms: int = 40) -> list[np.ndarray]:
    """RGB, as a player sees them; a GIF's stand for as many as their time takes."""
    shown: list[np.ndarray] = []
    if path.suffix == ".gif":
        with Image.open(path) as film:
            for i in range(film.n_frames):
                film.seek(i)
                shown += [np.asarray(film.convert("RGB"))] * (film.info["duration"] // gif_ms)
        return shown
    capture = cv2.VideoCapture(str(path))
    while (read := capture.read())[0]:
        shown.append(read[1][..., ::-1])
    capture.release()
    return shown


@pytest.mark.parametrize(("name", "codec"), [
    ("a.mp4", "mpeg4"), ("a.mp4", "vp9"), ("a.gif", "mpeg4")])
def test_a_film_shows_events_when_they_come(tmp_path: Path, name: str, codec: str) -> None:
    path = tmp_path / name
    film = Film(fps=25.0, window_us=10_000, slow=4.0, scale=4, codec=codec)  # type: ignore[arg-type]
    said = write_film(path, two_corners(), film)
    assert "20 pictures, 0.8 s" in said
    shown = pictures(path)
    assert len(shown) == 20  # 200 ms, 10 ms of them a picture
    first, last = shown[3].astype(int), shown[16].astype(int)
    assert first.shape == (192, 256, 3)
    top, bottom = (slice(8, 12), slice(12, 16)), (slice(160, 164), slice(240, 244))
    assert first[top][..., 0].mean() > first[top][..., 2].mean() + 60  # red
    assert last[bottom][..., 2].mean() > last[bottom][..., 0].mean() + 60  # blue
    assert first[bottom].min() > 235
    assert last[top].min() > 235


def test_pictures_of_so_many_events(tmp_path: Path) -> None:
    """40 of 200 each: five pictures, of which the middle one turns from ON to OFF."""
    film = Film(fps=5.0, scale=4, window_events=40)
    assert "5 pictures, 1.0 s" in write_film(tmp_path / "a.mp4", two_corners(), film)
    shown = [picture.astype(int) for picture in pictures(tmp_path / "a.mp4")]
    on = [bool(picture[8:12, 12:16].min() < 200) for picture in shown]
    off = [bool(picture[160:164, 240:244].min() < 200) for picture in shown]
    assert on == [True, True, True, False, False]
    assert off == [False, False, True, True, True]
    for at_s, count in ((0.05, 40), (0.0, 40), (0.199, 40), (None, 1000)):
        said = write_sheet(tmp_path / "a.png", two_corners(), Film(window_events=count),
                           at_s=at_s, overwrite=True)
        assert said.startswith(f"{min(count, 200)} events")
    command = ["render", "x", "-o", str(tmp_path / "b.mp4"), "--window-events", "10"]
    assert main([*command, "--slow", "2"]) == 2


def test_events_over_frames(tmp_path: Path) -> None:
    path = tmp_path / "over.gif"
    write_film(path, two_corners(), Film(window_us=10_000, over_frames=True, scale=2))
    shown = pictures(path, 30)[1].astype(int)
    assert shown[4, 6, 0] > shown[4, 6, 2] + 60
    assert shown[20, 100].mean() > 1.8 * shown[80, 60].mean() > 100


def test_a_sheet_has_frame_events_and_both(tmp_path: Path) -> None:
    recording = two_corners()
    assert write_sheet(tmp_path / "a.png", recording, Film(window_us=20_000, scale=2), at_s=0.05)
    sheet = cv2.imread(str(tmp_path / "a.png"))[..., ::-1].astype(int)
    assert sheet.shape == (96, 3 * 128 + 2 * movie.GAP, 3)
    events = sheet[:, 128 + movie.GAP:256 + movie.GAP]
    assert events[4, 6, 0] > events[4, 6, 2] + 60
    assert np.ptp(sheet[:, :128].mean((1, 2))) > 80
    bare = Recording.of_events(recording.events)
    write_sheet(tmp_path / "bare.png", bare, Film(scale=1))
    assert cv2.imread(str(tmp_path / "bare.png")).shape == (48, 64, 3)


def test_a_gif_lasts_as_long_as_it_says(tmp_path: Path) -> None:
    """A browser shows no more than 50 pictures a second, and times are hundredths of a second."""
    for fps, said, lasts in ((40.0, "40 pictures, 1.0 s", 1000), (100.0, "50 of them", 1000)):
        path = tmp_path / f"{fps}.gif"
        images = (np.full((16, 16, 3), 2 * i, np.uint8) for i in range(round(fps)))
        assert said in write_video(path, images, round(fps), fps=fps)
        with Image.open(path) as film:
            times = [film.seek(i) or film.info["duration"] for i in range(film.n_frames)]
        assert sum(times) == lasts
        assert set(times) <= {20, 30}


def test_a_clock_that_jumps_takes_no_memory(tmp_path: Path) -> None:
    t = np.append(np.arange(500, dtype=np.int64) * 1000, 1_700_000_000_000_000)
    recording = Recording.of_events(Events(t % 8, t % 6, t, t % 2 == 0, (8, 6)))
    assert "33 events of 33 ms" in write_sheet(tmp_path / "a.png", recording, Film())
    with pytest.raises(EvflowDataError, match=r"EV026.*clock jump"):
        write_film(tmp_path / "a.mp4", recording, Film())


def test_odd_sizes_become_even(tmp_path: Path) -> None:
    events = Events([0], [0], [5], [True], (33, 21))
    write_film(tmp_path / "odd.mp4", Recording.of_events(events), Film(scale=1))
    assert pictures(tmp_path / "odd.mp4")[0].shape == (22, 34, 3)


def test_an_interrupted_film_leaves_nothing(tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    for name in ("a.mp4", "a.gif"):
        with pytest.raises(KeyboardInterrupt):
            write_film(tmp_path / name, two_corners(), Film(), progress=stop)
    assert not list(tmp_path.iterdir())


def test_a_film_that_cannot_be_read_again_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = movie._pictures

    def short(*args: object) -> object:
        return list(real(*args))[:-2].__iter__()  # type: ignore[arg-type]

    monkeypatch.setattr(movie, "_pictures", short)
    with pytest.raises(EvflowDataError, match="EV019"):
        write_film(tmp_path / "a.mp4", two_corners(), Film())
    assert not list(tmp_path.iterdir())


def test_what_is_refused(tmp_path: Path) -> None:
    recording = two_corners()
    bare = Recording.of_events(recording.events)
    silent = Recording.of_events(recording.events.slice(0, 0))
    (tmp_path / "there.mp4").write_bytes(b"mine")
    long = Film(fps=240.0, slow=100.0)
    for code, name, of, film in (
        ("EV013", "there.mp4", recording, Film()), ("EV020", "a.avi", recording, Film()),
        ("EV011", "a.mp4", bare, Film(over_frames=True)), ("EV001", "a.mp4", silent, Film()),
        ("EV020", "a.gif", recording, long),
    ):
        with pytest.raises(EvflowDataError) as raised:
            write_film(tmp_path / name, of, film)
        assert raised.value.code == code
    assert (tmp_path / "there.mp4").read_bytes() == b"mine"
    for name in ("a.mp4", "a.gif"):
        with pytest.raises(EvflowDataError, match=r"EV019.*not written .no such folder"):
            write_film(Path("/proc") / name, recording, Film())
    for name, value in (("fps", 0.0), ("window_us", 0), ("slow", -1.0), ("scale", 99)):
        with pytest.raises(EvflowDataError, match="EV020"):
            Film(**{name: value})
    with pytest.raises(EvflowDataError, match="EV020"):
        write_sheet(tmp_path / "a.png", recording, Film(), at_s=7.0)


def test_render_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "rec.npz"
    write_events(source, make(), format="npz")
    for name in ("a.mp4", "a.gif", "a.png"):
        command = ["render", str(source), "-o", str(tmp_path / name)]
        assert main(command) == 0
        assert f"-> {tmp_path / name}" in capsys.readouterr().err
        assert main(command) == 1
        assert "EV013" in capsys.readouterr().err
        assert main([*command, "--overwrite", "--over-frames", "--scale", "1"]) == 0
    assert len(pictures(tmp_path / "a.mp4")) == 9  # 300 ms at 30 pictures a second


def test_a_film_of_a_clock_that_jumps_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t = np.append(np.arange(500, dtype=np.int64) * 1000, 15_500_000)
    events = Events(t % 8, t % 6, t, t % 2 == 0, (8, 6))
    for name, some, told in (("jump", events, True), ("whole", events.slice(0, 500_000), False)):
        write_events(tmp_path / f"{name}.npz", some, format="npz")
        assert main(["render", str(tmp_path / f"{name}.npz"), "-o", str(tmp_path / f"{name}.mp4"),
                     "--fps", "2"]) == 0
        said = capsys.readouterr().err
        assert ("no events for 15 s after 0.499 s" in said) == told
        assert ("--stop 0.499" in said) == told


def test_a_caption_is_a_strip_of_one_size() -> None:
    """Beneath, even, of the same letters whatever the digits; the picture itself is untouched."""
    picture = np.full((96, 320, 3), 7, np.uint8)
    one, other = (captioned(picture, f"{t} s   33 ms") for t in ("0.111", "88.888"))
    assert one.shape == other.shape == (112, 320, 3)
    assert (one[:96] == 7).all()
    assert one[96:].min() < 100  # ink
    assert (one[96:, 200:] == 255).all()
    assert captioned(picture[:, :40], "many words that do not fit")[96:].min() < 255


@pytest.mark.parametrize(("kind", "head"), [
    ("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml"), ("2", b"\x89PNG")])
def test_figures_are_what_their_ending_says(kind: str, head: bytes, tmp_path: Path) -> None:
    figure = new_figure(1.0, 1.0)
    save_figure(figure, tmp_path / f"a.{kind}", dpi=40)
    save_figure(figure, tmp_path / f"b.{kind}", dpi=40)
    first, second = ((tmp_path / f"{name}.{kind}").read_bytes() for name in "ab")
    assert first == second  # no date in it
    assert first.startswith(head)
