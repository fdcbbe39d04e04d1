"""Events as text: v2e with and without labels, E2VID plain and zipped; bad lines."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import SIZE, equal, make, refused, write_ijrr
from helpers.tables import want, write

from evflow.io import read_events, read_recording
from evflow.io.registry import find_format
from evflow.types import Events


@pytest.mark.parametrize("kind", ["v2e-text", "e2vid"])
@pytest.mark.parametrize("bad", ["0.1 5 5", "0.1 5 5 1 1 1", "0.1 5 nan 1 0", "0.1 5 five 1 0",
                                 "\u00e9" * 4, "7" * 3000])
def test_bad_line_is_told_with_its_byte(tmp_path: Path, kind: str, bad: str) -> None:
    path = write(tmp_path, "v2e-text")
    text = path.read_text().splitlines()
    if kind == "e2vid":
        text = ["64 48"] + [line.rsplit(" ", 1)[0] for line in text[3:]]
        bad = bad.removesuffix(" 0")
    text[-30] = bad
    path.write_text("\n".join(text), "utf-8")
    error = refused(path, size=SIZE)
    assert error.code == "EV009"
    byte = int(re.findall(r"at byte ([\d,]+)", str(error))[0].replace(",", ""))
    first = len("\n".join(text[:-30]).encode()) + 1
    assert byte == first if len(bad) < 1000 else byte <= first + 1000


def test_v2e_text_of_both_kinds(tmp_path: Path) -> None:
    """With and without labels; times as Python prints them, 1e-05 too; the size must be told."""
    path = tmp_path / "dvs.txt"
    path.write_text("# created by v2e\n1e-05 3 4 1\n2.5e-05 5 6 0\n")
    got = read_events(path, size=SIZE)
    assert (got.t.tolist(), got.p.tolist()) == ([10, 25], [True, False])
    assert "events reach x=5, y=6" in str(refused(path))
    path.write_text("0.00001 3 4 1 0\n")
    assert find_format(path).NAME == "v2e-text"
    path.write_text("0.00001 3 4 1\n")
    assert find_format(path).NAME == "ijrr"
    path.write_text("# created by v2e\n1e-05 3 4 1\n2.5e-05 5 6 0 1\n")
    assert "(4 numbers)" in str(refused(path, size=SIZE))


def test_e2vid_text_and_zips(tmp_path: Path) -> None:
    path = write(tmp_path, "e2vid")
    with zipfile.ZipFile(path) as archive:
        text = archive.read("dynamic_6dof.txt")
    (tmp_path / "plain.txt").write_bytes(text)
    equal(read_events(tmp_path / "plain.txt"), want("e2vid").events)
    words = re.sub(rb"(?m) ([01])$", lambda p: b" True" if p[1] == b"1" else b" False", text)
    (tmp_path / "words.txt").write_bytes(words)
    equal(read_events(tmp_path / "words.txt"), want("e2vid").events)
    (tmp_path / "numbers.txt").write_text("3 4\n5 6\n")
    assert "text of 2 columns of numbers" in str(refused(tmp_path / "numbers.txt"))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("second.txt", text)
    assert refused(path).code == "EV008"


def test_whole_seconds_are_no_seconds(tmp_path: Path) -> None:
    """Microseconds read as seconds are refused, with what they probably are."""
    rows = "".join(f"{160 + 20_000 * i} {i % 4} 1 1\n" for i in range(60))
    path = tmp_path / "events.txt"
    path.write_text("4 4\n" + rows)
    for hints in ({}, {"time_unit": "s"}):
        error = refused(path, **hints)
        assert error.code == "EV023"
        assert "60 event times are whole seconds, 160 to 1180160" in error.seen
        assert "--time-unit us" in error.fix
    assert read_events(path, time_unit="us").t[-1] == 1_180_160
    path.write_text(rows.replace(" ", ".0 ", 1))
    assert refused(path, time_unit="s", size=(4, 4)).code == "EV023"
    assert refused(path, size=(4, 4)).code == "EV003"
    path.write_text("4 4\n" + "".join(f"{1_643_243_628_737_093 + i} 1 1 1\n" for i in range(60)))
    error = refused(path, time_unit="s")
    assert (error.code, "--time-unit us" in error.fix) == ("EV003", True)
    for few in ("4 4\n1 1 1 1\n2 1 1 1\n", "4 4\n" + "1 1 1 1\n" * 20):
        path.write_text(few)  # too little to be sure
        assert len(read_events(path)) > 1


def rows(t: list[float], *, order: str = "txyp", comma: str = " ", form: str = "{}") -> str:
    """Twelve events, their columns in that order."""
    events = [{"t": time, "x": 3 + i, "y": 20 - i, "p": i % 2} for i, time in enumerate(t)]
    return "".join(comma.join(form.format(event[name]) for name in order) + "\n"
                   for event in events)


US = [1_000_000 + 250 * i for i in range(12)]
SECONDS = [1 + 0.00025 * i for i in range(12)]
MS = [1000 + 0.25 * i for i in range(12)]
TEXTS = {  # name: text, and the unit that must be told
    "seconds.csv": (rows(SECONDS, comma=","), None),
    "semicolons.csv": (rows(SECONDS, comma="; "), None),
    "tabs.tsv": (rows(SECONDS, comma="\t"), None),
    "savetxt.txt": (rows(SECONDS, form="{:.18e}"), None),
    "whole_floats.txt": (rows(US, form="{:.1f}"), "us"),
    "us.txt": (rows(US), "us"),
    "few.txt": (rows(US[:3]), "us"),
    "events.txt": (rows(US, comma=","), "us"),
    "bom.txt": ("\ufeff" + rows(SECONDS), None),
    "crlf.csv": ("\ufefft,x,y,p\n" + rows(SECONDS, comma=","), None),
    "long.csv": ("# remark\n" * 1000 + rows(SECONDS), None),
    "prophesee.csv": (rows(US, order="xypt", comma=","), None),
    "prophesee_s.csv": (rows(SECONDS, order="xypt", comma=","), None),
    "pandas.csv": ("x,y,timestamp,polarity\n" + rows(SECONDS, order="xytp", comma=","), None),
    "header.csv": ("timestamp_us,polarity,x,y\n" + rows(US, order="tpxy", comma=","), None),
    "units.txt": ("# t [us], x, y, p\n" + rows(US), None),
    "ms.txt": ("# t[ms] x y p\n" + rows(MS), None),
    "swapped.txt": ("# t y x p\n" + rows(SECONDS, order="tyxp"), None),
    "words.csv": ("Timestamp (microseconds),X,Y,Polarity\n" + rows(US, comma=","), None),
    "micro.csv": ("t[µs],x,y,p\n" + rows(US, comma=","), None),
    "msec.csv": ("time [milliseconds];x;y;pol\n" + rows(MS, comma=";"), None),
    "rows.csv": ("row,col,polarity,timestamp_us\n" + rows(US, order="yxpt", comma=","), None),
    "quoted.csv": ('"x";"y";"p";"t"\n' + rows(US, order="xypt", comma=";"), None),
    "path.txt": ("# from /data/ev_us/seq1\n" + rows(SECONDS), None),
    "index.csv": (",t,x,y,p\n" + "".join(
        f"{i},{line}\n" for i, line in enumerate(rows(SECONDS, comma=",").splitlines())), None),
    "bool.csv": ("t,x,y,p\n" + rows(SECONDS, comma=",").replace(",0\n", ",False\n").replace(
        ",1\n", ",True\n"), None),
    "pos.csv": ("t;x;y;p\n" + rows(SECONDS, comma=";").replace(";0\n", ";neg\n").replace(
        ";1\n", ";POS\n"), None),
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_of_other_tools(tmp_path: Path, name: str) -> None:
    content, unit = TEXTS[name]
    path = tmp_path / name
    path.write_text(content, "utf-8", newline="\r\n" if name == "crlf.csv" else None)
    got = read_events(path, size=SIZE, **({"time_unit": unit} if unit else {}))
    n = 3 if name == "few.txt" else 12
    assert got.t.tolist() == US[:n]
    assert got.x.tolist() == [3 + i for i in range(n)]
    assert got.y.tolist() == [20 - i for i in range(n)]
    assert got.p.tolist() == [bool(i % 2) for i in range(n)]
    if unit:
        assert refused(path, size=SIZE).code == "EV003"
    assert refused(path, **({"time_unit": unit} if unit else {})).code == "EV015"


def test_headers_count_beside_images_too(tmp_path: Path) -> None:
    """IJRR's own layout, but in microseconds, as its header says."""
    write_ijrr(tmp_path, make(200))
    lines = (tmp_path / "events.txt").read_text().splitlines()
    whole = [f"{round(1e6 * float(t))} {rest}" for t, rest in (s.split(" ", 1) for s in lines)]
    wanted = read_recording(tmp_path)
    (tmp_path / "events.txt").write_text("\n".join(["# t[us] x y p", *whole]))
    found = read_recording(tmp_path)
    equal(found.events, wanted.events)
    np.testing.assert_array_equal(found.frame_times, wanted.frame_times)


