"""Hostile bags of ROS 1 and ROS 2: little that stands for much, databases that make their rows, and
metadata that are not what they should be."""

from __future__ import annotations

import os
import sqlite3
import struct
from pathlib import Path

import numpy as np
from helpers import bags
from helpers.fuzz_archives import BOMB
from helpers.fuzz_registry import each, hostile
from helpers.fuzz_samples import SAMPLES, Sample, sample
from helpers.recordings import make

ZSTD_BLOCK = (1 << 1 | (1 << 17) << 3).to_bytes(3, "little") + b"\0"  # one zero, 131,072 times
ZSTD_BOMB = b"\x28\xb5\x2f\xfd\0\x38" + ZSTD_BLOCK * (BOMB >> 17) + b"\x01\0\0"
SKIPPED = struct.pack("<II", 0x184D2A5F, 4) + b"abcd"


def written(folder: Path, storage: str = "SQLITE3", compression: str | None = None) -> Path:
    """A bag of a few messages."""
    from helpers import bags2

    store = bags2.Store.new()
    return store.write(folder / "bag", {"/cam/events": store.packets(make(50).events, "mono")},
                       storage, compression)


# --------------------------------------------------------------------------------------- databases

TABLE = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
ROWS = "INSERT INTO messages(topic_id, timestamp) VALUES (1, 0), (1, 1), (1, 2);"
WRONG = {
    **{f"{column}_{name}": f"UPDATE messages SET {column} = {value}"
       for column in ("topic_id", "timestamp", "data")
       for name, value in (("text", "'abc'"), ("real", "1.5"), ("null", "NULL"))},
    **{f"topic_{column}": f"UPDATE topics SET {column} = x'00ff'"
       for column in ("name", "type", "serialization_format")},
    "stray": "UPDATE messages SET topic_id = 77",
    "long": "UPDATE topics SET name = replace(hex(zeroblob(100000)), '0', 'a')",
    "computed": f"DROP TABLE messages; {TABLE} data BLOB AS (zeroblob(900000000))); {ROWS}",
    "view": "DROP TABLE messages; CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 0 AS "
            "timestamp, zeroblob(900000000) AS data",
    "endless": "DROP TABLE topics; CREATE VIEW topics AS WITH RECURSIVE n(x) AS (SELECT 1 UNION "
               "ALL SELECT x + 1 FROM n) SELECT x AS id, 'a' AS name, 'b' AS type FROM n",
    "virtual": "DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, "
               "data)",
    "bomb": f"UPDATE messages SET data = x'{ZSTD_BOMB.hex()}'",
    "hidden_bomb": f"UPDATE messages SET data = x'{(ZSTD_BOMB[:6] + SKIPPED).hex()}'",
}


def loose(path: Path, script: str) -> None:
    """Change a database whose columns have no rules."""
    with sqlite3.connect(path) as open_:
        open_.execute("ALTER TABLE messages RENAME TO old")
        open_.execute("CREATE TABLE messages AS SELECT * FROM old")
        open_.execute("ALTER TABLE topics RENAME TO older")
        open_.execute("CREATE TABLE topics AS SELECT * FROM older")
        open_.executescript(script)
    open_.close()


