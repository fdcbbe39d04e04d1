"""AEDAT4 written by hand, not compressed, so that damage reaches every table of it."""

from __future__ import annotations

import struct

import numpy as np

from evflow.types import Events

XML = """<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">{}</node></dv>"""
STREAM = """<node name="{0}" path="/mainloop/Recorder/outInfo/{0}/">
<attr key="compression" type="string">NONE</attr>
<attr key="originalModuleName" type="string">capture</attr>
<attr key="originalOutputName" type="string">{1}</attr>
<attr key="typeDescription" type="string">{1}</attr>
<attr key="typeIdentifier" type="string">{1}</attr>
<node name="info" path="/mainloop/Recorder/outInfo/{0}/info/">
<attr key="sizeX" type="int">64</attr><attr key="sizeY" type="int">48</attr>
<attr key="source" type="string">camera</attr></node></node>"""


def header(xml: str, compression: int = 0) -> bytes:
    """The version line, and the flatbuffer {compression i32; place of a table of packets i64, -1 =
    none; XML}."""
    text = xml.encode()
    table = (b"\x18\0\0\0IOHE\0\0\0\0\0\0\x0a\0\x14\0\x04\0\x0c\0\x08\0\x0a\0\0\0"
              + struct.pack("<i", compression) + b"\x0c\0\0\0"
              + struct.pack("<qI", -1, len(text)) + text)
    return b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(table)) + table


def packet(stream: int, buffer: bytes) -> bytes:
    """{i32 stream, i32 size, the flatbuffer behind its own size}."""
    return struct.pack("<iiI", stream, len(buffer) + 4, len(buffer)) + buffer


def event_packet(events: Events) -> bytes:
    """The flatbuffer {elements: [{t i64, x i16, y i16, on bool}]}."""
    rows = b"".join(
        struct.pack("<qhh?3x", int(t), int(x), int(y), bool(p))
        for x, y, t, p in zip(events.x, events.y, events.t, events.p, strict=True))
    return (b"\x10\0\0\0EVTS\0\0\x06\0\x08\0\x04\0\x06\0\0\0\x04\0\0\0"
            + struct.pack("<I", len(events)) + rows)


def frame_packet(pixels: np.ndarray, t: int, origin: tuple[int, int] = (0, 0)) -> bytes:
    """The flatbuffer {t, begin, end, exposure begin, end i64; format i8; width, height, x, y i16;
    pixels [u8]}, its table at byte 36."""
    height, width = pixels.shape
    vtable = struct.pack("<13H", 26, 64, 8, 16, 24, 32, 40, 56, 48, 50, 52, 54, 4)
    fields = struct.pack("<iI5q4hb7x", 28, 60, t, t - 9, t + 9, t - 5, t + 5, width, height,
                         *origin, 0)
    return (b"\x24\0\0\0FRME" + vtable + b"\0\0" + fields + struct.pack("<I", pixels.size)
            + pixels.tobytes())
