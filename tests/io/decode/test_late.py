"""Times that go back: which events are kept, what is said, and that every advice works."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import equal, refused
from helpers.streams import ENCODERS, clustered
from helpers.streams import SIZE as SENSOR

from evflow.cli import main
from evflow.io import read_events, read_recording
from evflow.io.decode.late import longest
from evflow.types import Events

SIZE = (64, 48)
Fault = Callable[[np.ndarray], np.ndarray]


def table(t: Any, seed: int = 0) -> dict[str, np.ndarray]:
    rng, n = np.random.default_rng(seed), len(t)
    return {"t": np.asarray(t), "x": rng.integers(0, 64, n), "y": rng.integers(0, 48, n),
            "p": rng.integers(0, 2, n)}


def rows(columns: dict[str, np.ndarray], kept: Any) -> Events:
    """Those rows of the table, in that order."""
    x, y, t, p = (columns[name][kept] for name in "xytp")
    return Events(x, y, t, p, SIZE)


def npz(folder: Path, columns: dict[str, np.ndarray]) -> Path:
    np.savez(folder / "a.npz", size=np.array(SIZE), **columns)
    return folder / "a.npz"


def text(folder: Path, columns: dict[str, np.ndarray]) -> Path:
    lines = [f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in zip(
        *(columns[c].tolist() for c in "txyp"), strict=True)]
    (folder / "a.txt").write_text(f"{SIZE[0]} {SIZE[1]}\n" + "".join(lines))
    return folder / "a.txt"


def dsec(folder: Path, columns: dict[str, np.ndarray]) -> Path:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "a.h5", "w") as f:
        for name in "xyp":
            f[f"events/{name}"] = columns[name].astype("u2")
        f.create_dataset("events/t", data=columns["t"], chunks=(64,))
        f.attrs["width"], f.attrs["height"] = SIZE
    return folder / "a.h5"


def bag(folder: Path, columns: dict[str, np.ndarray]) -> Path:
    """Two events a message: chunks are small."""
    pytest.importorskip("rosbags")
    import struct

    from helpers.bags import ARRAY, header, write

    messages = []
    for i in range(0, len(columns["t"]), 2):
        part = list(zip(*(columns[c][i : i + 2].tolist() for c in "xytp"), strict=True))
        data = b"".join(struct.pack("<2H2IB", x, y, t // 10**6, t % 10**6 * 1000, p)
                        for x, y, t, p in part)
        messages.append(("/e", ARRAY, i, header(i) + struct.pack("<3I", 48, 64, len(part)) + data))
    return write(folder / "a.bag", messages)


FILES = {"npz": npz, "text": text, "dsec": dsec, "bag": bag}
each = pytest.mark.parametrize("kind", FILES)
T = 1000 * np.arange(2000)  # 2 s


def changed(**at: int) -> np.ndarray:
    t = T.copy()
    for place, time in at.items():
        t[int(place[1:])] = time
    return t


@each
@pytest.mark.parametrize("block", [5, 1 << 15])
def test_one_event_back_or_ahead_is_left_out_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, block: int
) -> None:
    """What goes is that event, whichever way its time is wrong; `sort` keeps all."""
    monkeypatch.setattr("evflow.io.decode.tables.ROWS", block)
    for wrong, times in ((1000, changed(_1000=901_000)), (1000, changed(_1000=9_000_000)),
                         (0, changed(_0=5_000_000)), (1999, changed(_1999=17))):
        columns = table(times)
        path = FILES[kind](tmp_path, columns)
        assert refused(path).code == "EV004"
        got = read_recording(path, late="drop")
        equal(got.events, rows(columns, np.delete(np.arange(2000), wrong)))
        assert [n.code for n in got.notes] == ["events.late"]
        assert got.notes[0].text.startswith("1 of 2,000 events")
        got = read_recording(path, late="sort")
        equal(got.events, rows(columns, np.argsort(times, kind="stable")))
        assert got.notes[0].code == "events.late"


@each
def test_what_lies_behind_is_reached_by_start(tmp_path: Path, kind: str) -> None:
    for wrong in (901_000, 9_000_000):
        columns = table(changed(_1000=wrong))
        path = FILES[kind](tmp_path, columns)
        equal(read_events(path, start_s=1.2), rows(columns, slice(1200, None)))
        equal(read_events(path, start_s=1.2, stop_s=1.5), rows(columns, slice(1200, 1500)))
        equal(read_events(path, stop_s=0.8), rows(columns, slice(0, 800)))
        assert refused(path, start_s=0.95, stop_s=1.5).code == "EV004"  # the fault lies within
        for late in ("drop", "sort"):
            equal(read_events(path, start_s=1.2, late=late, stop_s=1.5),
                  rows(columns, slice(1200, 1500)))
        equal(read_events(path, start_s=0.95, stop_s=1.5, late="drop"),
              rows(columns, [*range(950, 1000), *range(1001, 1500)]))


def advised(path: Path) -> list[Events]:
    """What the error's own advice reads, every option of it."""
    error = refused(path)
    assert error.code == "EV004"
    found = [read_events(path, late=late) for late in re.findall(r"--late (\w+)", error.fix)]
    stop = float(re.findall(r"stop_s=([\d.]+)", error.fix)[0])
    return [*found, read_events(path, stop_s=stop), read_events(path, partial=True)]


