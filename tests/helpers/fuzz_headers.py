"""Hostile pictures, headers, lines of text, packets, weights and COCO json: sizes and numbers that
nothing has, and little that stands for much."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from helpers.fuzz_aedat4 import STREAM, XML, event_packet, header
from helpers.fuzz_archives import BOMB
from helpers.fuzz_registry import each, hostile
from helpers.fuzz_samples import SAMPLES, Sample, frames_of, sample
from helpers.recordings import make

# ----------------------------------------------------------------------------------------- images


def png(width: int, height: int, data: bytes, bits: int = 1) -> bytes:
    def chunk(name: bytes, content: bytes) -> bytes:
        return (struct.pack(">I", len(content)) + name + content
                + struct.pack(">I", zlib.crc32(name + content)))

    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 0, 0,
                                                             0, 0))
            + chunk(b"IDAT", data) + chunk(b"IEND", b""))


def packed(total: int) -> bytes:
    coder = zlib.compressobj(9)
    return b"".join([*(coder.compress(bytes(1 << 20)) for _ in range(total >> 20)), coder.flush()])


def tiff(width: int, height: int) -> bytes:
    entries = ((256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1),
               (262, 3, 1, 1), (273, 4, 1, 0), (277, 3, 1, 1), (278, 4, 1, height),
               (279, 4, 1, 9))
    return (b"II*\0\x08\0\0\0" + struct.pack("<H", len(entries))
            + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(30))


IMAGES: dict[str, Callable[[], bytes]] = {
    "bomb.png": lambda: png(32752, 32752, packed(32752 * 4095)),
    "claim.png": lambda: png(65535, 65535, zlib.compress(bytes(99))),
    "claim16.png": lambda: png(30000, 30000, zlib.compress(bytes(99)), 16),
    "claim.jpg": lambda: (b"\xff\xd8\xff\xe0\0\x10JFIF\0\1\1\0\0\1\0\1\0\0\xff\xc0\0\x0b\x08"
                          b"\x70\0\x70\0\1\1\x11\0\xff\xda\0\x08\1\1\0\0\x3f\0abc\xff\xd9"),
    "claim.bmp": lambda: b"BM" + struct.pack("<IIIIiiHHIIiiII", 99, 0, 54, 40, 30000, 30000, 1, 24,
                                             0, 0, 0, 0, 0, 0) + bytes(9),
    "claim.pgm": lambda: b"P5 30000 30000 65535\n" + bytes(9),
    "plain.pgm": lambda: b"P2 30000 30000 255\n" + b"1 " * 9,
    "claim.tif": lambda: tiff(30000, 30000),
    "claim.webp": lambda: b"RIFF\x1a\0\0\0WEBPVP8L\x0d\0\0\0\x2f\xff\xff\xff\x0f" + bytes(8),
}


@each(**{name.replace(".", "_"): name for name in IMAGES})
def image(folder: Path, case: str) -> Sample:
    path = folder / "frames"
    path.mkdir()
    (path / case).write_bytes(IMAGES[case]())
    return frames_of(path, path / case, fps=25)


# ------------------------------------------------------------------------ headers, text, messages


@each(large="% geometry 99999999x99999999\n", digits=f"% geometry {'9' * 5000}x1\n",
      width=f"% Width {'9' * 5000}\n% Height 1\n", format=f"% format EVT2;width={'7' * 5000};"
      "height=3\n", none="% geometry 0x0\n", endless="% a b\n" * 30_000)
def raw_header(folder: Path, case: str) -> Sample:
    path = folder / "a.raw"
    path.write_bytes(b"% evt 2.0\n" + case.encode() + struct.pack("<2I", 0x80000001, 1 << 28))
    return sample(path)


@each(line=b"7" * (1 << 24), columns=b"1 " * (1 << 20), utf=b"\xff\xfe\x80\x81" * 99,
      nul=bytes(1 << 20), inf=b"inf 1 1 1\n", nan=b"nan 1 1 1\n", far=b"1e300 1 1 1\n",
      back=b"5 1 1 1\n-5 1 1 1\n", wide=b"0.1 99999999 1 1\n", huge=b"0.1 1e308 1 1\n")
def text(folder: Path, case: bytes) -> Sample:
    path = folder / "ijrr"
    path.mkdir()
    (path / "events.txt").write_bytes(b"0.1 1 1 1\n" + case)
    return sample(path, path / "events.txt", size=(9, 9))


@each(digits=f"{'1' * 5000} f0\n{'1' * 4999}2 f1\n{'1' * 4999}3 f2\n", inf="0 f0\n1 f1\ninf f2\n",
      counts="\n".join(f"{'9' * 5000}{i} {i}" for i in range(3)),
      far="1e300 f0\n2e300 f1\n3e300 f2\n", one="1 2 3 4 5\n" * 3)
def times(folder: Path, case: str) -> Sample:
    made = SAMPLES["times"](folder)
    made.targets[0].write_text(case)
    return made


def aedat4_file(path: Path, xml: str, packets: bytes, compression: int = 0) -> Sample:
    path.write_bytes(header(xml, compression) + packets)
    return sample(path)


LAUGHS = ("<!DOCTYPE a [<!ENTITY a0 'ha'>" + "".join(
    f"<!ENTITY a{i} '{f'&a{i - 1};' * 10}'>" for i in range(1, 12)) + "]><dv>&a11;</dv>")


@each(deep="<a>" * 200_000 + "</a>" * 200_000, laughs=LAUGHS, empty="<dv/>",
      large=XML.format(STREAM.format(0, "EVTS").replace(">64<", ">99999999999<")))
def aedat4_description(folder: Path, case: str) -> Sample:
    return aedat4_file(folder / "a.aedat4", case, b"")


@each(huge=struct.pack("<ii", 0, 2**31 - 1), negative=struct.pack("<ii", 0, -1),
      stranger=struct.pack("<ii", 99, 0), none=struct.pack("<ii", 0, 0),
      lying=struct.pack("<ii", 0, 40) + event_packet(make(1).events)[:24] + b"\xff" * 16)
def aedat4_packet(folder: Path, case: bytes) -> Sample:
    return aedat4_file(folder / "a.aedat4", XML.format(STREAM.format(0, "EVTS")), case)


@hostile
def aedat4_zstd_bomb(folder: Path) -> Sample:
    """Blocks of one zero repeated 131,072 times."""
    block = (1 << 1 | (1 << 17) << 3).to_bytes(3, "little") + b"\0"
    frame = b"\x28\xb5\x2f\xfd\0\x38" + block * (BOMB >> 17)
    return aedat4_file(folder / "a.aedat4", XML.format(STREAM.format(0, "EVTS")),
                       struct.pack("<ii", 0, len(frame)) + frame, compression=3)


# --------------------------------------------------------------------------- weights and COCO json


def safetensors(header: Any) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + bytes(64)


def tensor(dtype: str = "F32", shape: Any = (16,)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "data_offsets": [0, 64]}


@each(both={"a": tensor("F32", (8,)) | {"data_offsets": [0, 32]},
            "a/b": tensor("F32", (8,)) | {"data_offsets": [32, 64]}},
      reverse={"a/b": tensor("F32", (8,)) | {"data_offsets": [0, 32]},
               "a": tensor("F32", (8,)) | {"data_offsets": [32, 64]}},
      brain={"a": tensor("BF16", (32,))}, quarter={"a": tensor("F8_E4M3", (64,))},
      claim={"a": tensor("F32", (1 << 40,))}, deep=b"[" * 100_000, none={},
      zeros={"a": tensor("F32", (0, 1 << 62)) | {"data_offsets": [0, 0]}}, name={"": tensor()},
      slashes={"//": tensor()}, long={"a/" * 9999 + "b": tensor()}, whole=b"[" + b"1," * 99 + b"1]",
      overlap={name: tensor() for name in "ab"}, negative={"a": tensor() | {"shape": [-4, -4]}},
      gap={"a": tensor("F32", (8,)) | {"data_offsets": [32, 64]}}, shape={"a": tensor() | {
          "shape": {"0": 16}}}, fraction={"a": tensor() | {"shape": [16.0]}}, list={"a": [1]},
      offsets={"a": tensor() | {"data_offsets": [0, 1 << 70]}}, card={
          "a": tensor(), "__metadata__": {"card": "[" * 100_000}}, metadata={
          "a": tensor(), "__metadata__": [1]}, twice=b'{"a":1,"a":2}', utf=b"\xff\xfe{}",
      words={"a": tensor("I64", (8,))}, booleans={"a": tensor("BOOL", (64,))})
def weights(folder: Path, case: Any) -> Sample:
    from evflow.network.weights import load_weights

    load_weights(SAMPLES["weights"](folder).path)  # JAX begins before memory is bounded
    path = folder / "a.safetensors"
    path.write_bytes(safetensors(case))
    return Sample(path, (path,), load_weights)


def objects(segmentation: Any, width: Any = 64, height: Any = 48, name: str = "a.png") -> str:
    return json.dumps({
        "images": [{"id": 0, "file_name": name, "width": width, "height": height}],
        "annotations": [{"id": 0, "image_id": 0, "area": 9, "segmentation": segmentation}]})


SQUARE = [[1, 1, 9, 1, 9, 9]]


@each(large=objects(SQUARE, 65535, 65535), runs=objects(
          {"size": [65535, 65535], "counts": [0, 65535 * 65535]}, 65535, 65535),
      vast=objects(SQUARE, 10**12, 10**12), negative=objects(SQUARE, -5, 5),
      deep="[" * 100_000, up=objects(SQUARE, name="../a"),
      counts=objects({"size": [48, 64], "counts": {"a": 1}}), none=objects({"size": [48, 64],
                                                                            "counts": None}),
      overflow=objects({"size": [48, 64], "counts": [2**62, 2**62, 2**62, 2**62, 3072]}),
      big=objects({"size": [48, 64], "counts": [10**30]}), nested=objects([[[1, 2], [3]]]),
      wide=objects(SQUARE, 1e400), words=objects({"size": [48, 64], "counts": ["a"]}))
def coco(folder: Path, case: str) -> Sample:
    made = SAMPLES["coco"](folder)
    made.path.write_text(case)
    return made
