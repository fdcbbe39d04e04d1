"""The unit of times, from what is written, from rates, dates and spans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import refused

from evflow import check
from evflow.io import read_recording
from evflow.io.decode.misread import misread
from evflow.io.decode.units import (
    UNITS_US,
    other_unit,
    shared_unit,
    since_1970,
    too_large,
    usual_unit,
    video_unit,
    without_decimals,
    written_unit,
)
from evflow.types import Events

FRAMES_US = 40_000.0 * np.arange(26)


def events(count: int = 20_000, span_us: int = 1_000_000) -> Events:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, span_us + 1, count))
    x, y = rng.integers(0, 40, (2, count))
    return Events(x, y, t, rng.integers(0, 2, count), (40, 40))


@pytest.mark.parametrize(("words", "unit"), [
    ("timestamp [ns]", "ns"), ("t_us x y p", "us"), ("time in milliseconds", "ms"), ("t(s)", "s"),
    ("t[µs]", "us"), ("t x y p", "auto"), ("t[us] exposure[ms]", "auto")])
def test_a_unit_that_is_written(words: str, unit: str) -> None:
    assert written_unit(words) == unit


@pytest.mark.parametrize("unit", UNITS_US)
def test_frames_tell_their_unit_by_rate_date_and_events(unit: str) -> None:
    written = FRAMES_US / UNITS_US[unit]
    whole = written if unit in ("s", "ms") else np.rint(written).astype(np.int64)
    found, rates = video_unit(whole)
    assert found == unit
    assert rates[unit] == pytest.approx(25)
    assert usual_unit(whole, list(UNITS_US)) == unit
    assert shared_unit(whole, events().t, list(UNITS_US)) == unit
    assert since_1970(1.7e9 * 1e6 / UNITS_US[unit]) == [unit]
    fast = 1.7e15 / UNITS_US[unit] + 200.0 / UNITS_US[unit] * np.arange(9)  # 5,000 frames/s
    if unit in ("us", "ns"):
        assert video_unit(fast.astype(np.int64))[0] == unit  # the date tells


def test_a_clock_that_is_off_is_no_other_unit() -> None:
    t, us = events().t, FRAMES_US.astype(np.int64)
    assert other_unit(1000 * (us + 2_000_000), t + 2_000_000, "us") == "ns"
    for away in (10**7, 10**9, 10**9 + 400_000, 1_700_000_000_000_000):
        assert other_unit(us + away, t, "us") is None
        assert too_large(us + away, t) == ""
    assert other_unit(us[:0], t, "us") is None
    assert too_large(us, t[:0]) == ""


@pytest.mark.parametrize("first", [0, 500_000])
@pytest.mark.parametrize(("native", "unit"), [
    ("us", "ns"), ("us", "ms"), ("s", "us"), ("s", "ns"), ("ns", "ms")])
def test_frames_that_begin_with_the_events_tell_their_unit_by_their_rate(
    native: str, unit: str, first: int
) -> None:
    t = events().t
    frames = ((FRAMES_US + first) / UNITS_US[unit]).astype(np.int64)
    assert other_unit(frames, t, native) == unit
    assert other_unit(frames, t[t < 100_000] + first, native) == unit  # a part of the events
    if native == "us":
        assert too_large(frames, t) == ("1,000 times" if unit == "ns" else "1/1,000 of")


@pytest.mark.parametrize("step_us", [500, 5_000, 40_000, 1_000_000])
@pytest.mark.parametrize("count", [2, 100, 10_000])
def test_frames_may_last_longer_than_the_events_or_less(step_us: int, count: int) -> None:
    us = step_us * np.arange(count)
    assert other_unit(us, events().t, "us") is None
    assert too_large(us, events().t) == ""


def test_times_that_tell_no_unit() -> None:
    found, rates = video_unit(200 * np.arange(9))
    assert found is None
    assert rates == pytest.approx({"us": 5000, "ms": 5})
    assert video_unit(np.zeros(1)) == (None, {})
    assert usual_unit(np.zeros(1), ["us", "s"]) == "us"
    assert shared_unit(FRAMES_US + 1e15, events().t, ["us"]) is None
    assert since_1970(5.0) == []


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "ms"), (1e3, "ns"), (1e-6, "s")])
def test_events_in_a_wrong_unit_contradict_the_frames(factor: float, unit: str) -> None:
    us = FRAMES_US.astype(np.int64)
    right = events()
    assert misread(right, us) is None
    t = (right.t * factor).astype(np.int64)
    found = misread(Events(right.x, right.y, t, right.p, right.size), us)
    assert found is not None
    assert found.certain
    assert found.unit.startswith(unit)


def test_the_rate_alone_tells_too() -> None:
    few = np.zeros(0, np.int64)
    fast = misread(events(span_us=1000), few)
    assert fast is not None
    assert fast.unit.startswith("ms")
    right = events()
    slow = Events(right.x, right.y, right.t * 1000, right.p, right.size)
    found = misread(slow, few)
    assert found is not None
    assert not found.certain
    assert misread(events(2), few) is None


def noisy(folder: Path, name: str, unit: str, hz: float, *, ticks: int = 1, zero: int = 0) -> Path:
    """4 s of noise, of that rate per pixel, with times in that unit: in a file whose unit is told
    by nothing but its kind. ticks: us between times."""
    n, rng = round(4 * hz * 64 * 48), np.random.default_rng(1)
    us = zero + ticks * np.sort(rng.integers(0, 4_000_000 // ticks, n))
    t = us / UNITS_US[unit] + (rng.integers(0, 999, n) if unit == "ns" and ticks == 1 else 0)
    t = np.sort(t if unit == "s" else np.rint(t).astype(np.int64))
    x, y, p = rng.integers(0, 64, n), rng.integers(0, 48, n), rng.integers(0, 2, n)
    path = folder / name
    if name.endswith(".npz"):
        np.savez(path, t=t, x=x, y=y, p=p, size=(64, 48))
    elif name.endswith(".h5"):
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as f:
            f.attrs["width"], f.attrs["height"] = 64, 48
            for column, values in zip("txyp", (t, x, y, p), strict=True):
                f[f"events/{column}"] = values
    else:
        lines = "".join(f"{a!r} {b} {c} {d}\n" for a, b, c, d in zip(
            t.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True))
        path.write_text(lines)
    return path


@pytest.mark.parametrize("name", ["a.npz", "a.h5"])
def test_whole_numbers_in_another_unit_are_never_read_in_silence(
    tmp_path: Path, name: str
) -> None:
    """Without frames: by the rate of events alone, as a note or, where ticks tell too, a question;
    and what it advises is right."""
    path = noisy(tmp_path, name, "ns", 0.5)
    found = read_recording(path)
    (note,) = [note for note in found.notes if note.code == "events.unit"]
    assert "0.0005 per second and pixel" in note.text
    assert "--time-unit ns" in note.text
    assert [f.severity for f in check(found).findings if f.code == "EV023"] == ["warning"]
    right = read_recording(path, time_unit="ns")
    assert right.events.duration_us / 1e6 == pytest.approx(4, rel=0.01)
    assert "events.unit" not in {note.code for note in right.notes}
    error = refused(noisy(tmp_path, name, "ns", 0.5, ticks=1000))
    assert error.code == "EV023"
    assert "--time-unit ns" in error.fix
    assert "events.unit" in {n.code for n in read_recording(noisy(tmp_path, name, "ms", 9)).notes}
    for hz in (0.08, 20.0):
        assert not read_recording(noisy(tmp_path, name, "us", hz)).notes


def test_dates_beyond_this_century_are_asked_about(tmp_path: Path) -> None:
    path = noisy(tmp_path, "a.npz", "ns", 5, zero=1_700_000_000 * 10**6)
    error = refused(path)
    assert error.code == "EV023"
    assert "--time-unit ns" in error.fix
    assert read_recording(path, time_unit="ns").events.t[0] // 10**6 == 1_700_000_000


@pytest.mark.parametrize(("unit", "wrong"), [("ms", "s"), ("us", "s")])
def test_fractions_of_a_counted_unit_and_a_given_one_are_judged_by_the_rate(
    tmp_path: Path, unit: str, wrong: str
) -> None:
    path = noisy(tmp_path, "a.npz", "us", 2.0)
    held = dict(np.load(path))
    np.savez(path, **{**held, "t": held["t"] / UNITS_US[unit] + (unit == "us") * 0.25})
    error = refused(path)
    assert (error.code, error.fix) == ("EV003", f"Pass time_unit={unit!r} (--time-unit {unit}).")
    assert not [n for n in read_recording(path, time_unit=unit).notes if n.code == "events.unit"]
    (note,) = [n for n in read_recording(path, time_unit=wrong).notes if n.code == "events.unit"]
    assert note.text.endswith(f"--time-unit {unit}")


def test_a_given_unit_that_is_the_formats_own_is_not_doubted(tmp_path: Path) -> None:
    for name in ("a.npz", "a.h5"):
        path = noisy(tmp_path, name, "ns", 0.5)
        assert not read_recording(path, time_unit="us").notes


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("hz", [0.3, 10.0])
def test_text_names_the_unit_that_its_numbers_speak_for(
    tmp_path: Path, unit: str, hz: float
) -> None:
    path = noisy(tmp_path, "events.txt", unit, hz)
    error = refused(path, size=(64, 48))
    assert error.code == "EV003"
    assert error.fix == f"Pass time_unit={unit!r} (--time-unit {unit})."
    right = read_recording(path, size=(64, 48), time_unit=unit)
    assert right.events.duration_us / 1e6 == pytest.approx(4, rel=0.01)


def test_text_in_seconds_that_are_milliseconds(tmp_path: Path) -> None:
    path = noisy(tmp_path, "events.txt", "s", 0.5)
    assert "events.unit" not in {n.code for n in read_recording(path, size=(64, 48)).notes}
    rows = [line.split() for line in path.read_text().splitlines()]
    path.write_text("".join(f"{float(t) * 1e3!r} {x} {y} {p}\n" for t, x, y, p in rows))
    error = refused(path, size=(64, 48))  # read in s they lie on ticks of 1 ms, too
    assert error.code == "EV023"
    assert error.fix.startswith("Pass --time-unit ms, or, if they are right")


def test_a_jump_of_the_clock_is_no_unit() -> None:
    right = events(span_us=5_000_000)
    t = np.where(np.arange(20_000) < 12_000, right.t, right.t + 10**11)
    assert misread(Events(right.x, right.y, t, right.p, right.size), np.zeros(0, np.int64)) is None


@pytest.mark.parametrize(("step", "form", "said"), [
    (10_000, "{:.2f}", "steps of 10 ms"), (1_000, "{:.3f}", "steps of 1 ms"), (1, "{:.6f}", "")])
def test_times_of_few_digits_are_told(tmp_path: Path, step: int, form: str, said: str) -> None:
    t = np.sort(np.random.default_rng(0).integers(0, 500_000 // step, 4000)) * step
    lines = (f"{form.format(v / 1e6)} {i % 64} {i % 48} {i % 2}" for i, v in enumerate(t))
    (tmp_path / "a.txt").write_text("\n".join(lines))
    notes = read_recording(tmp_path / "a.txt", size=(64, 48)).notes
    assert [n.code for n in notes] == ["events.coarse"] * bool(said)
    assert said in "".join(n.text for n in notes)


@pytest.mark.parametrize(("kind", "zero", "apart"), [
    (np.float64, 1.6e9, 0.24), (np.float32, 100.0, 7.6), (np.float32, 1.6e9, 128e6),
    (np.float32, 300_000.0, 31_250)])
def test_floats_that_do_not_hold_their_times(
    tmp_path: Path, kind: type, zero: float, apart: float
) -> None:
    t = np.sort(np.random.default_rng(0).random(4000)) + zero
    path = tmp_path / "a.npz"
    np.savez(path, ts=t.astype(kind), x=np.arange(4000) % 64, y=np.arange(4000) % 48,
             p=np.arange(4000) % 2, size=(64, 48))
    assert np.spacing(kind(t[-1])) * 1e6 == pytest.approx(apart, rel=.1)
    if apart > 1e4:
        assert ("decimals were lost" if zero > 1e9 else "float32, which resolves such values "
                "to 0.0312 s") in refused(path).seen
        return
    notes = read_recording(path, time_unit="s").notes
    assert [n.code for n in notes] == ["events.coarse"] * (apart > 1)


def test_seconds_that_lost_their_digits(tmp_path: Path) -> None:
    lines = (f"{1643243628 + i / 4000:.6g} {i % 64} {i % 48} {i % 2}" for i in range(4000))
    (tmp_path / "a.txt").write_text("\n".join(lines))
    for told in ({}, {"time_unit": "s"}):
        assert "decimals were lost" in refused(tmp_path / "a.txt", size=(64, 48), **told).seen


def test_few_events_of_a_large_sensor_are_not_taken_for_nanoseconds(tmp_path: Path) -> None:
    """3,000 in 2 s of 346x260 pixels; both readings are told, with how long they last."""
    t = np.sort(np.random.default_rng(0).integers(0, 2_000_000, 3000))
    (tmp_path / "a.txt").write_text("\n".join(
        f"{v} {i * 7 % 346} {i * 5 % 260} {i % 2}" for i, v in enumerate(t.tolist())))
    error = refused(tmp_path / "a.txt", size=(346, 260))
    assert "--time-unit us" in error.fix
    assert "in us they last 2 s" in error.seen or "in us they last 1.99" in error.seen
    assert "in ns 0.00" in error.seen


@pytest.mark.parametrize(("begin_us", "unit"), [(3, "us"), (1_200_000, None)])
def test_frames_beside_a_short_part_of_the_events_keep_their_unit(
    begin_us: int, unit: str | None
) -> None:
    """Twenty a second for a minute, beside the first second, or before them all."""
    times = begin_us + 50_000 * np.arange(1200)
    assert other_unit(times, events().t, "us") is None
    assert shared_unit(times, events().t, ["us"]) == unit
    assert other_unit(times / 1e6, events().t, "s") is None
    assert other_unit(times * 1000, events().t, "us") == ("ns" if unit else None)


def test_a_clock_of_20_minutes_in_us_is_no_date() -> None:
    t = 1_200_000_000 + events().t
    assert not without_decimals(t)
    assert without_decimals(np.repeat(1_200_000_000 + np.arange(3), 1000))
