"""EVT3: the states that words set, against a decoder that goes word by word."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import equal, refused
from helpers.streams import SIZE, clustered, evt3

from evflow.io import read_events, read_recording
from evflow.notes import texts
from evflow.types import Events

HEADER = b"% evt 3.0\n% geometry 2048x2048\n"


def word_by_word(words: list[int]) -> tuple[list[tuple[int, int, int, int]], int]:
    """(x, y, t, p) of each event, and the number of those left out; one word after another."""
    events: list[tuple[int, int, int, int]] = []
    lost, loops, on = 0, 0, 0
    high: int | None = None
    low = 0
    y: int | None = None
    base: int | None = None
    for w in words:
        kind, value = w >> 12, w & 0xFFF
        xs: list[int] = []
        p = on
        if kind == 8:
            if high is not None and value < high:
                loops += 1
            low = low if high == value else 0
            high = value
        elif kind == 6:
            low = value
        elif kind == 0:
            y = value & 0x7FF
        elif kind == 2:
            xs, p = [value & 0x7FF], value >> 11
        elif kind == 3:
            base, on = value & 0x7FF, value >> 11
        elif kind in (4, 5):
            bits = [b for b in range(12 if kind == 4 else 8) if value >> b & 1]
            if base is None:
                lost += len(bits)
                continue
            xs = [base + b for b in bits]
            base += 12 if kind == 4 else 8
        if xs and (high is None or y is None):
            lost += len(xs)
        elif xs:
            assert high is not None
            assert y is not None
            events += [(x, y, loops << 24 | high << 12 | low, p) for x in xs]
    return events, lost


def random_words(n: int, seed: int) -> list[int]:
    """Words of all types in any order; time advances, x stays below 2048."""
    rng = np.random.default_rng(seed)
    out, high, low, base = [], 4000, 0, 0
    for _ in range(n):
        kind = int(rng.choice([0, 2, 3, 4, 5, 6, 7, 8, 10, 14, 15]))
        value = int(rng.integers(4096))
        if kind == 3:
            base = value & 0x7FF
        elif kind in (4, 5):
            base += 12 if kind == 4 else 8
            if base > 2047:
                kind, value, base = 3, 5, 5
        elif kind == 6:
            low = value = int(rng.integers(low, min(low + 400, 4096)))
        elif kind == 8:
            step = int(rng.choice([0, 0, 1, 900]))
            low = low if step == 0 else 0
            high = value = (high + step) % 4096
        out.append(kind << 12 | value)
    return out


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("chunk", [2, 6, 1 << 18])
def test_any_order_of_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, chunk: int
) -> None:
    monkeypatch.setattr("evflow.io.decode.stream.CHUNK", chunk)
    words = random_words(600, seed)
    path = tmp_path / "a.raw"
    path.write_bytes(HEADER + struct.pack(f"<{len(words)}H", *words))
    want, lost = word_by_word(words)
    got = read_recording(path)
    equal(got.events, Events(*np.array(want).T, (2048, 2048)))
    notes = " ".join(texts(got.notes))
    assert (f"{lost:,} events before the first time or row word" in notes) == (lost > 0)
    triggers = sum(w >> 12 == 10 for w in words)
    assert f"external triggers ({triggers:,})" in notes


def test_new_high_word_starts_at_low_zero(tmp_path: Path) -> None:
    """Between a new high word and its low word time would jump ahead by up to 4 ms."""
    path = tmp_path / "a.raw"
    words = [0x8001, 0x6FFF, 7, 0x2003, 0x8002, 0x2004, 0x6001, 0x2005, 0x8002, 0x2006]
    path.write_bytes(HEADER + struct.pack("<10H", *words))
    assert read_events(path).t.tolist() == [0x1FFF, 0x2000, 0x2001, 0x2001]


@pytest.mark.parametrize("chunk", [2, 34, 1 << 18])
def test_low_bits_that_begin_anew_without_a_high_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    """As expelliarmus writes: one high word in all. A later one counts as it stands, and where none
    is known to be missing a small step back stays one."""
    monkeypatch.setattr("evflow.io.decode.stream.CHUNK", chunk)
    path = tmp_path / "a.raw"
    times = np.cumsum(np.random.default_rng(0).integers(0, 900, 400)) + 5000
    words = [0x8001, 7, *(w for t in times.tolist() for w in (0x6000 | t & 0xFFF, 0x2003))]
    path.write_bytes(HEADER + struct.pack(f"<{len(words)}H", *words))
    got = read_recording(path)
    assert got.events.t.tolist() == times.tolist()
    assert [n.code for n in got.notes] == ["events.turns"]
    more = [0x8000 | times[-1] // 4096 + 2, 0x2003, 0x6005, 0x2003]
    path.write_bytes(HEADER + struct.pack(f"<{len(words) + 4}H", *words, *more))
    assert (read_events(path).t[-2:] & 0xFFF).tolist() == [0, 5]
    path.write_bytes(HEADER + struct.pack("<6H", 0x8001, 7, 0x6010, 0x2003, 0x6008, 0x2003))
    assert refused(path).code == "EV004"


def test_vectors_that_never_end_leave_the_sensor(tmp_path: Path) -> None:
    """70,000 masks after one base reach x = 840,000: refused, not wrapped into 16 bits."""
    path = tmp_path / "a.raw"
    words = [0x8000, 7, 0x3000] + [0x4000] * 70_000 + [0x4001]
    path.write_bytes(evt3(clustered(0)) + struct.pack(f"<{len(words)}H", *words))
    error = refused(path)
    assert error.code == "EV005"
    assert "x=840000" in str(error)


def test_flipped_bit_in_the_high_word_is_told(tmp_path: Path) -> None:
    """Whichever bit: time jumps ahead and comes back, or goes back at once."""
    path = tmp_path / "a.raw"
    for bit in range(12):
        words = [7] + [w for high in (5, 5 ^ 1 << bit, 6, 7) for w in (0x8000 | high, 0x2001)]
        path.write_bytes(evt3(clustered(0)) + struct.pack(f"<{len(words)}H", *words))
        assert refused(path).code == "EV004"


def test_agrees_with_the_package_evt3(tmp_path: Path) -> None:
    package = pytest.importorskip("evt3")
    path = tmp_path / "a.raw"
    path.write_bytes(evt3(clustered(3000)))
    got, other = read_events(path), package.decode_file(str(path))
    equal(got, Events(other.x, other.y, other.timestamp.astype(np.int64), other.polarity, SIZE))


def test_memory_of_full_vectors_is_bounded(tmp_path: Path) -> None:
    """A chunk of nothing but full masks is 1.5 million events: 100 MB of temporaries, not more."""
    path = tmp_path / "a.raw"
    words = np.full(400_000, 0x4FFF, "<u2")
    words[::100] = 0x3000
    path.write_bytes(HEADER + struct.pack("<2H", 0x8000, 7) + words.tobytes())
    tracemalloc.start()
    n = len(read_events(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert n == 396_000 * 12
    assert peak < 13 * n + 8 * n + 100e6
