"""Events as text: v2e with and without labels, E2VID plain and zipped; bad lines."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import pytest
from recordings import SIZE, equal, refused
from test_io_tables import want, write

from evflow.io import read_events
from evflow.io.base import find_format


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
    (tmp_path / "numbers.txt").write_text("3 4\n5 6\n")
    assert "none of" in str(refused(tmp_path / "numbers.txt"))
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
