"""ROS 2 bags: messages as another serialiser writes them come back exactly; damage only raises
data errors."""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.bags import as_sent, holds
from helpers.bags2 import SUFFIX, Store
from helpers.recordings import SIZE, damage, equal, make, refused
from helpers.streams import survives

from evflow.errors import EvflowDataError
from evflow.io import read_events, read_recording
from evflow.io.formats.ros.messages import Message
from evflow.io.triggers import read_triggers
from evflow.types import Events


@pytest.mark.parametrize(("storage", "compression"), [
    ("SQLITE3", None), ("SQLITE3", "MESSAGE"), ("SQLITE3", "FILE"), ("MCAP", None),
    ("MCAP", "STORAGE")])
def test_event_arrays_and_images(tmp_path: Path, storage: str, compression: str | None) -> None:
    want, store = make(), Store.new()
    path = store.write(tmp_path / "bag", {
        "/dvs/events": store.arrays(want.events), "/dvs/image_raw": store.images(want)},
        storage, compression)
    holds(path, want)


@pytest.mark.parametrize("storage", SUFFIX)
def test_a_file_alone_is_a_bag(tmp_path: Path, storage: str) -> None:
    want, store = make().events, Store.new()
    folder = store.write(tmp_path / "bag", {"/cam/events": store.packets(want, "mono")}, storage)
    file, = folder.glob(f"*{SUFFIX[storage]}")
    equal(read_events(file), want)


@pytest.mark.parametrize("encoding", ["evt3", "mono", "libcaer", "libcaer_cmp"])
def test_event_packets(tmp_path: Path, encoding: str) -> None:
    want, store = make().events, Store.new()
    path = store.write(tmp_path / "bag", {
        "/cam/events": store.packets(want, encoding), "/cam/image_raw": store.images(make())},
        "MCAP")
    with pytest.raises(EvflowDataError, match="holds no trigger events"):
        read_triggers(path, want)
    got = read_recording(path)
    equal(got.events, as_sent(want, encoding))
    assert got.has_frames == encoding.startswith("libcaer")


@pytest.mark.parametrize(("storage", "compression"), [
    ("SQLITE3", None), ("SQLITE3", "FILE"), ("MCAP", None), ("MCAP", "STORAGE")])
def test_images_without_header_stamps_are_at_their_time_of_recording(
    tmp_path: Path, storage: str, compression: str | None
) -> None:
    want, store = make(), Store.new()
    images = store.images(want)
    for _, _, image in images:
        image.header.stamp = store.time(0)
    path = store.write(tmp_path / "bag", {
        "/dvs/events": store.arrays(want.events), "/dvs/image_raw": images}, storage, compression)
    holds(path, want)
    assert "at which /dvs/image_raw was recorded" in read_recording(path).notes[0].text


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_events_are_packed_as_in_ros_1(count: int) -> None:
    """An event takes 13 bytes, or 16 behind another."""
    store, some = Store.new(), make().events
    part = Events(some.x[:count], some.y[:count], some.t[:count], some.p[:count], SIZE)
    kind, _, message = store.array(part, 5)
    raw = bytes(store.types.serialize_cdr(message, kind))
    packet = Message(raw, 0, aligned=True).events(kind)
    assert packet.data == b"".join(
        struct.pack("<2H2IB", x, y, t // 10**6, t % 10**6 * 1000, p)
        for x, y, t, p in zip(part.x.tolist(), part.y.tolist(), part.t.tolist(), part.p.tolist(),
                              strict=True))


def test_what_is_no_message_of_ros_2_is_said(tmp_path: Path) -> None:
    store, want = Store.new(), make()
    only = store.write(tmp_path / "images", {"/dvs/image_raw": store.images(want)})
    assert refused(only).code == "EV008"
    big = store.write(tmp_path / "big", {"/dvs/events": store.arrays(want.events)})
    file, = big.glob("*.db3")
    kind, _, message = store.arrays(want.events)[2]
    begin = bytes(store.types.serialize_cdr(message, kind))[:12]
    assert file.read_bytes().count(begin) == 1
    file.write_bytes(file.read_bytes().replace(begin, b"\0\0" + begin[2:]))
    error = refused(big)
    assert error.code == "EV009"
    assert "message 2: it begins with 0000" in str(error)


def test_a_database_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    """SQLite reads rows from what is left, in whatever order."""
    store, want = Store.new(), make()
    folder = store.write(tmp_path / "bag", {"/dvs/events": store.arrays(want.events)})
    file, = folder.glob("*.db3")
    whole = file.read_bytes()
    file.write_bytes(whole[:-4096])
    error = refused(file)
    assert error.code == "EV009"
    assert f"has {len(whole) - 4096:,} of {len(whole):,} bytes" in str(error)


def test_messages_that_wait_in_a_log_beside_the_database(tmp_path: Path) -> None:
    """As an interrupted recording of rosbag2 leaves them; the advice mends the bag."""
    store, want = Store.new(), make()
    folder = store.write(tmp_path / "bag", {"/dvs/events": store.arrays(want.events)})
    file, = folder.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file, isolation_level=None)) as database:
        rows = database.execute("SELECT * FROM messages ORDER BY timestamp DESC LIMIT 3").fetchall()
        database.executemany("DELETE FROM messages WHERE id = ?", [row[:1] for row in rows])
        database.execute("PRAGMA journal_mode = WAL")
        places = ",".join("?" * len(rows[0]))
        database.executemany(f"INSERT INTO messages VALUES ({places})", rows)
        shutil.copytree(folder, tmp_path / "cut")
    cut, = (tmp_path / "cut").glob("*.db3")
    for path in (cut, cut.parent):
        error = refused(path)
        assert (error.code, "-wal holds" in str(error)) == ("EV009", True)
    command = re.search('sqlite3 (.*) "(PRAGMA .*)"', error.fix)
    assert command
    assert command[1] == str(cut)
    with contextlib.closing(sqlite3.connect(cut)) as database:
        database.execute(command[2])
    equal(read_events(cut.parent), want.events)


