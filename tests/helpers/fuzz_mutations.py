"""What happens to files: cut off, bits flipped, bytes lost or added, headers of another kind."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np

Rng = np.random.Generator
Mutation = Callable[[Rng, bytes], bytes]

NUMBERS = (0, 1, -1, 255, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 2**62, 2**63 - 1, -(2**63))
WORDS = (b"nan", b"inf", b"-inf", b"-1", b"1e400", b"1e-400", b"99999999999999999999", b"", b"\0",
         b"0x10", b"1_000", "\u0663".encode(), b"\xff\xfe", b"\x80", b"7" * 5000, b"1.5.2", b"#",
         b",", b"{}", b"[[]]", b"null", b"../../etc/passwd", b"/etc/passwd", b'"', b"\r", b"\t")
HEADS = (b"\x89HDF\r\n\x1a\n", b"PK\x03\x04", b"PK\x05\x06", b"#!AER-DAT2.0\r\n",
         b"#!AER-DAT4.0\r\n", b"% evt 2.0\n", b"% evt 3.0\n", b"% evt 2.1\n", b"% Version 2\n",
         b"\x93NUMPY\x01\x00\x76\x00", b"#ROSBAG V2.0\n", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0",
         b"64 48\n0.1 1 1 1\n", b"0.1 1 1 1\n", b"# v2e\n", b"RIFF\xff\xff\xff\x7fAVI LIST", b"{",
         b"\xef\xbb\xbf", b"MM\0*\0\0\0\x08", b"II*\0\x08\0\0\0", b"BM", b"P5 65535 65535 255\n")


def place(rng: Rng, data: bytes) -> int:
    """Where to damage: half of the time near the beginning, where headers are."""
    end = len(data) if rng.random() < 0.5 else min(len(data), 400)
    return int(rng.integers(max(end, 1)))


def cut(rng: Rng, data: bytes) -> bytes:
    return data[: int(rng.integers(len(data)))]


def flip(rng: Rng, data: bytes) -> bytes:
    """One bit, or up to eight."""
    out = bytearray(data)
    for _ in range(1 if rng.random() < 0.5 else int(rng.integers(2, 9))):
        out[place(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def overwrite(rng: Rng, data: bytes) -> bytes:
    at, n = place(rng, data), int(rng.integers(1, 17))
    same = bytes([int(rng.choice([0, 0x20, 0x7F, 0x80, 0xFF]))]) * n
    return data[:at] + (same if rng.random() < 0.5 else rng.bytes(n)) + data[at + n :]


def number(rng: Rng, data: bytes) -> bytes:
    """A number that no file holds, in the place of one that stands there."""
    width, order = str(rng.choice(["H", "I", "Q"])), str(rng.choice(["<", ">"]))
    size = struct.calcsize(width)
    value = NUMBERS[int(rng.integers(len(NUMBERS)))] % (1 << 8 * size)
    at = place(rng, data) // size * size if rng.random() < 0.5 else place(rng, data)
    return data[:at] + struct.pack(order + width, value) + data[at + size :]


def insert(rng: Rng, data: bytes) -> bytes:
    at = place(rng, data)
    return data[:at] + rng.bytes(int(rng.integers(1, 65))) + data[at:]


def delete(rng: Rng, data: bytes) -> bytes:
    at = place(rng, data)
    return data[:at] + data[at + int(rng.integers(1, 65)) :]


def repeat(rng: Rng, data: bytes) -> bytes:
    at, n = place(rng, data), int(rng.integers(1, 600))
    return data[:at] + data[at : at + n] * int(rng.integers(2, 5)) + data[at + n :]


def exchange(rng: Rng, data: bytes) -> bytes:
    """Two blocks change places."""
    a, b, c = sorted(place(rng, data) for _ in range(3))
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def blank(rng: Rng, data: bytes) -> bytes:
    """A block of zeros, as a disk leaves it that lost power."""
    at, n = place(rng, data), int(rng.choice([64, 512, 4096]))
    return data[:at] + bytes(len(data[at : at + n])) + data[at + n :]


def grow(rng: Rng, data: bytes) -> bytes:
    return data + rng.bytes(int(rng.integers(1, 3000)))


def head(rng: Rng, data: bytes) -> bytes:
    """The beginning of another format."""
    start = HEADS[int(rng.integers(len(HEADS)))]
    return start + (data if rng.random() < 0.3 else data[len(start) :])


def noise(rng: Rng, data: bytes) -> bytes:
    """Nothing but a beginning."""
    return data[: int(rng.integers(64))] + rng.bytes(int(rng.integers(1, 3000)))


def word(rng: Rng, data: bytes) -> bytes:
    """One word of a text replaced."""
    lines = data.split(b"\n")
    at = int(rng.integers(len(lines)))
    words = lines[at].split(b" ")
    words[int(rng.integers(len(words)))] = WORDS[int(rng.integers(len(WORDS)))]
    lines[at] = b" ".join(words)
    return b"\n".join(lines)


def digits(rng: Rng, data: bytes) -> bytes:
    """A character of a text becomes another that texts have."""
    at = int(rng.integers(len(data)))
    new = b"0123456789 .-+eE\n,;:[]{}\"#\r\t"[int(rng.integers(28))]
    return data[:at] + bytes([new]) + data[at + 1 :]


def order(rng: Rng, data: bytes) -> bytes:
    """A line of a text at another place, or twice."""
    lines = data.split(b"\n")
    line = lines[int(rng.integers(len(lines)))]
    lines.insert(int(rng.integers(len(lines))), line)
    return b"\n".join(lines)


BINARY: tuple[Mutation, ...] = (
    cut, cut, flip, flip, overwrite, number, number, insert, delete, repeat, exchange, blank, grow,
    head, noise)
TEXT: tuple[Mutation, ...] = (*BINARY, word, word, word, digits, digits, order)
FOREIGN = frozenset({"head", "noise"})  # after these the file may be sound in another way


def mutate(rng: Rng, data: bytes, text: bool) -> tuple[str, bytes]:
    """The name of a mutation drawn, and what it makes of the data."""
    mutations = TEXT if text else BINARY
    mutation = mutations[int(rng.integers(len(mutations)))]
    return mutation.__name__, mutation(rng, data)
