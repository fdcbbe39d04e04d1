"""Events, Recording, Window: what they accept, what they refuse and how they say it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evflow.errors import EvflowDataError
from evflow.types import Events, Recording, Window

SIZE = (6, 4)
COLUMNS = {"x": [0, 5, 2], "y": [0, 3, 1], "t": [10, 10, 12], "p": [0, 1, 1]}


def events(**changed: Any) -> Events:
    columns = {name: np.array(v) for name, v in COLUMNS.items()} | changed
    return Events(**{"size": SIZE, **columns})


def frames(count: int = 2, dtype: Any = np.uint8) -> np.ndarray:
    return np.arange(count * 24).reshape(count, 4, 6).astype(dtype)


def code_of(make: Any) -> EvflowDataError:
    with pytest.raises(EvflowDataError) as raised:
        make()
    return raised.value


@pytest.mark.parametrize("p", [
    np.array([False, True, True]), np.array([0, 1, 1], np.uint8), np.array([-1, 1, 1], np.int8)])
def test_every_polarity_convention_gives_one_canonical_form(p: np.ndarray) -> None:
    made = events(p=p)
    assert made.p.dtype == bool
    assert made.p.tolist() == [False, True, True]


@pytest.mark.parametrize(("p", "on"), [([0, 0, 0], 0), ([1, 1, 1], 3), ([-1, -1, -1], 0)])
def test_one_sided_polarities(p: list[int], on: int) -> None:
    assert events(p=np.array(p)).p.sum() == on


class Graded:
    """Like a tensor of PyTorch whose gradient is wanted."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape, self.ndim = values, values.shape, values.ndim

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise RuntimeError("use tensor.detach()")


@pytest.mark.parametrize(("change", "seen"), [
    (lambda a: np.ma.masked_equal(a, a[1]), "masked values"), (Graded, "Graded, which cannot be"),
    (lambda a: a.astype("m8[us]"), "timedelta64"), (lambda a: a.astype("M8[us]"), "datetime64")])
@pytest.mark.parametrize("column", ["x", "y", "t", "p"])
def test_what_is_no_plain_array_is_refused(change: Any, seen: str, column: str) -> None:
    values = {"x": [0, 5, 2], "y": [0, 3, 1], "t": [10, 11, 12], "p": [0, 1, 1]}
    with pytest.raises(EvflowDataError, match="EV003") as caught:
        events(**{column: change(np.array(values[column]))})
    assert seen in str(caught.value)
    assert caught.value.seen.startswith(f"{column} ")


def test_a_mask_that_hides_nothing_is_none() -> None:
    assert len(events(x=np.ma.masked_array([0, 5, 2]))) == 3