@pytest.mark.parametrize("cut", ["the summary", "a second chunk"])
def test_the_whole_chunks_of_a_cut_file_are_read_if_asked_for(tmp_path: Path, cut: str) -> None:
    store, want = Store.new(), make()
    folder = store.write(tmp_path / "bag", {
        "/dvs/events": store.arrays(want.events), "/dvs/image_raw": store.images(want)}, "MCAP")
    file, = folder.glob("*.mcap")
    raw = file.read_bytes()
    begin = at = 8  # behind the magic, records {u8 kind, u64 size, ...}
    while raw[begin] != 6:
        begin = at
        at += 9 + int.from_bytes(raw[at + 1 : at + 9], "little")
    rest = raw[at : at + 100] if cut == "the summary" else raw[begin : at - 99]
    file.write_bytes(raw[:at] + rest)
    for path in (folder, file):
        error = refused(path)
        assert (error.code, "--partial" in error.fix, "mcap recover" in error.fix) == (
            "EV009", True, True)
        got = read_recording(path, partial=True)
        equal(got.events, want.events)
        assert len(got.frames) == len(want.frames)
        note, = (note for note in got.notes if note.code == "events.partial")
        assert file.name in note.text
    file.write_bytes(raw[:begin] + raw[begin : at - 99])  # nothing whole is left
    assert refused(folder, partial=True).code == "EV009"


def test_a_database_that_is_cut_off_names_what_copies_its_rows(tmp_path: Path) -> None:
    store, want = Store.new(), make()
    folder = store.write(tmp_path / "bag", {"/dvs/events": store.arrays(want.events)})
    file, = folder.glob("*.db3")
    file.write_bytes(file.read_bytes()[:-4096])
    for partial in (False, True):
        fix = refused(folder, partial=partial).fix
        assert (".clone" in fix, "--partial" in fix, "reindex" in fix) == (True, False, False)
    file.unlink()
    assert "ros2 bag reindex" in refused(folder).fix


@pytest.mark.parametrize("storage", SUFFIX)
def test_damaged_copies_only_raise_data_errors(tmp_path: Path, storage: str) -> None:
    store, want = Store.new(), make(300, 2)
    folder = store.write(tmp_path / "bag", {
        "/dvs/events": store.arrays(want.events), "/dvs/image_raw": store.images(want)}, storage)
    file, = folder.glob(f"*{SUFFIX[storage]}")
    damage(file, 100, lambda: survives(folder))
    damage(folder / "metadata.yaml", 100, lambda: survives(folder))


def test_real_event_camera_msgs(data_file: Callable[[str], Path]) -> None:
    got = read_recording(data_file("data/formats/davis346_event_camera_msgs.mcap"))
    events = got.events
    assert (len(events), events.size) == (571_266, (346, 260))
    assert (events.t[0], events.t[-1]) == (1_744_227_144_732_712, 1_744_227_145_732_708)
    assert int(events.p.sum()) == 211_043
    assert not got.notes