@each
@pytest.mark.parametrize(("times", "said", "counts"), [
    (changed(_1000=901_000), "overtaken", [1999, 2000, 999, 1000]),
    (changed(_1000=9_000_000), "The 1 events before it are ahead", [1999, 999, 1001]),
    (np.concatenate([T + 5_000_000, T]), "joined", [4000, 1999, 2000])])
def test_the_message_fits_the_cause_and_its_advice_works(
    tmp_path: Path, kind: str, times: np.ndarray, said: str, counts: list[int]
) -> None:
    path = FILES[kind](tmp_path, table(times))
    if kind != "bag":  # whose chunks show two events at a time
        assert said in refused(path).fix
        assert [len(events) for events in advised(path)] == counts
    else:
        assert len(advised(path)) >= 3


@each
@pytest.mark.parametrize("order", ["newest first", "by pixel", "by polarity"])
def test_what_never_was_in_order_is_to_be_sorted(tmp_path: Path, kind: str, order: str) -> None:
    """To leave out late events would leave next to nothing: it is not advised, and said if done."""
    columns = table(T)
    by = {"newest first": -T, "by pixel": columns["x"], "by polarity": columns["p"]}[order]
    rank = np.argsort(by, kind="stable")
    path = FILES[kind](tmp_path, {name: column[rank] for name, column in columns.items()})
    if kind != "bag":  # whose chunks show two events at a time
        fix = refused(path).fix
        assert "--late sort" in fix
        assert "--late drop" not in fix
    assert len(read_events(path, late="sort")) == len(T)
    got = read_recording(path, late="drop")
    assert len(got.events) < 0.9 * len(T)
    assert "never were in order; --late sort keeps them" in got.notes[0].text


def test_a_first_event_far_ahead_is_no_other_clock(tmp_path: Path) -> None:
    for kind in ("npz", "text"):
        path = FILES[kind](tmp_path, table(changed(_0=10**15)))
        error = refused(path)
        assert "The 1 events before it are ahead" in error.fix
        assert "join" not in error.fix
        assert len(read_events(path, late="drop")) == 1999


def test_a_step_back_that_is_not_joined_is_said_to_be_none(tmp_path: Path) -> None:
    path = npz(tmp_path, table(np.concatenate([T[:600], T[:600]])))
    assert "Two recordings, one behind the other?" in refused(path).fix
    assert "more than 1 s for another clock, and this is one of 0.599 s" in refused(
        path, late="join").fix


@each
def test_clocks_are_put_one_behind_the_other(tmp_path: Path, kind: str) -> None:
    columns = table(np.concatenate([T + 5_000_000, T + 40]))
    path = FILES[kind](tmp_path, columns)
    want = Events(columns["x"], columns["y"], np.concatenate([T, T + 1_999_000]) + 5_000_000,
                  columns["p"], SIZE)
    got = read_recording(path, late="join")
    equal(got.events, want)
    assert "restarted 1 times" in got.notes[0].text
    equal(read_events(path, late="join", start_s=2.0), want.slice(7_000_000, 2**60))


@pytest.mark.parametrize("dtype", [np.uint32, np.int32])
def test_times_of_32_bits_go_on_where_they_begin_anew(tmp_path: Path, dtype: Any) -> None:
    whole = T + 2 ** (32 if dtype == np.uint32 else 31) - int(T[-1]) // 2
    path = npz(tmp_path, table(whole.astype(np.uint32).view(dtype)))
    assert "32 bits that begin anew" in refused(path).fix
    np.testing.assert_array_equal(read_events(path, late="join").t, whole)


