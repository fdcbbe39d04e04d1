"""RAW whose header tells no encoding, or a wrong one: the words tell it, and it is said."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import equal, refused
from helpers.streams import clustered, evt2, evt3, evt21

from evflow.io import read_recording
from evflow.io.decode import prophesee
from evflow.io.decode.evt_words import fitting
from evflow.io.registry import find_format
from evflow.types import Events

WORDS = {"EVT2": evt2, "EVT2.1": evt21, "EVT3": evt3}
TAIL = b"% geometry 240x180\n% end\n"


def scattered(n: int, span: int, size: tuple[int, int]) -> Events:
    rng = np.random.default_rng(n)
    return Events(rng.integers(0, size[0], n), rng.integers(0, size[1], n),
                  np.sort(rng.integers(0, span, n)), rng.random(n) < 0.5, size)


@pytest.mark.parametrize("encoding", WORDS)
@pytest.mark.parametrize("header", [
    b"", b"% Date 2020-01-01\n", b"% evt 2.0\n", b"% evt 2.1\n", b"% evt 3.0\n"])
def test_the_words_tell_the_encoding(tmp_path: Path, encoding: str, header: bytes) -> None:
    want, path = clustered(2000), tmp_path / "a.raw"
    path.write_bytes((header + TAIL if header else b"") + WORDS[encoding](want, b""))
    got = read_recording(path, size=want.size)
    equal(got.events, want)
    declared = prophesee.parse(header).encoding
    said = [n.text for n in got.notes if "header" in n.text and "half" not in n.text]
    assert len(said) == (declared != encoding)
    assert all(encoding in text and declared in text for text in said)


@pytest.mark.parametrize("events", [
    clustered(4000), scattered(3000, 2_000_000, (346, 260)),
    scattered(20_000, 1_000_000, (1280, 720)), scattered(500, 300_000, (240, 180))])
def test_no_other_encoding_fits_alone(events: Events) -> None:
    """One that is sparse may leave two open: then the header holds."""
    for encoding, words in WORDS.items():
        found = fitting(words(events, b"")[:16384])
        assert encoding in found
        assert encoding == "EVT2.1" or found == [encoding]


def test_what_is_no_raw_is_not_taken_for_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for data in (rng.bytes(9999), bytes(9999), bytes(range(256)) * 40, b"RGGB" * 4000):
        assert fitting(data) == []
        (tmp_path / "a.raw").write_bytes(data)
        assert refused(tmp_path / "a.raw").code == "EV008"
    sound = evt3(clustered(2000), b"")
    (tmp_path / "a.bin").write_bytes(sound)  # no RAW by its name
    assert refused(tmp_path / "a.bin").code == "EV008"
    (tmp_path / "a.raw").write_bytes(b"% evt 4.0\n" + TAIL + sound)
    assert "EVT4" in refused(tmp_path / "a.raw").seen


@pytest.mark.parametrize("owner", ["Jörg", "名前"])
def test_names_in_headers_have_any_letters(tmp_path: Path, owner: str) -> None:
    want, path = clustered(300), tmp_path / "a.raw"
    for code in ("utf-8", "utf-16-be"):
        name = owner.encode(code).replace(b"\n", b"").replace(b"\r", b"")
        path.write_bytes(b"% evt 3.0\n% owner " + name + b"\n" + TAIL + evt3(want, b""))
        got = read_recording(path)
        equal(got.events, want)
        assert not got.notes


@pytest.mark.parametrize("name", ["evt2_sample.raw", "evt3_sample.raw"])
def test_real_recordings(name: str) -> None:
    path = Path(os.environ.get("EVFLOW_DATA") or "/nowhere") / "data/formats" / name
    if not path.is_file():
        pytest.skip("EVFLOW_DATA is not set")
    data = path.read_bytes()
    encoding = prophesee.parse(data[:4096]).encoding
    found = find_format(path).NAME
    assert encoding.lower() == found
    blocks = [data[at : at + 16384] for at in range(prophesee.parse(data).start,
                                                    len(data) - 16384, 16384)]
    assert all(fitting(block) == [encoding] for block in blocks)
