"""The text header of Prophesee's files: lines `% key value`, then binary data.

The header ends after `% end`, or before the first line that is not text beginning with `% `. It
gives the sensor's size, directly or by a known name, and the encoding of the words, unless the
words themselves contradict it (`evt_words`).
"""

from __future__ import annotations

import dataclasses
import functools
import re
from pathlib import Path

from evflow.checks import Size
from evflow.io.decode import evt_words
from evflow.io.decode.text import HEAD
from evflow.notes import Note

MAX_HEADER = 1 << 16  # bytes; real ones have 200 to 600
TEXT = re.compile(rb"%[ \t][\x20-\x7e\t]*\r?\n|%\r?\n")
ANY = re.compile(rb"%[^\r\n]*\r?\n")  # for headers that a line `% end` closes
END = re.compile(rb"%[ \t]*end\s*", re.IGNORECASE)

SIDE = re.compile(r"\d{1,5}")  # pixels

SENSORS: tuple[tuple[str, Size], ...] = (  # searched in plugin_name, sensor_name or generation
    (r"genx320", (320, 320)),
    (r"gen3|^3\.[01]$", (640, 480)),
    (r"gen4|imx636|^4\.[0-2]$", (1280, 720)),
)


@dataclasses.dataclass(frozen=True)
class Header:
    """fields: the last value of each key, in lower case. start: offset of the data."""

    fields: dict[str, str]
    start: int

    @property
    def encoding(self) -> str:
        """"EVT2", "EVT3", "EVT2.1" ... from `% format` or `% evt`; "" if neither is there."""
        named = self.fields.get("format", "").split(";")[0].strip().upper()
        version = self.fields.get("evt", "").strip()
        found = (named or (f"EVT{version}" if version else "")).removesuffix(".0")
        return {"EVT21": "EVT2.1", "EVT20": "EVT2", "EVT30": "EVT3"}.get(found, found)

    @property
    def order(self) -> str:
        """Byte order of the words: ">" if `% format` says endianness=big."""
        return ">" if "endianness=big" in self.fields.get("format", "").lower() else "<"

    def size(self) -> tuple[Size | None, tuple[Note, ...]]:
        """(width, height) or None, and a note if it was inferred from the sensor's name."""
        layout = self.fields.get("format", "").lower()
        given = dict(re.findall(r"(width|height)=(\d{1,5})\b", layout))
        given = {key: self.fields[key] for key in ("width", "height") if key in self.fields} | given
        pair = re.fullmatch(r"(\d{1,5})x(\d{1,5})", self.fields.get("geometry", ""))
        if pair:
            return (int(pair[1]), int(pair[2])), ()
        if len(given) == 2 and all(map(SIDE.fullmatch, given.values())):
            return (int(given["width"]), int(given["height"])), ()
        for key in ("sensor_name", "plugin_name", "generation", "sensor_generation"):
            name = self.fields.get(key, "").strip().lower()
            for pattern, size in SENSORS:
                if re.search(pattern, name):
                    return size, (Note("sensor.size", f"assumed the sensor size of "
                                       f"{key} {name}, {size[0]}x{size[1]}"),)
        return None, ()


def parse(head: bytes) -> Header:
    """The header at the start of these bytes; without fields if there is none."""
    fields: dict[str, str] = {}
    start, line_of = 0, ANY if _ends(head) else TEXT
    while line := line_of.match(head, start):
        start = line.end()
        key, _, value = line[0][1:].decode("utf-8", "replace").strip().partition(" ")
        if key.lower() == "end" and not value:
            break
        fields[key.lower()] = value.strip()
    return Header(fields, start)


def _ends(head: bytes) -> bool:
    """Whether a line `% end` closes a header whose lines all begin with `%`; names in it may then
    have any characters."""
    at = 0
    while line := ANY.match(head, at):
        if END.fullmatch(line[0]):
            return True
        at = line.end()
    return False


def read_header(path: Path) -> Header:
    with open(path, "rb") as f:
        return parse(f.read(MAX_HEADER))


def sniffed(path: Path, head: bytes) -> str:
    """The encoding of a RAW file with this beginning, "" if it is none: what the header declares,
    unless the words fit another encoding only."""
    return _sniffed(path.suffix.lower() == ".raw", head)


@functools.lru_cache(maxsize=2)  # all formats ask for the same file
def _sniffed(is_raw: bool, head: bytes) -> str:
    header = parse(head)
    declared = header.encoding
    if declared not in ("", *evt_words.NAMES) or "version" in header.fields:
        return declared
    if not header.fields and not is_raw:
        return ""
    found = evt_words.fitting(head[header.start :], header.order)
    return found[0] if declared not in found and len(found) == 1 else declared


def raw(path: Path) -> tuple[Header, str, tuple[Note, ...]]:
    """The header of a RAW file, the encoding of its words, and a note if the header does not state
    it."""
    header = read_header(path)
    with open(path, "rb") as f:
        encoding = sniffed(path, f.read(HEAD))
    if encoding == header.encoding:
        return header, encoding, ()
    return header, encoding, (Note(
        "events.layout", evt_words.encoding_note(header.encoding, encoding)),)