@pytest.mark.parametrize(("t", "said"), [
    (T.astype(np.uint16), "too few bits"), (T % 50_000, "relative to their packet or frame"),
    (np.concatenate([T[:900], T[850:]]), "--late drop")])
def test_what_begins_anew_is_not_late(tmp_path: Path, t: np.ndarray, said: str) -> None:
    assert said in refused(npz(tmp_path, table(t))).fix


@pytest.mark.parametrize(("side", "dtype", "told"), [
    (64, np.uint8, False), (346, np.uint8, True), (346, np.uint16, False)])
def test_coordinates_of_too_few_bits_are_told(
    tmp_path: Path, side: int, dtype: Any, told: bool
) -> None:
    columns = table(T)
    path = tmp_path / "a.npz"
    np.savez(path, **(columns | {"x": columns["x"].astype(dtype), "size": (side, 48)}))
    assert ("events.narrow" in [note.code for note in read_recording(path).notes]) == told


@pytest.mark.parametrize("kind", ENCODERS)
def test_streams_of_cameras_drop_and_sort(tmp_path: Path, kind: str) -> None:
    """An early burst between two parts of a recording, as a packet that was overtaken."""
    one, early, other = clustered(300, 900_000), clustered(40, 850_000), clustered(
        300, 960_000, seed=1)
    data = ENCODERS[kind](one)
    for part in (early, other):
        more = ENCODERS[kind](part, b"")
        data += more[2:] if kind == "dat" else more
    path = tmp_path / {"aedat2": "a.aedat", "dat": "a.dat"}.get(kind, "a.raw")
    path.write_bytes(data)
    assert refused(path).code == "EV004"
    equal(read_events(path, late="drop"), Events.concatenate([one, other]))
    both = [np.concatenate([getattr(part, c) for part in (one, early, other)]) for c in "xytp"]
    order = np.argsort(both[2], kind="stable")
    equal(read_events(path, late="sort"), Events(*(c[order] for c in both), SENSOR))
    start = (int(other.t[0]) - int(one.t[0])) / 1e6
    equal(read_events(path, start_s=start), other)


def test_the_most_events_are_kept() -> None:
    """Against all subsequences of short lists."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        t = rng.integers(0, 8, rng.integers(1, 10))
        best = [1] * len(t)
        for i in range(len(t)):
            best[i] = 1 + max((best[j] for j in range(i) if t[j] <= t[i]), default=0)
        kept = longest(t)
        assert len(kept) == max(best)
        assert (np.diff(t[kept]) >= 0).all()
        assert (np.diff(kept) > 0).all()


def test_frames_whose_time_goes_back(tmp_path: Path) -> None:
    frames = np.arange(5 * 48 * 64, dtype=np.uint8).reshape(5, 48, 64)
    at = np.array([0, 100, 50, 200, 300]) * 1000
    columns = table(T) | {"frames": frames, "frame_times": at}
    path = npz(tmp_path, columns)
    error = refused(path)
    assert error.code == "EV004"
    assert "--late drop, or sort. To read only the events: --no-frames" in error.fix
    got = read_recording(path, late="sort")
    assert got.frame_times.tolist() == [0, 50_000, 100_000, 200_000, 300_000]
    np.testing.assert_array_equal(got.frames, frames[[0, 2, 1, 3, 4]])
    got = read_recording(path, late="drop")
    assert len(got.frames) == 4
    assert [note.code for note in got.notes] == ["frames.late"]
    assert not read_recording(path, late="join").has_frames


def test_the_command_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = npz(tmp_path, table(changed(_1000=901_000)))
    assert main(["info", str(path)]) == 1
    assert "--late drop" in capsys.readouterr().err
    assert main(["info", str(path), "--late", "drop"]) == 0
    assert "1 of 2,000 events" in capsys.readouterr().out


def test_damage_behind_late_events_is_told(tmp_path: Path) -> None:
    path = text(tmp_path, table(changed(_1000=901_000)))
    path.write_text(path.read_text() + "1.9 5 five 1\n")
    assert refused(path, late="drop").code == "EV009"
    assert len(read_events(path, late="drop", partial=True)) == 1999
    assert len(read_events(path, late="sort", stop_s=0.9)) == 900
    assert dataclasses.is_dataclass(read_events(path, late="sort", partial=True))
