"""Events in one .npy, and in .npz of other names: records, N x 4 in every order, neither."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import SIZE, equal, make, refused

from evflow.io import read_events, read_recording
from evflow.io.registry import find_format
from evflow.notes import texts
from evflow.types import Events

EVENTS = make(300, 0).events
ZERO = Events(EVENTS.x, EVENTS.y, EVENTS.t - EVENTS.t[0], EVENTS.p, SIZE)  # float64 keeps 1 us
SIGNED = np.where(EVENTS.p, 1, -1)


def records(kind: list[tuple[str, str]], events: Events = EVENTS, **changed: Any) -> np.ndarray:
    """Fields in that order, which stand for the column of their first letter (on: p)."""
    out = np.zeros(len(events), kind)
    for name, _ in kind:
        column = {"o": "p", "s": "t"}.get(name[0], name[0])
        out[name] = changed.get(column, getattr(events, column))
    return out


def matrix(order: str, dtype: Any = np.int64, **changed: Any) -> np.ndarray:
    return np.stack([changed.get(c, getattr(ZERO, c)) for c in order], 1).astype(dtype)


RECORDS = {
    "tonic": records([("x", "i2"), ("y", "i2"), ("t", "i8"), ("p", "?")]),
    "metavision": records([("x", "u2"), ("y", "u2"), ("p", "i2"), ("t", "i8")]),
    "dv": records([("timestamp", "i8"), ("x", "i2"), ("y", "i2"), ("polarity", "i1")]),
    "faery": records([("t", "u8"), ("x", "u2"), ("y", "u2"), ("on", "?")]),
    "seconds": records([("x", "u2"), ("y", "u2"), ("ts", "f8"), ("p", "i1")], ZERO,
                       t=ZERO.t / 1e6, p=SIGNED),
    "nanoseconds": records([("x", "u2"), ("y", "u2"), ("t_ns", "i8"), ("p", "u1")],
                           t=EVENTS.t * 1000),
    "pandas": records([("t", "M8[ns]"), ("x", "i8"), ("y", "i8"), ("p", "?")],
                      t=EVENTS.t.astype("M8[us]"))}


@pytest.mark.parametrize("kind", RECORDS)
def test_records(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.npy"
    np.save(path, RECORDS[kind])
    assert find_format(path).NAME == "npy"
    want = ZERO if kind == "seconds" else EVENTS
    equal(read_events(path, size=SIZE), want)
    assert refused(path).code == "EV015"
    np.savez(tmp_path / "b.npz", arr_0=RECORDS[kind], resolution=SIZE)
    equal(read_events(tmp_path / "b.npz"), want)


MATRICES = {
    **{order: matrix(order) for order in ("txyp", "xypt", "xytp", "tpxy", "pxyt", "ptxy")},
    "mvsec": matrix("xytp", float, t=ZERO.t / 1e6, p=SIGNED), "v2e": matrix("txyp", "u4"),
    "vid2e": matrix("xytp", float, p=SIGNED), "across": matrix("txyp").T,
    "fortran": np.asfortranarray(matrix("xytp"))}


@pytest.mark.parametrize("kind", MATRICES)
def test_the_order_of_columns_is_judged(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.npy"
    np.save(path, MATRICES[kind])
    found = read_recording(path, size=SIZE)
    equal(found.events, ZERO)
    note, = found.notes
    order = {"mvsec": "xytp", "vid2e": "xytp", "fortran": "xytp"}.get(
        kind, kind if len(kind) == 4 else "txyp")
    assert f"to be {', '.join(order)}" in note.text
    equal(read_events(path, size=SIZE, start_s=0.1, stop_s=0.2), ZERO.slice(10**5, 2 * 10**5))
    np.savez_compressed(tmp_path / "b.npz", events=MATRICES[kind], size=np.array(SIZE))
    equal(read_events(tmp_path / "b.npz"), ZERO)


def test_npz_with_other_names(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, xs=ZERO.x, ys=ZERO.y, ts=ZERO.t / 1e6, ps=SIGNED, width=64, height=48)
    equal(read_events(path), ZERO)
    np.savez(path, x=ZERO.x, y=ZERO.y, timestamp_ms=ZERO.t / 1e3, polarity=ZERO.p)
    equal(read_events(path, size=SIZE), ZERO)


NO_EVENTS = {
    "poses": np.random.default_rng(0).normal(size=(50, 4)), "boxes": np.arange(80).reshape(20, 4),
    "triples": matrix("txyp")[:, :3], "stack": np.zeros((4, 48, 64)),
    "fields": np.zeros(9, [("a", "i4"), ("b", "i4"), ("c", "i4"), ("d", "i4")]),
    "twice": np.zeros(9, [("t", "i8"), ("x", "f4"), ("y", "f4"), ("score", "f4")])}


@pytest.mark.parametrize("kind", NO_EVENTS)
def test_other_arrays_are_no_events(tmp_path: Path, kind: str) -> None:
    np.save(tmp_path / "a.npy", NO_EVENTS[kind])
    assert refused(tmp_path / "a.npy", size=SIZE).code == "EV008"
    np.savez(tmp_path / "b.npz", a=NO_EVENTS[kind])
    error = refused(tmp_path / "b.npz", size=SIZE)
    assert (error.code, "['t', 'x', 'y', 'p']" in error.seen) == ("EV008", True)


def test_several_arrays_are_not_chosen_from(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", left=matrix("txyp"), right=matrix("txyp"))
    assert "several arrays that may be events: left, right" in str(refused(tmp_path / "a.npz"))
    names = [f"{kind}_{side}" for kind in ("theta", "eta") for side in ("on", "off")]
    np.savez(tmp_path / "a.npz", **dict.fromkeys(names, np.ones((4, 6))))
    assert "is a camera, not a recording" in str(refused(tmp_path / "a.npz"))


def test_objects_that_are_not_needed_are_not_read(tmp_path: Path) -> None:
    """Images of several shapes, a dict; a column of objects; and a number named frames."""
    path = tmp_path / "a.npz"
    known = {name: getattr(EVENTS, name) for name in "txyp"} | {"size": SIZE}
    images = np.array([np.zeros(5), np.zeros(6)], object)
    np.savez(path, **known, meta={"lens": "6 mm"}, frames=images, time={"zone": "UTC"})
    got = read_recording(path)
    equal(got.events, EVENTS)
    assert texts(got.notes) == [
        "images were not read as frames: frames (of variable length, as encoded images are: save "
        "them as arrays, or as files for --frames)",
        "Python objects were not read, as pickles are never loaded: meta, frames, time"]
    np.savez(path, **known, frames=6)
    assert read_recording(path).notes == ()


@pytest.mark.parametrize("held", [
    {"t": EVENTS.t, "x": EVENTS.x.astype(object), "y": EVENTS.y, "p": EVENTS.p},
    {"events": matrix("txyp", object)}, {"events": RECORDS["tonic"].astype(
        [("x", "O"), ("y", "i2"), ("t", "i8"), ("p", "?")])}])
def test_events_that_are_objects(tmp_path: Path, held: dict[str, Any]) -> None:
    np.savez(tmp_path / "a.npz", **held, size=SIZE)
    error = refused(tmp_path / "a.npz")
    assert (error.code, "as numbers" in error.fix) == ("EV008", True)
    assert "damaged" not in str(error)


@pytest.mark.parametrize(("values", "code"), [
    (matrix("txyp", x=np.full(300, 64)), "EV005"), (matrix("txyp")[::-1], "EV004"),
    (matrix("txyp", float, t=np.full(300, np.nan)), "EV007"),
    (records([("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "?")], t=np.full(300, np.inf)), "EV007"),
    (records([("t", "i8"), ("x", "f4"), ("y", "u2"), ("p", "i1")], x=EVENTS.x / 3), "EV003"),
    (records([("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")], p=np.full(300, 255)), "EV006")])
def test_values_that_cannot_be(tmp_path: Path, values: np.ndarray, code: str) -> None:
    np.save(tmp_path / "a.npy", values)
    assert refused(tmp_path / "a.npy", size=SIZE).code == code


def test_a_cut_or_lying_file(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, matrix("txyp"))
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    assert refused(path, size=SIZE).code == "EV009"
    path.write_bytes(data.replace(b"(300, 4)", b"(9999, 4)"))
    assert refused(path, size=SIZE).code in ("EV008", "EV009")
    np.save(path, np.zeros((0, 4)))
    assert len(read_events(path, size=SIZE)) == 0