def test_canonical_dtypes_and_no_copy() -> None:
    made = events(x=np.array([0, 5, 2], np.uint8), y=np.array([0, 3, 1], np.int64),
                  t=np.array([10, 10, 12], np.uint32))
    assert (made.x.dtype, made.y.dtype, made.t.dtype) == (np.uint16, np.uint16, np.int64)
    x = np.array([0, 5, 2], np.uint16)
    kept = events(x=x)
    assert np.shares_memory(kept.x, x)
    assert x.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        kept.x[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        kept.x = x  # type: ignore[misc]


@pytest.mark.parametrize(("changed", "code", "seen"), [
    ({"x": np.zeros((3, 4))}, "EV002", "events.T"),
    ({"x": np.zeros((4, 3))}, "EV002", "Unpack it: x, y, t, p = events."),
    ({"t": np.array([1, 2])}, "EV002", "'t': 2"),
    ({"x": np.array([0.0, 5.5, 2.0])}, "EV003", "undistorted"),
    ({"t": np.array([0.1, 0.2, 0.3])}, "EV003", "Multiply seconds by 1e6"),
    ({"t": np.array([1, 2, 2**63], np.uint64)}, "EV003", "9223372036854775808"),
    ({"t": np.array([-(2**62), 0, 2**62])}, "EV003", "146,000 years"),
    ({"t": np.array([10, 12, 9])}, "EV004", "first at index 2: 12 -> 9 us (at most 3 us back)"),
    ({"t": np.array([9_000_000, 1, 2])}, "EV004", "two recordings joined"),
    ({"x": np.array([0, 6, 2])}, "EV005", "1 of 3 events (33.3 %) lie outside 6x4: x 0..6"),
    ({"y": np.array([0, -1, 2])}, "EV005", "y=-1"),
    ({"y": np.array([0, 1, 4])}, "EV005", "y 0..4, first at event 2"),
    ({"size": (4, 6)}, "EV005", "did you mean (6, 4)?"),
    ({"p": np.array([0, 1, 2])}, "EV006", "0, 1, 2"),
    ({"p": np.array([-1, 0, 1])}, "EV006", "-1, 0, 1"),
    ({"p": np.array([255, 1, 1], np.uint8)}, "EV006", "unsigned byte reads as 255"),
    ({"p": np.array([0.0, 1.0, 1.0])}, "EV006", "float64"),
    ({"p": np.array([0, None, 1], object)}, "EV006", "None"),
    ({"x": np.array([0.0, np.nan, 2.0])}, "EV007", "x is nan at event 1 (1 in all)"),
    ({"t": np.array([0.0, np.inf, 2.0])}, "EV007", "inf"),
    ({"size": (6,)}, "EV020", "(6,)"),
    ({"size": (0, 4)}, "EV020", "(0, 4)"),
    ({"size": (6.0, 4.0)}, "EV020", "(6.0, 4.0)"),
])
def test_bad_events_say_what_where_and_the_fix(changed: dict, code: str, seen: str) -> None:
    error = code_of(lambda: events(**changed))
    assert error.code == code
    assert seen in str(error)


def test_repr_is_one_line() -> None:
    assert repr(events()) == "3 events, 6x4, 0.000 s, 67 % ON"
    assert repr(Events([], [], [], [], SIZE)) == "0 events, 6x4, 0.000 s"
    assert repr(Recording(events(), frames(), [1, 2])).endswith("2 frames (uint8)")
    window = Window(events(), *frames().astype(np.float32), 1, 2, 7)
    assert repr(window) == f"Window(7: {events()!r}, from 1 to 2 us)"


def test_empty_events_are_legal() -> None:
    silent = Events([], [], [], [], SIZE)
    assert (len(silent), silent.duration_us, silent.count_map().sum()) == (0, 0, 0)
    assert silent.t.dtype == np.int64
    assert len(silent.slice(0, 10)) == 0


@given(st.lists(st.integers(-5, 20), max_size=30).map(sorted), st.integers(-6, 21),
       st.integers(-6, 21))
def test_slices_are_half_open_and_partition(t: list[int], a: int, b: int) -> None:
    n, (a, b) = len(t), sorted((a, b))
    made = Events(np.arange(n) % 6, np.arange(n) % 4, np.array(t, int), np.arange(n) % 2, SIZE)
    inside = made.slice(a, b)
    assert inside.t.tolist() == [v for v in t if a <= v < b]
    parts = [made.slice(-100, a), inside, made.slice(b, 100)]
    joined = Events.concatenate(parts)
    for name in ("x", "y", "t", "p"):
        assert getattr(joined, name).tolist() == getattr(made, name).tolist()
    total = sum(part.count_map().astype(int) for part in parts)
    np.testing.assert_array_equal(total, made.count_map())


@pytest.mark.parametrize("t", [1e6, 0.5, None])
def test_slices_take_integers(t: Any) -> None:
    with pytest.raises(EvflowDataError, match=r"EV003.*integer us") as raised:
        events().slice(0, t)
    assert "round(1e6 * t)" in str(raised.value)


def test_slice_copies_nothing() -> None:
    made = events()
    assert np.shares_memory(made.slice(10, 11).x, made.x)
    assert len(made.slice(10, 11)) == 2
    assert len(made.slice(-(1 << 70), 1 << 70)) == len(made)


def test_count_map_is_on_then_off() -> None:
    counts = events().count_map()
    assert counts.dtype == np.uint32
    assert counts.shape == (2, 4, 6)
    assert (counts[1, 0, 0], counts[0, 3, 5], counts[0, 1, 2], counts.sum()) == (1, 1, 1, 3)


def test_concatenate_refuses_other_order_and_sizes() -> None:
    assert code_of(lambda: Events.concatenate([])).code == "EV001"
    assert code_of(lambda: Events.concatenate([events(), events()])).code == "EV004"
    other = Events([], [], [], [], (7, 4))
    assert code_of(lambda: Events.concatenate([events(), other])).code == "EV015"


@pytest.mark.parametrize(("changed", "code", "seen"), [
    ({"frames": np.zeros((2, 4, 6, 3), np.uint8)}, "EV002", "luma"),
    ({"frames": np.zeros((4, 6), np.uint8)}, "EV002", "(T, H, W)"),
    ({"frame_times": [1]}, "EV002", "2 frames"),
    ({"frames": frames(dtype=np.float64)}, "EV003", "frames.astype(np.float32)"),
    ({"frames": frames(dtype=np.int64)}, "EV003", "frames.astype(np.uint16)"),
    ({"frames": frames(dtype=bool)}, "EV003", "255 * frames.astype(np.uint8)"),
    ({"frames": frames(dtype=np.float32) / 48}, "EV003", "Multiply by 255"),
    ({"frames": frames(dtype=np.float32) * 100}, "EV003", "0..4700"),
    ({"frame_times": [0.1, 0.2]}, "EV003", "1e6"),
    ({"frame_times": [2, 1]}, "EV004", "go back 1 time"),
    ({"frame_times": [2, 2]}, "EV004", "do not advance"),
    ({"frames": np.full((2, 4, 6), np.nan, np.float32)}, "EV007", "frame 0 has 24 NaN"),
    ({"frames": np.zeros((2, 6, 4), np.uint8)}, "EV015", "frames transposed"),
    ({"frames": np.zeros((2, 5, 5), np.uint8)}, "EV015", "frames are 5x5"),
    ({"exposure_us": "a"}, "EV020", "exposure_us='a'"),
    ({"full_scale": float("nan")}, "EV020", "full_scale=nan"),
    ({"full_scale": 1e9}, "EV020", "full_scale=1000000000.0"),
    ({"full_scale": 4095.5}, "EV020", "full_scale=4095.5"),
    ({"full_scale": "1023"}, "EV020", "1023 for 10 bits"),
    ({"full_scale": -1}, "EV020", "full_scale=-1"),
])
def test_bad_recordings_say_what_where_and_the_fix(changed: dict, code: str, seen: str) -> None:
    given_ = {"events": events(), "frames": frames(), "frame_times": [5, 11]} | changed
    error = code_of(lambda: Recording(**given_))
    assert error.code == code
    assert seen in str(error)


@pytest.mark.parametrize(("dtype", "peak", "full"), [
    (np.uint8, 7, 255), (np.float32, 200, 255), (np.uint16, 255, 255), (np.uint16, 256, 1023),
    (np.uint16, 2000, 4095), (np.uint16, 4096, 16383), (np.uint16, 65535, 65535)])
def test_full_scale_is_that_of_the_converter(dtype: Any, peak: int, full: int) -> None:
    stack = np.zeros((2, 4, 6), dtype)
    stack[1, 2, 3] = peak
    recording = Recording(events(), stack, [1, 2])
    assert recording.full_scale == full
    scaled = recording.frame_dn(1)
    assert scaled.dtype == np.float32
    assert scaled[2, 3] == pytest.approx(peak * 255 / full, rel=1e-6)


def test_parts_of_a_recording_keep_its_full_scale() -> None:
    stack = np.zeros((2, 4, 6), np.uint16)
    stack[1] = 4000
    recording = Recording(events(), stack, [1, 2])
    part = dataclasses.replace(recording, frames=stack[:1], frame_times=[1])
    assert part.full_scale == 4095
    assert Recording(events(), stack[:1], [1], full_scale=4095).full_scale == 4095
    assert Recording(events(), stack, [1, 2], full_scale=1023).full_scale == 4095


def test_dark_parts_of_float_frames_are_not_fractions_of_white() -> None:
    stack = frames(dtype=np.float32) + 20
    stack[1] /= 250
    recording = Recording(events(), stack, [1, 2])
    part = dataclasses.replace(recording, frames=stack[1:], frame_times=[2])
    np.testing.assert_array_equal(part.frame_dn(0), stack[1])
    assert Recording(events(), stack[1:], [2], full_scale=255).full_scale == 255
    for unsure in (0, 1):
        error = code_of(lambda white=unsure: Recording(
            events(), stack[1:], [2], full_scale=white))
        assert error.code == "EV003"
        assert "full_scale=255" in error.fix


def test_recording_without_frames() -> None:
    recording = Recording.of_events(events())
    assert not recording.has_frames
    assert recording.frames.shape == (0, 4, 6)
    assert recording.full_scale == 255
