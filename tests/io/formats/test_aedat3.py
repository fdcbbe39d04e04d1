"""AEDAT 3: packets and their sources, frames and their exposure, and what cannot be read."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import equal, refused
from helpers.streams import SIZE, aedat3, aedat3_packet, clustered, listed

from evflow.io import read_events, read_recording
from evflow.notes import texts
from evflow.types import Events

HEADER = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS240C\r\n#!END-HEADER\r\n"


def event(x: int, y: int, t: int, p: int = 1, valid: int = 1) -> bytes:
    return struct.pack("<Ii", x << 17 | y << 2 | p << 1 | valid, t)


def frame(
    pixels: np.ndarray, stamps: tuple[int, int, int, int], *, channels: int = 1, valid: int = 1,
    colour: int = 0, place: tuple[int, int] = (0, 0), size: int = 2 * 240 * 180,
) -> bytes:
    height, width = pixels.shape[:2]
    info = valid | channels << 1 | colour << 4
    body = struct.pack("<Iiiiiiiii", info, *stamps, width, height, *place)
    return (body + pixels.astype("<u2").tobytes()).ljust(36 + size, b"\0")


def write(folder: Path, *packets: bytes, header: bytes = HEADER) -> Path:
    path = folder / "a.aedat"
    path.write_bytes(header + b"".join(packets))
    return path


def test_bits_by_hand(tmp_path: Path) -> None:
    """High bits of time are those of the packet; an invalid event, another source, other types."""
    path = write(tmp_path,
                 aedat3_packet(1, 8, event(239, 179, 5, 0) + event(9, 9, 6, valid=0)),
                 aedat3_packet(1, 8, event(1, 1, 7), source=2), aedat3_packet(3, 36, bytes(72)),
                 aedat3_packet(0, 8, bytes(24)), aedat3_packet(1, 8, b""),
                 aedat3_packet(1, 8, event(0, 3, 4), overflow=2))
    found = read_recording(path)
    assert listed(found.events) == [(239, 179, 5, 0), (0, 3, 2 * 2**31 + 4, 1)]
    assert found.events.size == (240, 180)
    assert set(texts(found.notes)) == {
        "1 events marked as invalid were not read", "1 other events were not read",
        "2 IMU samples were not read", "3 special events were not read",
        "events of source1/events were read; not read: source2/events; --events-topic NAME reads "
        "another"}


def test_each_camera_has_its_own_frames(tmp_path: Path) -> None:
    """Two in one file, of two sizes; the frames of the second come first."""
    size = 36 + 2 * 240 * 180
    dark, light = (np.full((180, 240), value) for value in (65535 // 5, 65535))
    header = HEADER.replace(b"#!END", b"#Source 2: DAVIS346\r\n#!END")
    path = write(tmp_path, aedat3_packet(2, size, frame(light, (900, 3000, 1000, 2000)), source=2),
                 aedat3_packet(1, 8, event(3, 4, 1000)),
                 aedat3_packet(1, 8, event(300, 200, 1000), source=2),
                 aedat3_packet(2, size, frame(dark, (900, 3000, 1000, 2000))),
                 aedat3_packet(1, 8, event(5, 6, 9000)), header=header)
    got = read_recording(path)
    assert (listed(got.events), got.events.size) == ([(3, 4, 1000, 1), (5, 6, 9000, 1)], (240, 180))
    np.testing.assert_allclose(got.frames, np.full((1, 180, 240), 51), rtol=1e-5)
    assert {"events of source1/events were read; not read: source2/events; --events-topic NAME "
            "reads another", "frames are from source1/frames; not used: source2/frames (346x260, "
            "the sensor has 240x180); --frames-topic NAME uses another"} < set(texts(got.notes))
    other = read_recording(path, events_topic="source2/events")
    assert (listed(other.events), other.events.size) == ([(300, 200, 1000, 1)], (346, 260))
    assert not other.has_frames
    assert "2 image streams" in str(refused(path, frames_topic="frames"))
    assert "2 event streams" in str(refused(path, events_topic="events"))


def test_frames_by_name(tmp_path: Path) -> None:
    size = 36 + 2 * 240 * 180
    events = aedat3_packet(1, 8, event(3, 4, 1000))
    path = write(tmp_path, events, aedat3_packet(
        2, size, frame(np.full((180, 240), 9999), (900, 3000, 1000, 2000))))
    got = read_recording(path, frames_topic="frames")
    assert len(got.frames) == 1
    assert "frames are from source1/frames" in texts(got.notes)
    assert "frames.unused" in [note.code for note in read_recording(path, late="join").notes]
    assert "1 frames were not read" in texts(read_recording(path, no_frames=True).notes)
    assert "There are: none" in str(refused(write(tmp_path, events), frames_topic="frames"))


def test_frames_at_mid_exposure(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 65536, (3, 180, 240))
    size = 36 + 2 * 240 * 180
    path = write(tmp_path, aedat3_packet(1, 8, event(3, 4, 1000)),
                 aedat3_packet(2, size, frame(pixels[0], (900, 3000, 1000, 2000))
                               + frame(pixels[1], (4000, 6000, 0, 0))
                               + frame(pixels[0], (6000, 6000, 6000, 6001), valid=0)),
                 aedat3_packet(1, 8, event(3, 4, 30_000)),
                 aedat3_packet(2, size, frame(pixels[2], (900, 3000, 1000, 2000)), overflow=1),
                 aedat3_packet(1, 8, event(3, 4, 30_000), overflow=1))
    found = read_recording(path)
    assert found.frame_times.tolist() == [1500, 5000, 2**31 + 1500]
    np.testing.assert_allclose(found.frames, pixels * (255 / 65535), rtol=1e-6)
    assert found.exposure_us == 1000
    assert texts(found.notes) == ["frame times are mid-exposure",
                                  "1 frames marked as invalid were not read",
                                  "frames are exposed for 1 ms, as the file says: estimate and "
                                  "simulate take out the blur of what moves by half a pixel or "
                                  "more in that time (--exposure-ms 0: they leave it)"]
    assert read_recording(path, stop_s=0.001).frame_times.tolist() == [1500]
    alone = read_recording(path, no_frames=True)
    equal(alone.events, found.events)
    assert not alone.has_frames


def test_colours_mosaics_and_regions(tmp_path: Path) -> None:
    """R, G, B becomes luma; a raw mosaic and frames of a part of the sensor are told."""
    size = 36 + 6 * 240 * 180
    red = np.zeros((180, 240, 3), int)
    red[..., 0] = 65535
    path = write(tmp_path, aedat3_packet(1, 8, event(3, 4, 1)), aedat3_packet(
        2, size, frame(red, (1, 9, 2, 8), channels=3, size=size - 36)))
    found = read_recording(path)
    np.testing.assert_allclose(found.frames, 255 * 0.299, rtol=1e-4)
    assert "frames.luma" in [note.code for note in found.notes]
    path = write(tmp_path, aedat3_packet(1, 8, event(3, 4, 1)), aedat3_packet(
        2, size, frame(red[..., 0], (1, 9, 2, 8), colour=1, size=size - 36)
        + frame(red[:9, :9, 0], (11, 19, 12, 18), place=(5, 6), size=size - 36)))
    found = read_recording(path)
    assert found.frames.shape == (1, 180, 240)
    assert {"frames.raw", "frames.unused"} <= {note.code for note in found.notes}
    assert any("9x9 from x=5, y=6" in text for text in texts(found.notes))


def test_version_3_0_counts_from_the_bottom(tmp_path: Path) -> None:
    header = b"#!AER-DAT3.0\r\n#Source 0: DVS128\r\n"
    got = read_events(write(tmp_path, aedat3_packet(1, 8, event(5, 0, 9)), header=header))
    assert (listed(got), got.size) == ([(5, 127, 9, 1)], (128, 128))


@pytest.mark.parametrize("source", [b"#Source 1: DVS128\n", b"#Source 1: Processor\r\n"
                                    b"#-Source 1: DVS128\r\n"])
def test_the_size_is_that_of_the_source(tmp_path: Path, source: bytes) -> None:
    header = b"#!AER-DAT3.1\n" + source + b"#!END-HEADER\n"
    path = write(tmp_path, aedat3_packet(1, 8, event(5, 0, 9)), header=header)
    assert read_events(path).size == (128, 128)
    path = write(tmp_path, header=header.replace(b"DVS128", b"Cochlea"))
    assert "Cochlea" in str(refused(path))
    assert refused(path).code == "EV015"


def test_packets_filled_up_to_their_capacity(tmp_path: Path) -> None:
    filled = (aedat3_packet(1, 8, event(5, 0, 9) + bytes(24), number=1, capacity=4)
              + aedat3_packet(1, 8, event(6, 0, 10) + bytes(24), number=1, capacity=4))
    assert read_events(write(tmp_path, filled)).x.tolist() == [5, 6]
    tight = (aedat3_packet(1, 8, event(5, 0, 9), capacity=4)
             + aedat3_packet(1, 8, event(6, 0, 10), capacity=4))
    assert read_events(write(tmp_path, tight)).x.tolist() == [5, 6]


@pytest.mark.parametrize(("tail", "code", "seen"), [
    (aedat3_packet(1, 8, event(1, 1, 5000))[:-3], "EV009", "ends within a packet of 1 events"),
    (aedat3_packet(1, 8, b"")[:9], "EV009", "ends 9 bytes into a packet header"),
    (bytes(28), "EV009", "not a packet header"),
    (b"\xff" * 28, "EV009", "not a packet header"),
    (aedat3_packet(1, 12, bytes(24)), "EV009", "events of 12 bytes"),
    (aedat3_packet(2, 20, bytes(20)), "EV009", "frames of 20 bytes"),
    (aedat3_packet(2, 40, struct.pack("<Iiiiiiiii", 3, 1, 2, 1, 2, 9999, 9999, 0, 0) + bytes(4)),
     "EV009", "a frame of 9999x9999"),
    (aedat3_packet(1, 8, event(1, 1, 5000), number=10**6), "EV009", "a packet of 1,000,000"),
    (aedat3_packet(-32767, 8, bytes(16)), "EV008", "compressed")])
def test_what_cannot_be_a_packet(tmp_path: Path, tail: Any, code: str, seen: str) -> None:
    """What stands before it is read with --partial, whatever it is."""
    path = write(tmp_path, aedat3_packet(1, 8, event(3, 4, 1000) + event(3, 5, 2000)), tail)
    error = refused(path)
    assert (error.code, seen in str(error)) == (code, True), str(error)
    if code == "EV009":
        assert read_events(path, partial=True).y.tolist()[:2] == [4, 5]


def test_a_cut_packet_keeps_its_whole_events(tmp_path: Path) -> None:
    events = clustered(150)
    path = tmp_path / "a.aedat"
    path.write_bytes(aedat3(events)[:-8 * 10 - 3])
    got = read_events(path, partial=True)
    equal(got, Events(*(getattr(events, name)[:139] for name in "xytp"), SIZE))
