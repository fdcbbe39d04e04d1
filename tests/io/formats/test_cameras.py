"""Several cameras in one file: the first is read, or the one asked for; the others are named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.bags import array_messages, image_messages, needs_rosbags, write
from helpers.fuzz_aedat4 import STREAM, XML, event_packet, frame_packet, header, packet
from helpers.recordings import equal, make, refused
from helpers.tables import DAVIS, based

from evflow.cli import main
from evflow.io import read_events, read_recording
from evflow.types import Recording

ONE, OTHER = make(), make(500)


def bag(folder: Path) -> Path:
    messages = [message for side, r in (("left", ONE), ("right", OTHER))
                for message in (*array_messages(r.events, f"/davis/{side}/events"),
                                *image_messages(r, f"/davis/{side}/image_raw"))]
    return write(folder / "a.bag", messages)


def hdf5(folder: Path) -> Path:
    with h5py.File(folder / "a.h5", "w") as f:
        f.attrs["resolution"] = ONE.events.size
        for side, r in (("left", ONE), ("right", OTHER)):
            for name in "xytp":
                f[f"davis/{side}/cd/{name}"] = getattr(r.events, name)
    (folder / "a.h5").rename(folder / "cameras.h5")
    return folder / "cameras.h5"


def aedat4(folder: Path, told: str = "capture") -> Path:
    """told: what of the streams' description differs between left and right."""
    pytest.importorskip("aedat")
    kinds = ("EVTS", "FRME", "EVTS", "FRME")
    xml = XML.format("".join(STREAM.format(i, kind).replace(
        f">{told}<", f">{'left' if i < 2 else 'right'}<") for i, kind in enumerate(kinds)))
    data = header(xml)
    for i, r in ((0, ONE), (2, OTHER)):
        data += packet(i, event_packet(r.events))
        data += b"".join(packet(i + 1, frame_packet(frame, int(t)))
                         for frame, t in zip(r.frames, r.frame_times, strict=True))
    (folder / "a.aedat4").write_bytes(data)
    return folder / "a.aedat4"


FILES: dict[str, tuple[Callable[[Path], Path], str, bool]] = {  # the names, whether with frames
    "bag": (bag, "/davis/{}/events", True), "hdf5": (hdf5, "/davis/{}/cd", False),
    "aedat4": (aedat4, "{}/EVTS", True)}


@pytest.mark.parametrize("kind", FILES)
def test_either_camera_is_read_with_its_own_frames(tmp_path: Path, kind: str) -> None:
    if kind == "bag":
        pytest.importorskip("rosbags")
    make_file, name, framed = FILES[kind]
    path = make_file(tmp_path)
    left, right = name.format("left"), name.format("right")
    for asked, want, other in ((None, ONE, right), (left, ONE, right), (right, OTHER, left)):
        got = read_recording(path, events_topic=asked)
        equal(got.events, want.events)
        np.testing.assert_array_equal(got.frames, want.frames if framed else want.frames[:0])
        said, = (n.text for n in got.notes if n.code == "sensor.camera")
        assert f"not read: {other}" in said
    error = refused(path, events_topic="/none")
    assert (error.code, left in error.fix, right in error.fix) == ("EV020", True, True)
    alone = read_events(path, events_topic=right.strip("/"), no_frames=True)
    assert len(alone) == len(OTHER.events)


def test_streams_of_aedat4_belong_together_by_their_source(tmp_path: Path) -> None:
    """As dv-processing writes two cameras: modules and outputs have the same names."""
    path = aedat4(tmp_path, "camera")
    for asked, want in (("capture/EVTS", ONE), ("capture/EVTS/2", OTHER)):
        got = read_recording(path, events_topic=asked)
        equal(got.events, want.events)
        np.testing.assert_array_equal(got.frames, want.frames)
        assert any("(of another camera)" in n.text for n in got.notes)
    named = read_recording(path, events_topic="capture/EVTS/2", frames_topic="capture/FRME")
    np.testing.assert_array_equal(named.frames, ONE.frames)


def test_a_stream_of_aedat4_without_packets_is_not_the_first(tmp_path: Path) -> None:
    pytest.importorskip("aedat")
    xml = XML.format(STREAM.format(0, "EVTS") + STREAM.format(1, "EVTS"))
    path = tmp_path / "a.aedat4"
    path.write_bytes(header(xml) + packet(1, event_packet(ONE.events)))
    equal(read_events(path), ONE.events)


def test_the_right_camera_of_mvsec(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as f:
        for side, r in (("left", ONE), ("right", OTHER)):
            ev = r.events
            f[f"davis/{side}/events"] = np.stack([ev.x, ev.y, ev.t / 1e6, 2.0 * ev.p - 1], 1)
    got = read_recording(tmp_path / "a.hdf5", events_topic="right")
    equal(got.events, based(Recording.of_events(OTHER.events), 0, DAVIS).events)
    assert "not read: left" in got.notes[0].text


@needs_rosbags
def test_a_camera_that_is_the_only_one(tmp_path: Path) -> None:
    path = write(tmp_path / "a.bag", array_messages(ONE.events, "/cam0/events"))
    equal(read_events(path, events_topic="/cam0/events"), ONE.events)
    np.savez(tmp_path / "a.npz", **{n: getattr(ONE.events, n) for n in "xytp"}, size=(64, 48))
    assert refused(tmp_path / "a.npz", events_topic="left").code == "EV020"
    for bad in ("", "/"):
        assert refused(path, events_topic=bad).code == "EV020"


@needs_rosbags
def test_commands_take_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bag(tmp_path)
    assert main(["info", str(path), "--events-topic", "/davis/right/events"]) == 0
    assert "500" in capsys.readouterr().out