SIZED = {  # text that tells its size, in microseconds
    "openeb": "%geometry:64,48\n" + rows(US, order="xypt", comma=","),
    "openeb-names": "%geometry:64,48\nx,y,polarity,timestamp\n" + rows(
        US, order="xypt", comma=","),
    "openeb-comment": "# geometry 64x48\n" + rows(US, order="xypt", comma=","),
    "faery": "t,x@64,y@48,on\n" + rows(US, comma=","),
    "sides": "# width: 64, height: 48\nt_us,x,y,p\n" + rows(US, comma=","),
    "seconds": "%geometry:64,48\nx,y,p,t\n" + rows(SECONDS, order="xypt", comma=","),
    "fifth": "%geometry:64,48\nt,x,y,p,label\n" + rows(US, comma=",").replace("\n", ",7\n"),
    "words": "%geometry:64,48\nt,x,y,p,label\n" + rows(US, comma=",").replace(
        "\n", ",caf\u00e9 car\n"),
    "quoted": "%geometry:64,48\n\"x\",\"y\",\"p\",\"t\"\n" + rows(
        US, order="xypt", comma='","').replace("\n", '"\n"')[:-1],
    "true": "t,x@64,y@48,on\n" + rows(US, comma=",").replace(",0\n", ",false\n").replace(
        ",1\n", ",true\n"),
    "ON": "t,x@64,y@48,on\n" + rows(US, comma=",").replace(",0\n", ",OFF\n").replace(
        ",1\n", ",ON\n"),
    "xytp": "%geometry:64,48\n" + rows(US, order="xytp"),
    "tpxy": "%geometry:64,48\n" + rows(US, order="tpxy"),
    "pxyt": "%geometry:64,48\n" + rows(US, order="pxyt"),
}


