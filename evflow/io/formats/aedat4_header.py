"""The header of AEDAT 4: the location of its packets, and each stream's output in DV.

#!AER-DAT4.0, then a size and a FlatBuffer with the place of the table of packets, and XML that
describes the streams. It is checked here before any decoder sees it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from evflow.errors import EvflowDataError

MAGIC = b"#!AER-DAT4.0\r\n"
TABLE_POSITION, INFO_NODE = 1, 2  # fields of the header's flatbuffer table: i64, XML
MAX_DEPTH = 64  # of the XML; DV writes 5


class Header(NamedTuple):
    """packets: byte where packets begin; table: byte of their table, -1 for none; outputs: for each
    stream {"originalModuleName": ..., "originalOutputName": ..., "source": the camera's name}, as
    far as known."""

    packets: int
    table: int
    outputs: dict[str, dict[str, str]]


def stream_names(outputs: dict[str, dict[str, str]], streams: Iterable[int]) -> dict[int, str]:
    """Names of the streams for users: "accumulator/frames", or "1" if names are not unique."""
    names: dict[int, str] = {}
    for i in sorted(streams):
        output = outputs.get(str(i), {})
        keys = "originalModuleName", "originalOutputName"
        parts = [output[key] for key in keys if output.get(key)]
        name = "/".join(parts) or str(i)
        names[i] = f"{name}/{i}" if name in names.values() else name
    return names


def elsewhere(outputs: dict[str, dict[str, str]], stream: int, events: int) -> bool:
    """Whether the header says that a stream is of another camera than the stream of events."""
    sources = {outputs.get(str(i), {}).get("source", "") for i in (stream, events)}
    return len(sources) > 1 and all(sources)


def read_header(path: Path) -> Header:
    """Read and check the header; EV009 if it is damaged."""
    with open(path, "rb") as f:
        magic, size = f.read(len(MAGIC)), int.from_bytes(f.read(4), "little")
        header = f.read(min(size, os.path.getsize(path)))
    try:
        if magic != MAGIC or len(header) < size:
            raise ValueError("cut off" if MAGIC.startswith(magic[:13]) else "wrong version line")
        outputs = _outputs(_info_node(header))
        place = _field(header, TABLE_POSITION)
        table = struct.unpack_from("<q", header, place)[0] if place else -1
    except (ValueError, struct.error, expat.ExpatError) as e:
        raise EvflowDataError(
            "EV009", f"{path} has a damaged AEDAT4 header ({e}).", "Copy it again.",
            where=path) from e
    return Header(len(MAGIC) + 4 + size, table, outputs)


def _field(header: bytes, number: int) -> int:
    """Offset of a field in the header's flatbuffer, root table -> vtable -> field; 0: absent."""
    (table,) = struct.unpack_from("<I", header, 0)
    vtable = table - struct.unpack_from("<i", header, table)[0]
    if vtable < 0:
        raise ValueError("its table position is invalid")
    if struct.unpack_from("<H", header, vtable)[0] < 6 + 2 * number:
        return 0
    (field,) = struct.unpack_from("<H", header, vtable + 4 + 2 * number)
    return table + field if field else 0


def _info_node(header: bytes) -> bytes:
    """The XML string of the header's flatbuffer."""
    pointer = _field(header, INFO_NODE)
    if not pointer:
        raise ValueError("it has no description")
    string = pointer + struct.unpack_from("<I", header, pointer)[0]
    (length,) = struct.unpack_from("<I", header, string)
    if not 0 < length <= len(header) - string - 4:
        raise ValueError("its description is cut off")
    return header[string + 4 : string + 4 + length]


def _outputs(text: bytes) -> dict[str, dict[str, str]]:
    """The attributes of each node directly below outInfo, and the source in the node `info` below
    it. ValueError or ExpatError unless it is UTF-8 XML of bounded depth."""
    nodes: list[str] = []
    key = ""
    found: dict[str, dict[str, str]] = {}

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal key
        nodes.append(attributes.get("name", "") if tag == "node" else "")
        if len(nodes) > MAX_DEPTH:
            raise ValueError(f"its description is nested more than {MAX_DEPTH} deep")
        key = attributes.get("key", "") if tag == "attr" else ""

    def end(_: str) -> None:
        nonlocal key
        nodes.pop()
        key = ""

    def written(words: str) -> None:
        inner = key == "source" and nodes[-2:-1] == ["info"]
        below = nodes[:-2] if inner else nodes[:-1]
        if key and len(below) > 1 and below[-2] == "outInfo":
            output = found.setdefault(below[-1], {})
            output[key] = output.get(key, "") + words

    def refuse(*_: object) -> None:
        raise ValueError("its description defines entities")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler = written
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(text.decode("utf-8"), True)
    return found