def nested(path: Path, levels: int = 15, children: int = 100) -> None:
    """Give `messages` pages each of which is a child of the one before a hundred times."""
    with sqlite3.connect(path) as open_:
        (root,) = open_.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    open_.close()
    data = bytearray(path.read_bytes())
    size, pages = int.from_bytes(data[16:18], "big"), len(data) // 4096
    leaf = bytes(data[size * (root - 1) : size * root])
    for level in range(levels):
        child = pages + level + 1
        cells = b"".join(struct.pack(">IB", child, 1) for _ in range(children))
        start = size - len(cells)
        page = struct.pack(">BHHHBI", 5, 0, children, start, 0, child)
        page += b"".join(struct.pack(">H", start + 5 * i) for i in range(children))
        page += bytes(start - len(page)) + cells
        if level == 0:
            data[size * (root - 1) : size * root] = page
        else:
            data += page
            child += 1
    data += leaf * 2
    data[28:32] = (len(data) // size).to_bytes(4, "big")
    path.write_bytes(data)


if "rosbag2" in SAMPLES:
    @each(**WRONG)
    def database(folder: Path, case: str) -> Sample:
        path = written(folder) / "bag.db3"
        loose(path, case)
        return sample(path)

    @hostile
    def database_of_nested_pages(folder: Path) -> Sample:
        path = written(folder) / "bag.db3"
        loose(path, "")
        nested(path)
        return sample(path)

    @hostile
    def packed_database_bomb(folder: Path) -> Sample:
        path = written(folder)
        (path / "bag.db3").write_bytes(ZSTD_BOMB)
        return sample(path, path / "bag.db3")

# ---------------------------------------------------------------------------------------- metadata

    BEGIN = "rosbag2_bagfile_information:\n  "

    @each(brackets=f"{BEGIN}version: {'[' * 20_000}", dashes=f"{BEGIN}{'- ' * 20_000}",
          list=f"{BEGIN}relative_file_paths: {'[' * 20_000}\n", none=f"{BEGIN}version: 9\n",
          empty=f"{BEGIN}relative_file_paths:\n    - ''\n",
          away=f"{BEGIN}relative_file_paths:\n    - /etc/passwd\n",
          itself=f"{BEGIN}relative_file_paths:\n    - metadata.yaml\n",
          pipe=f"{BEGIN}relative_file_paths:\n    - pipe\n",
          laughs=f"{BEGIN}a: &a [1]\n  b: &b [*a,*a]\n  c: &c [*b,*b]\n")
    def metadata(folder: Path, case: str) -> Sample:
        path = written(folder)
        os.mkfifo(path / "pipe")
        (path / "metadata.yaml").write_text(case)
        return sample(path, path / "metadata.yaml")

# -------------------------------------------------------------------------------------------- MCAP


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(packed: bytes, compression: str, size: int) -> bytes:
    return record(6, struct.pack("<QQQI", 0, 9, size, 0) + text(compression)
                  + struct.pack("<Q", len(packed)) + packed)


def lz4_bomb(size: int) -> bytes:
    import lz4.frame

    return lz4.frame.compress(bytes(size))  # type: ignore[no-any-return]


DESCRIBED = (record(3, struct.pack("<H", 1) + text("event_camera_msgs/msg/EventPacket")
                    + text("ros2msg") + text(""))
             + record(4, struct.pack("<HH", 1, 1) + text("/events") + text("cdr") + text("")))

if "rosbag2-mcap" in SAMPLES:
    @each(zstd=lambda: chunk(ZSTD_BOMB, "zstd", 100), lz4=lambda: chunk(lz4_bomb(BOMB), "lz4", 100),
          honest=lambda: chunk(ZSTD_BOMB, "zstd", BOMB), claim=lambda: chunk(b"abc", "", 1 << 60),
          many=lambda: chunk(b"abc", "zstd", 1 << 28) * 4, kind=lambda: chunk(b"abc", "xz", 100),
          record=lambda: record(5, bytes(22))[:1] + struct.pack("<Q", 1 << 62),
          stray=lambda: record(5, struct.pack("<HIQQ", 9, 0, 0, 0)), short=lambda: record(5, b"a"),
          statistics=lambda: record(0x0B, struct.pack("<QHIIIIQQI", 1, 1, 1, 0, 0, 7, 0, 0, 0)))
    def mcap(folder: Path, case: object) -> Sample:
        path, magic = folder / "a.mcap", b"\x89MCAP0\r\n"
        path.write_bytes(magic + record(1, text("ros2") + text("")) + DESCRIBED
                         + case() + record(2, bytes(20)) + magic)  # type: ignore[operator]
        return sample(path)

    @hostile
    def bag2_bomb(folder: Path) -> Sample:
        """A message of zeros in a chunk of some 12 kB."""
        from helpers import bags2

        store = bags2.Store.new()
        kind, ns, packet = store.packets(make(50).events, "mono")[0]
        packet.events = np.zeros(1 << 27, np.uint8)
        return sample(store.write(folder / "bag", {"/events": [(kind, ns, packet)]}, "MCAP",
                                  "STORAGE"))

# ------------------------------------------------------------------------------------------- ROS 1

if "rosbag" in SAMPLES:
    @each(bz2="BZ2", lz4="LZ4")
    def bag_bomb(folder: Path, case: str) -> Sample:
        """A chunk of little in place of one that holds the messages."""
        from rosbags.rosbag1 import Writer

        messages = bags.array_messages(make(50).events)
        long = b"".join(messages[0][3:]) + bytes(1 << 27)
        path = folder / "a.bag"
        writer = Writer(path)
        writer.set_compression(writer.CompressionFormat[case])
        with writer:
            topic, kind, ns, _ = messages[0]
            connection = writer.add_connection(topic, kind, msgdef="uint8 x\n", md5sum="0" * 32)
            writer.write(connection, ns, long)
        return sample(path)