@pytest.mark.parametrize("kind", SIZED)
def test_text_that_tells_its_size(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(SIZED[kind])
    found = read_recording(path)
    equal(found.events, Events([3 + i for i in range(12)], [20 - i for i in range(12)], US[:12],
                               [i % 2 for i in range(12)], (64, 48)))
    said = {"fifth": "events.unread", "words": "events.unread", "xytp": "events.layout",
            "tpxy": "events.layout", "pxyt": "events.layout"}
    assert [note.code for note in found.notes] == ([said[kind]] if kind in said else [])
    assert refused(path, size=(9, 48)).code == "EV005"


def test_a_size_alone_tells_no_unit(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("# resolution 64x48\n" + rows(US))
    assert (refused(path).code, "--time-unit" in refused(path).fix) == ("EV003", True)
    assert read_events(path, time_unit="us").size == (64, 48)


@pytest.mark.parametrize("order", ["xytp", "tpxy", "pxyt"])
def test_the_order_is_judged_and_told(tmp_path: Path, order: str) -> None:
    """Without a header; a sentence that happens to name four columns is none."""
    path = tmp_path / "a.txt"
    path.write_text("# the time t, x and y of events, and their p\n" + rows(US, order=order))
    found = read_recording(path, size=SIZE, time_unit="us")
    assert found.events.t.tolist() == US[:12]
    assert found.events.x.tolist() == [3 + i for i in range(12)]
    assert [note.code for note in found.notes] == ["events.layout"]
    assert f"to be {', '.join(order)}" in found.notes[0].text


NO_EVENTS = {
    "three": "0.1 3 4\n", "five": "0.1 3 4 1 7\n", "sign": "0.1 3 4 2\n0.2 3 4 1\n",
    "words": "a b c d\n", "identity": "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
    "zeros": "0 0 0 1\n" * 9, "imu": "1.5 0.1 -9.8 0.0\n" * 20,
    "flow": "0.1 1.5 2.5 0.0\n" * 20, "unknown": "a,b,c,d\n0.1,3,4,1\n",
}


@pytest.mark.parametrize("kind", NO_EVENTS)
def test_other_numbers_are_no_events(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "numbers.dat"
    path.write_text(NO_EVENTS[kind])
    assert refused(path, size=SIZE).code == "EV008"


@pytest.mark.parametrize(("content", "code", "seen"), [
    ("0.2 3 4 1\n0.1 3 4 0\n", "EV004", "goes back"),
    ("x,y,stamp,polarity\n3,4,0.1,1\n", "EV008", "which columns are t, x, y and p"),
    ("t,x,y,p\n" + "1500000000123.5,3,4,1\n" * 3, "EV003", "since 1970"),
    ("t,x,y,p\nnan,3,4,1\n0.2,3,4,1\n", "EV009", "nan"),
    ("0.1,3,4,1\n0.2,3,garb,1\n", "EV009", "garb"),
    ("t,x,y,p\n0.1,3,4,+\n0.2,3,4,-\n", "EV008", "after its header 't,x,y,p' comes"),
    ("t,x,y,p\n2022-01-27T00:00:00.5,3,4,1\n", "EV008", "2022-01-27T"),
    ("t;x;y;p\n0,1;3;4;1\n0,2;3;4;0\n", "EV008", "points with sed 's/,/./g'"),
    ("0,1\t3\t4\t1\n0,2\t3\t4\t0\n", "EV008", "contain commas: 0,1"),
    ("t_us x y p\n1,000 3 4 1\n2,000 3 4 0\n", "EV008", "with sed 's/,//g'"),
    ('t_us,x,y,p\n999,3,4,1\n"1,000",3,4,1\n', "EV008", "without thousands separators"),
    ("t_us x y p\n1_000 3 4 1\n", "EV008", "1_000"),
    ("0.1, 3, 4, 1\n0.2, 70, 4, 0\n", "EV005", "Wrong size?"),
    ("t x y p\n0.1 3 -4 1\n0.2 7 4 0\n", "EV005", "No pixel is below 0"),
    ("0.1 64 48 1\n0.2 1 1 0\n", "EV005", "start at 1"),
    ("0.1 40 60 1\n0.2 7 4 0\n", "EV005", "--size 48x64"),
    ("0.1 64 48 1\n0.2 0 0 0\n", "EV005", "Wrong size?"),
    ("t,x,y,p\n0.1,3,4,1\nt,x,y,p\n0.2,3,4,0\n", "EV009", "were files joined?"),
    ("t,x,y,p\n0.1,3,4,255\n0.2,3,4,0\n", "EV006", "Is 255 ON?"),
    ("t,x,y,p\n0.1,3,4,1\n0.2,3,4,2\n", "EV006", "count from 1"),
])
def test_unclear_text_is_told(tmp_path: Path, content: str, code: str, seen: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(content)
    error = refused(path, size=SIZE)
    assert (error.code, seen in str(error)) == (code, True)


def test_fractions_after_whole_times_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frame-based simulators begin with many events at 0: those alone look like Prophesee's us."""
    monkeypatch.setattr("evflow.io.decode.text.BLOCK", 1000)
    path = tmp_path / "a.csv"
    path.write_text("7,3,1,0\n7,3,0,0\n" * 100 + "7,3,1,2\n" * 200 + "8,3,1,2.5\n")
    error = refused(path, size=SIZE)
    assert (error.code, "later ones are not" in str(error)) == ("EV003", True)


def test_the_sound_part_of_a_block_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("".join(f"{1 + 1e-5 * i:.5f},{i % 60},{i % 40},{i % 2}\n"
                            for i in range(3000)) + "garb\n")
    error = refused(path, size=SIZE)
    assert "3,000 events" in str(error)
    assert "b'garb'" in str(error)
    found = read_recording(path, size=SIZE, partial=True)
    assert len(found.events) == 3000
    assert [note.code for note in found.notes] == ["events.partial"]


def test_fractional_coordinates_are_told(tmp_path: Path) -> None:
    path = tmp_path / "undistorted.txt"
    path.write_text("".join(f"{0.1 * i:.1f} 3.5 4.25 {i % 2}\n" for i in range(12)))
    error = refused(path, size=SIZE)
    assert error.code == "EV003"
    assert "undistorted" in str(error)


@pytest.mark.parametrize("order", ["txyp", "ptxy", "xypt"])
def test_a_last_line_without_its_end_may_be_cut(tmp_path: Path, order: str) -> None:
    """Of y = 23, 2 is left: no reader can tell, so that it is said. A polarity has one digit."""
    path = tmp_path / "a.csv"
    lines = ["_".join(order).replace("_", ","), *(
        ",".join({"t": f"0.{t}", "x": "30", "y": "23", "p": "1"}[name] for name in order)
        for t in range(10, 40))]
    for end, said in (("\n", False), ("\r\n", False), ("", order[-1] != "p")):
        path.write_bytes(("\n".join(lines) + end).encode())
        notes = read_recording(path, size=(64, 48)).notes
        assert [n.code for n in notes if n.code == "events.unended"] == ["events.unended"] * said


@pytest.mark.parametrize("cut", ["102,33,1,1", "102,33,1,1000\n103,4,0,1001", "1,1,1,7\n"])
def test_the_first_lines_of_openeb_are_in_its_order(tmp_path: Path, cut: str) -> None:
    """Whatever else so few values could be."""
    path = tmp_path / "a.csv"
    path.write_text(f"%geometry:240,180\n{cut}")
    got = read_recording(path).events
    first = cut.split()[0].split(",")
    assert (int(got.x[0]), int(got.y[0]), bool(got.p[0])) == (
        int(first[0]), int(first[1]), first[2] == "1")
