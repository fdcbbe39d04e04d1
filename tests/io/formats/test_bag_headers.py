"""Bags whose messages do not say what they should: no size, no time, no encoding."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.bags import (
    Messages,
    array_messages,
    header,
    image_messages,
    needs_rosbags,
    write,
)
from helpers.recordings import equal, make, refused

from evflow.io import read_recording
from evflow.light.colour import mosaic_luma
from evflow.types import Events

pytestmark = needs_rosbags
WANT = make()
SIZED = struct.pack("<2I", 48, 64)


def unsized(messages: Messages, first: int, last: int) -> Messages:
    """Those from first to last without a size."""
    return [(topic, kind, ns, data.replace(SIZED, bytes(8), 1) if first <= i < last else data)
            for i, (topic, kind, ns, data) in enumerate(messages)]


@pytest.mark.parametrize(("first", "last"), [(0, 1), (0, 4), (2, 3), (1, 5)])
def test_the_size_is_that_of_any_message(tmp_path: Path, first: int, last: int) -> None:
    got = read_recording(write(tmp_path / "a.bag", unsized(
        array_messages(WANT.events), first, last)))
    equal(got.events, WANT.events)
    assert not got.notes


def test_the_size_is_that_of_the_frames(tmp_path: Path) -> None:
    events = unsized(array_messages(WANT.events), 0, 9)
    got = read_recording(write(tmp_path / "a.bag", events + image_messages(WANT)))
    equal(got.events, WANT.events)
    assert len(got.frames) == len(WANT.frames)
    note, = (n for n in got.notes if n.code == "sensor.size")
    assert "images of /dvs/image_raw, 64x48" in note.text
    got = read_recording(tmp_path / "a.bag", no_frames=True)
    equal(got.events, WANT.events)
    for topic in ("/dvs_rendering", "/cam1/depthmap"):  # no frames of these events
        path = write(tmp_path / "b.bag", events + image_messages(WANT, topic))
        assert refused(path).code == "EV015"
    assert refused(write(tmp_path / "b.bag", events)).code == "EV015"


@pytest.mark.parametrize("size", [SIZED, bytes(8), struct.pack("<2I", 1, 1)])
def test_messages_without_events_say_nothing(tmp_path: Path, size: bytes) -> None:
    full = array_messages(WANT.events)
    ns = full[0][2] - 1000
    empty = (*full[0][:2], ns, header(ns) + size + struct.pack("<I", 0))
    got = read_recording(write(tmp_path / "a.bag", [empty, *full]))
    equal(got.events, WANT.events)
    only = read_recording(write(tmp_path / "b.bag", [empty]), size=(64, 48))
    equal(only.events, Events([], [], [], [], (64, 48)))


def test_images_whose_headers_have_no_time(tmp_path: Path) -> None:
    images = [(topic, kind, ns, header(0) + data[len(header(ns)):])
              for topic, kind, ns, data in image_messages(WANT)]
    got = read_recording(write(tmp_path / "a.bag", array_messages(WANT.events) + images))
    np.testing.assert_array_equal(got.frame_times, WANT.frame_times)
    assert "at which /dvs/image_raw was recorded" in got.notes[0].text


@pytest.mark.parametrize(("encoding", "mosaic"), [
    ("bayer_rggb8; png compressed ", "rggb"), ("BAYER_GBRG8; jpeg compressed", "gbrg"),
    ("mono8; png compressed ", ""), ("png", ""), ("", "")])
def test_a_mosaic_that_was_compressed(tmp_path: Path, encoding: str, mosaic: str) -> None:
    """image_transport compresses it as it is: grey, by its pixels."""
    frame = np.add.outer(np.arange(48) % 2 * 80, np.arange(64) % 2 * 60 + 20).astype(np.uint8)
    ns = int(WANT.events.t[0]) * 1000 + 5000
    data = cv2.imencode(".png", frame)[1].tobytes()
    image = ("/dvs/image_raw/compressed", "sensor_msgs/msg/CompressedImage", ns,
             header(ns) + struct.pack("<I", len(encoding)) + encoding.encode()
             + struct.pack("<I", len(data)) + data)
    got = read_recording(write(tmp_path / "a.bag", [*array_messages(WANT.events), image]))
    want = mosaic_luma(frame, mosaic) if mosaic else frame
    np.testing.assert_array_equal(got.frames[0], want)
    assert ("frames.mosaic" in {n.code for n in got.notes}) == bool(mosaic)
