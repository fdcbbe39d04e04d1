"""SQLite databases of ROS 2 (rosbag2_storage_sqlite3): tables `topics` and `messages`.

A database is a program as well: views, generated columns and virtual tables produce rows that are
not in the file. Only plain tables are queried, and types and lengths are checked before values are
read. ValueError and sqlite3.Error if it is not a bag; EV009 if messages wait in a file beside it.
"""

from __future__ import annotations

import itertools
import os
import shlex
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from evflow.errors import EvflowDataError

MAGIC = b"SQLite format 3\0"
LARGEST = 1 << 28  # bytes of one message
MOST_TOPICS, LONGEST_NAME = 1 << 14, 1 << 12
STEPS = 10_000  # of SQLite's virtual machine between two progress checks
LEAST_STEPS, BYTES_A_LOOK = 1000, 200  # checks; one more per so many bytes: 50 steps a byte
LARGEST_PAGE = 65536  # encoded specially, as it does not fit the header's two bytes


class Database:
    """An open database. counts: messages by (topic, type); damage: as of `Mcap`, but what is
    damaged is refused."""

    damage = ""

    def __init__(self, path: Path) -> None:
        _check_log(path)
        _check_whole(path)
        # Immutable: SQLite opens and creates nothing beside the file. Quoted for `?` and `%`.
        self._open = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1",
                                     uri=True, check_same_thread=False)
        try:
            self._open.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST)
            self._open.execute("PRAGMA trusted_schema = OFF")
            stored = os.path.getsize(path)
            self._bound(LEAST_STEPS + stored // BYTES_A_LOOK)
            self._check_tables()
            self._check_values(stored)
            counted = dict(self._open.execute(
                "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
            self._topics = {number: (name, kind) for number, name, kind in self._open.execute(
                "SELECT id, name, type FROM topics ORDER BY id")}
        except BaseException:
            self.close()
            raise
        if strays := counted.keys() - self._topics.keys():
            raise ValueError(f"messages of topic {min(strays)}, which it does not describe")
        self.counts: Counter[tuple[str, str]] = Counter()
        for number, topic in self._topics.items():
            self.counts[topic] += counted.get(number, 0)

    def close(self) -> None:
        self._open.close()

    def messages(self, topics: Collection[str]) -> Iterator[tuple[int, bytes]]:
        """(time of recording in ns, message) of the topics, in order of time."""
        wanted = [number for number, (name, _) in self._topics.items() if name in topics]
        rows = self._open.execute(
            "SELECT timestamp, data FROM messages WHERE topic_id IN "
            f"({','.join(map(str, wanted))}) ORDER BY timestamp")
        for row in rows:  # noqa: UP028 (`yield from` would close a cursor of a closed database)
            yield row

    def _bound(self, looks: int) -> None:
        """Stop with an error whatever takes more steps: pages that are their own children yield
        rows without end. SQLite counts in C, because an exception in a callback, even Ctrl-C, is
        lost."""
        allowed = itertools.chain(itertools.repeat(0, looks), itertools.repeat(1))
        self._open.set_progress_handler(allowed.__next__, STEPS)

    def _check_tables(self) -> None:
        """ValueError unless both are tables of stored rows."""
        for table in ("topics", "messages"):
            found = self._open.execute(
                "SELECT rootpage FROM sqlite_master WHERE name = ? AND type = 'table' "
                "AND typeof(rootpage) = 'integer'", (table,)).fetchall()
            if len(found) != 1 or found[0][0] <= 0:
                raise ValueError(f"it has no table of {table}")
            columns = self._open.execute(f"PRAGMA table_xinfo({table})").fetchall()
            if len(columns) > 64 or any(column[6] for column in columns):
                raise ValueError(f"its table of {table} has columns that are computed")

    def _check_values(self, stored: int) -> None:
        """ValueError if values have types that a bag's have not, or are longer than the file."""
        odd, many = self._open.execute(
            "SELECT total(typeof(id) != 'integer' OR typeof(name) != 'text' OR typeof(type) != "
            "'text' OR length(name) > :most OR length(type) > :most OR "
            "serialization_format != 'cdr'), count(*) FROM topics",
            {"most": LONGEST_NAME}).fetchone()
        if odd or many > MOST_TOPICS:
            raise ValueError(f"{int(odd):,} of its {many:,} topics do not have the types of a bag")
        odd, longest, total = self._open.execute(
            "SELECT total(typeof(topic_id) != 'integer' OR typeof(timestamp) != 'integer' OR "
            "typeof(data) != 'blob'), max(length(data)), total(length(data)) FROM messages"
        ).fetchone()
        if odd:
            raise ValueError(f"{int(odd):,} messages have values of the wrong type")
        if (longest or 0) > LARGEST or total > stored:
            raise ValueError(f"messages of up to {longest:,} bytes, {total:,.0f} in all, in a file "
                             f"of {stored:,}")


def _check_whole(path: Path) -> None:
    """ValueError if a database ends before its last page, which SQLite does not report: rows would
    be missing or replaced by others. Header: www.sqlite.org/fileformat.html, 1.3."""
    with path.open("rb") as file:
        head = file.read(100)
    page, changed, pages, valid = (int.from_bytes(head[a:b], "big") for a, b in (
        (16, 18), (24, 28), (28, 32), (92, 96)))
    claimed = pages * (LARGEST_PAGE if page == 1 else page)
    if changed == valid and path.stat().st_size < claimed:
        raise ValueError(f"{path.name} has {path.stat().st_size:,} of {claimed:,} bytes")


def _check_log(path: Path) -> None:
    """EV009 if a write-ahead log beside the database holds messages: where a recording ended
    without closing it, the last ones are only there, and an immutable database does not look."""
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        raise EvflowDataError(
            "EV009", f"{log} holds {log.stat().st_size:,} bytes that were not written into "
            f"{path.name} yet: its recording was interrupted, or still runs.",
            f'Write them into it: sqlite3 {shlex.quote(str(path))} "PRAGMA '
            'wal_checkpoint(TRUNCATE)".', where=path)
