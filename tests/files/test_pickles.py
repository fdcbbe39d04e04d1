"""Pickles are read without being run: plain data comes back, anything else is a ValueError."""

from __future__ import annotations

import contextlib
import io
import pickle
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from evflow.files import pickles
from evflow.files.bounded import BoundedPath


@pytest.mark.parametrize("protocol", range(5))
def test_plain_pickles_of_every_protocol_load(protocol: int) -> None:
    value = {"a": [1, -2, 2**70, 0.5, None, True], "b": ("text", "é", b"bytes"), "c": {}, "d": [[]],
             "e": (1,), "f": (1, 2), "g": (1, 2, 3, 4)}
    names = {"_codecs.encode": lambda text, code: text.encode(code)}
    shared = [value, value]
    loaded = pickles.load(io.BytesIO(pickle.dumps(shared, protocol)), names)
    assert loaded == shared
    assert loaded[0] is loaded[1]


@pytest.mark.parametrize("program", [
    b".", b"N", b"NN.", b"(.", b"K\x01R.", b"]K\x01R.", b"}]K\x01s.", b"0.", b"t.", b"h\x05.",
    b"K\x01K\x02a.", b"K\x01}b.", b"(K\x01K\x02K\x03d.",
], ids=str)
def test_broken_programs_are_value_errors(program: bytes) -> None:
    with pytest.raises(ValueError, match=r"pickle|instructions"):
        pickles.load(io.BytesIO(program), {})


def test_names_that_are_no_strings_are_refused() -> None:
    """A list within lists of itself would be spelled out: twice as long at every level."""
    levels = b"".join(b"]" + b"q" + bytes([i + 1]) + b"(h" + bytes([i]) + b"h" + bytes([i]) + b"e"
                      for i in range(60))
    program = b"\x80\x04]q\x00" + levels + b"\x8c\x01x\x93."
    with pytest.raises(ValueError, match="requires str"):
        pickles.load(io.BytesIO(program), {})


def test_endless_programs_are_cut() -> None:
    program = b"N" * (pickles.MOST_INSTRUCTIONS + 1) + b"."
    with pytest.raises(ValueError, match="instructions"):
        pickles.load(io.BytesIO(program), {})


HUGE = b"\xff" * 7 + b"\x7f"  # a length of 8 bytes, the largest
TWICE = b"q\0h\0\x86"  # a tuple of what there is, twice
HOSTILE = {
    "memo": b"Nr\xff\xff\xff\xff.", "frame": b"\x95" + HUGE + b"N.",
    "bytes8": b"\x8e" + HUGE + b"x.",
    "text8": b"\x8d" + HUGE + b"x.", "long4": b"\x8b\xff\xff\xff\x7fx.",
    "bytes": b"B\xff\xff\xff\xffx.", "string": b"T\xff\xff\xff\x7fx.",
    "bytearray8": b"\x96" + HUGE + b"x.", "put": b"Np" + b"9" * 5_000 + b"\n.",
    "digits": b"L" + b"9" * 5_000 + b"L\n.",
    "deep": b"})" + 200_000 * b"\x85" + b"Ns.", "wide": b"})" + 60 * TWICE + b"Ns.",
    "dict": b"()" + 60 * TWICE + b"Nd.",
    "state": b"cbuild\nme\n}X\4\0\0\0nameNsb.", "append": b"cbuild\nme\n)R]a.",
    "item": b"cbuild\nme\n)RK\0Ns."}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("on_disk", [True, False])
def test_hostile_programs_take_no_memory(name: str, on_disk: bool, tmp_path: Path) -> None:
    """Sizes and places that are not there, keys that take for ever to hash, objects made over."""
    path, names = BoundedPath(tmp_path / "x"), {"build.me": lambda: np.zeros(3)}
    path.write_bytes(HOSTILE[name])
    idle = name in ("memo", "frame")  # such numbers alone do no harm
    tracemalloc.start()
    try:
        with (path.open("rb") if on_disk else io.BytesIO(HOSTILE[name])) as f, (
                contextlib.nullcontext() if idle else pytest.raises(ValueError)):  # noqa: PT011
            assert pickles.load(f, names) is None
        assert tracemalloc.get_traced_memory()[1] < 1 << 26
    finally:
        tracemalloc.stop()
