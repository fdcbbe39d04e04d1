"""Which images are the frames: names, sizes, encodings; and that events are read whatever they are.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from helpers.bags import IMAGE, array_messages, header, needs_rosbags, packet_messages, write
from helpers.fuzz_aedat4 import STREAM, XML, event_packet, frame_packet, packet
from helpers.fuzz_aedat4 import header as header4
from helpers.recordings import T0, equal, make, refused, write_ijrr
from helpers.tables import DAVIS, WRITERS, based, want

from evflow.cli import main
from evflow.errors import EvflowDataError
from evflow.io import read_recording, write_recording
from evflow.io.hints import Hints
from evflow.io.images.encodings import ENCODINGS
from evflow.io.images.streams import ImageStream, choose
from evflow.io.source import open_frames
from evflow.types import Recording

SENSOR = (64, 48)
COMPRESSED = "sensor_msgs/msg/CompressedImage"


def taken(names: str, events: str = "/cam0/events", **told: Any) -> str | None:
    """The stream chosen of some, each `name` or `name:WxH`."""
    streams = [ImageStream(name, tuple(map(int, size.split("x"))) if size else SENSOR)  # type: ignore[arg-type]
               for name, _, size in (text.partition(":") for text in names.split())]
    chosen = choose(streams, Hints(**told), SENSOR, events)
    said = " ".join(note.text for note in chosen.notes)
    if len(streams) > 1:
        assert all(s.name in said for s in streams), "what was taken and what was left is said"
    return chosen.stream.name if chosen.stream else None


@pytest.mark.parametrize(("names", "best"), [
    ("/cam0/depthmap /cam0/image_raw", "/cam0/image_raw"),
    ("/cam0/image_corrupted /cam0/image_raw", "/cam0/image_raw"),
    ("/cam0/image /cam0/image_raw", "/cam0/image_raw"),
    ("/cam0/image_accumulated /cam0/image_reconstruction /cam0/image_raw", "/cam0/image_raw"),
    ("/cam0/image_rect /cam0/image_mono", "/cam0/image_mono"),
    ("/cam0/image_corrupted", "/cam0/image_corrupted"),
    ("/cam0/image_corrupted /cam0/image_raw/compressed", "/cam0/image_raw/compressed"),
    ("/cam0/image_raw /cam0/image_raw/compressed", "/cam0/image_raw"),
    ("/cam0/image_raw:640x480 /cam0/image_mono", "/cam0/image_mono"),
    ("/cam0/image_raw /cam1/image_raw", "/cam0/image_raw"),
    ("/camera/image_raw", "/camera/image_raw"),
    ("/camera/image_raw:32x32 /other/image_raw", "/other/image_raw"),
    ("/a/image_raw /b/image_raw", None),  # either, or neither
    ("/cam1/image_raw", None),
    ("/cam0/image_raw:32x24", None),
    *((f"/cam0/{made}", None) for made in (
        "image_reconstruction", "reconstructed", "accumulated_frame", "image_accumulated",
        "dvs_rendering", "rendered/image_raw", "event_image", "eventFrame", "time_surface",
        "e2vid/image", "depthmap", "optic_flow", "normals", "semantic_mask", "disparity"))])
def test_of_several_streams_the_raw_one_near_the_events_is_taken(
    names: str, best: str | None
) -> None:
    assert taken(names) == best
    assert taken(" ".join(reversed(names.split()))) == best


@pytest.mark.parametrize(("names", "events", "best"), [
    ("/davis/left/image_raw /davis/right/image_raw", "/davis/left/events", "/davis/left/image_raw"),
    ("/davis/right/image_raw", "/davis/left/events", None),
    ("/dvs/image_raw /dvs_rendering", "/dvs/events", "/dvs/image_raw"),
    ("/dvs/image_raw", "/events", "/dvs/image_raw"),
    ("/renderer/image_raw", "/event_camera/events", None),
    ("/event_camera/image_raw", "/event_camera/events", "/event_camera/image_raw"),
    ("capture/frames accumulator/frames", "capture/events", "capture/frames"),
    ("accumulator/frames", "capture/events", None), ("frames", "", "frames"),
    *((f"images/left images/right{more}", f"/events/{side}", f"images/{side}")
      for side in ("left", "right") for more in ("", " images/raw")),
    ("image_left image_right", "/events_right", "image_right"),
    ("image_left", "/events_right", None), ("image_left image_right", "/events", None),
    ("cam0_images cam1_images", "/cam1", "cam1_images"), ("/cam0_image", "/cam1_events", None),
    ("/cam0_image /cam1_image", "/cam1_events", "/cam1_image"),
    ("image_0 image_1", "/events_1", "image_1"), ("image_8bit", "/events_1", "image_8bit"),
    ("w/frames w/frames_right", "w/events_right", "w/frames_right"),
    ("w/frames w/frames_right", "w/events", "w/frames"), ("frames frames_2", "events", "frames"),
    ("/cam0/image_mono8 /cam0/sub/image_raw", "/cam0/events", "/cam0/image_mono8")])
def test_names_of_drivers(names: str, events: str, best: str | None) -> None:
    assert taken(names, events) == best


def test_a_stream_that_is_named_is_taken_or_refused() -> None:
    names = "/cam0/image_raw /cam0/image_corrupted /cam0/image_reconstruction /cam1/image:32x24"
    assert taken(names, frames_topic="/cam0/image_corrupted") == "/cam0/image_corrupted"
    assert taken(names, frames_topic="image_corrupted") == "/cam0/image_corrupted"
    streams = [ImageStream("/cam0/image_reconstruction", SENSOR), ImageStream("/d", SENSOR, "no")]
    named = Hints(frames_topic="/cam0/image_reconstruction")
    made = choose(streams, named, SENSOR, "/cam0/events")
    assert [n.code for n in made.notes] == ["frames.stream", "frames.made"]
    assert choose(streams, Hints(no_frames=True), SENSOR).stream is None
    for name, code in (("/none", "EV020"), ("/cam1/image", "EV015")):
        with pytest.raises(EvflowDataError, match="--no-frames") as raised:
            taken(names, frames_topic=name)
        assert raised.value.code == code
    with pytest.raises(EvflowDataError, match="EV008"):
        choose(streams, Hints(frames_topic="/d"), SENSOR)
    with pytest.raises(EvflowDataError, match="EV020"):
        Hints(frames_topic="/d", no_frames=True)


def images(topic: str, encoding: str, frames: list[bytes], step: int, size: Any = SENSOR,
           big: bool = False) -> list[tuple[str, str, int, bytes]]:
    out = []
    for i, data in enumerate(frames):
        ns = (T0 + 1000 + 50_000 * i) * 1000
        out.append((topic, IMAGE, ns, header(ns) + struct.pack("<2I", size[1], size[0])
                    + struct.pack("<I", len(encoding)) + encoding.encode()
                    + struct.pack("<B2I", big, step, len(data)) + data))
    return out


def encoded(name: str, rng: np.random.Generator) -> tuple[bytes, int, np.ndarray, bool]:
    """Bytes of an image of that encoding, its rows, the grey it should become (by plain
    arithmetic, unrounded), and whether it is big-endian."""
    lower = name.lower()
    deep, big = "16" in lower, name in ("mono16", "rgb16")
    kind = (">" if big else "<") + ("u2" if deep else "u1")
    top = 60_000 if deep else 250
    weights = {"r": .299, "g": .587, "b": .114}
    if lower.startswith("bayer"):
        level = {c: int(rng.integers(top)) for c in "rgb"}  # one colour everywhere
        seen = np.zeros(SENSOR[::-1])
        for i, c in enumerate(lower[6:10]):
            seen[i // 2::2, i % 2::2] = level[c]
        grey = np.full(SENSOR[::-1], sum(weights[c] * level[c] for c in "rgb"))
        return seen.astype(kind).tobytes(), SENSOR[0] * (1 + deep), grey, big
    order = {"m": "y", "r": "rgb", "b": "bgr"}.get(lower[0]) or (
        "y" if lower.endswith("1") else "bgr")
    alpha = lower.endswith("c4") or lower[3] == "a"
    pixels = rng.integers(0, top, (48, 64, len(order) + alpha))
    grey = pixels[..., 0] if order == "y" else sum(
        weights[c] * pixels[..., i] for i, c in enumerate(order))
    return pixels.astype(kind).tobytes(), pixels.shape[2] * 64 * (1 + deep), grey, big


@needs_rosbags
def test_every_encoding_becomes_grey_of_its_depth(tmp_path: Path) -> None:
    rng, want = np.random.default_rng(0), make(300, 2)
    names = ["mono8", "mono16", "rgb8", "bgr8", "rgba8", "bgra8", "rgb16", "bgr16", "rgba16",
             "bgra16", "8UC1", "8UC3", "8UC4", "16UC1", "16UC3", "16UC4",
             *(f"bayer_{p}{d}" for p in ("rggb", "bggr", "gbrg", "grbg") for d in (8, 16))]
    assert sorted(ENCODINGS) == sorted(name.lower() for name in names)
    for name in names:
        data, step, grey, big = encoded(name, rng)
        got = read_recording(write(tmp_path / "a.bag", array_messages(want.events)
                                   + images("/dvs/image_raw", name, [data], step, big=big)))
        assert got.frames.dtype == (np.uint16 if "16" in name else np.uint8), name
        assert np.abs(got.frames[0] - grey).max() <= 0.51 + (got.frames.dtype == np.uint16), name
        codes = {note.code for note in got.notes}
        assert ("frames.mosaic" in codes) == name.startswith("bayer")
        assert got.frame_times.tolist() == [T0 + 1000]


@needs_rosbags
@pytest.mark.parametrize(("encoding", "size", "said"), [
    ("32FC1", SENSOR, "floats"), ("yuv422", SENSOR, "encoding 'yuv422'"),
    ("mono8", (32, 24), "32x24, the sensor has 64x48"), ("", SENSOR, "unknown encoding")])
def test_images_that_are_no_frames_leave_the_events(
    tmp_path: Path, encoding: str, size: tuple[int, int], said: str
) -> None:
    want = make(300, 2)
    odd = images("/dvs/image", encoding, [bytes(size[0] * size[1] * 4)], size[0] * 4, size)
    path = write(tmp_path / "a.bag", array_messages(want.events) + odd)
    got = read_recording(path)
    equal(got.events, want.events)
    assert not got.has_frames
    assert [note.code for note in got.notes] == ["frames.unused"]
    assert "/dvs/image" in got.notes[0].text
    assert said in got.notes[0].text
    raw = images("/dvs/image_raw", "mono8", [f.tobytes() for f in want.frames], 64)
    path = write(tmp_path / "a.bag", array_messages(want.events) + odd + raw)
    got = read_recording(path)
    np.testing.assert_array_equal(got.frames, want.frames)
    assert said in got.notes[1].text
    assert refused(path, frames_topic="/dvs/image").code in ("EV008", "EV015")


@needs_rosbags
def test_damaged_frames_are_refused_with_a_way_to_the_events(tmp_path: Path) -> None:
    want = make(300, 2)
    good = [f.tobytes() for f in want.frames]
    bag = array_messages(want.events)
    path = write(tmp_path / "a.bag", bag + images("/dvs/image_raw", "mono8", [*good, b"cut"], 64))
    error = refused(path)
    assert error.code == "EV009"
    assert "--no-frames" in error.fix
    got = read_recording(path, no_frames=True)
    equal(got.events, want.events)
    assert not got.has_frames
    other = images("/dvs/image_raw", "mono8", [good[0]], 64)
    small = images("/dvs/image_raw", "mono8", [b"", bytes(32 * 24)], 32, (32, 24))[1:]
    got = read_recording(write(tmp_path / "a.bag", bag + other + small))
    np.testing.assert_array_equal(got.frames, want.frames[:1])
    assert "1 of 32x24" in got.notes[-1].text


@needs_rosbags
def test_compressed_images_and_other_clocks(tmp_path: Path) -> None:
    want = make(300, 2)
    ns = (T0 + 1000) * 1000
    _, png = cv2.imencode(".png", want.frames[0])
    data = header(ns) + struct.pack("<I", 3) + b"png" + struct.pack("<I", len(png)) + png.tobytes()
    message = ("/dvs/image_raw/compressed", COMPRESSED, ns, data)
    got = read_recording(write(tmp_path / "a.bag", [*array_messages(want.events), message]))
    np.testing.assert_array_equal(got.frames, want.frames[:1])
    raw = images("/cam/image_raw", "mono8", [f.tobytes() for f in want.frames], 64)
    path = write(tmp_path / "a.bag", packet_messages(make().events, "mono") + raw)
    assert not read_recording(path).has_frames
    assert len(read_recording(path, frames_topic="/cam/image_raw", stop_s=0.1).frames) == 2




def sized(recording: Recording, width: int, height: int) -> Recording:
    """The same events, on the same sensor, beside frames of another size."""
    frames = np.zeros((len(recording.frames), height, width), np.uint8)
    odd = object.__new__(Recording)
    for name, value in (("events", recording.events), ("frames", frames),
                        ("frame_times", recording.frame_times), ("notes", ())):
        object.__setattr__(odd, name, value)
    return odd


def dsec(folder: Path, odd: Recording) -> Path:
    path = folder / "a.h5"
    write_recording(path, Recording.of_events(odd.events), overwrite=True)
    with h5py.File(path, "a") as f:
        f["frames"], f["frame_times"] = odd.frames, odd.frame_times
    return path


def npz(folder: Path, odd: Recording) -> Path:
    e = odd.events
    np.savez(folder / "a.npz", x=e.x, y=e.y, t=e.t, p=e.p, size=e.size, frames=odd.frames,
             frame_times=odd.frame_times)
    return folder / "a.npz"


FILES: dict[str, Callable[[Path, Recording], Path]] = {
    "dsec": dsec, "npz": npz, "ijrr": write_ijrr,
    **{kind: WRITERS[kind] for kind in ("v2e", "mvsec", "event_utils", "evreal")}}
BY_FRAMES = ("ijrr", "v2e")  # no more of the size is known


@pytest.mark.parametrize("kind", FILES)
def test_frames_of_another_size_leave_the_events_of_a_file(tmp_path: Path, kind: str) -> None:
    size = DAVIS if kind == "mvsec" else SENSOR
    sound = want(kind, 300) if kind in WRITERS else based(make(300), T0)
    odd = sized(make(300) if kind == "ijrr" else sound, 80, 70)  # which subtracts T0 itself
    path = FILES[kind](tmp_path, odd)
    told = {"size": size} if kind in BY_FRAMES else {}
    got = read_recording(path, **told)
    equal(got.events, sound.events)
    assert not got.has_frames
    (note,) = [note for note in got.notes if note.code == "frames.unused"]
    assert f"80x70, the sensor has {size[0]}x{size[1]}" in note.text
    alone = read_recording(path, no_frames=True, **told)
    assert "frames.unused" not in {note.code for note in alone.notes}
    assert refused(path, frames_topic="nothing", **told).code == "EV020"


def test_frames_that_were_transposed_are_told(tmp_path: Path) -> None:
    got = read_recording(npz(tmp_path, sized(make(300), 48, 64)))
    assert "frames (48x64, the sensor has 64x48: width and height swapped?)" in got.notes[0].text


def test_frames_that_do_not_fit_their_times_are_refused_with_a_way_out(tmp_path: Path) -> None:
    sound = based(make(300), T0)
    e = sound.events
    np.savez(tmp_path / "a.npz", x=e.x, y=e.y, t=e.t, p=e.p, size=e.size, frames=sound.frames)
    error = refused(tmp_path / "a.npz")
    assert error.code == "EV008"
    assert "--no-frames" in error.fix
    equal(read_recording(tmp_path / "a.npz", no_frames=True).events, e)
    path = dsec(tmp_path, sound)
    with h5py.File(path, "a") as f:
        f["frame_times"][1] = f["frame_times"][0]
    assert "--no-frames" in refused(path).fix
    equal(read_recording(path, no_frames=True).events, e)


def test_several_frame_outputs_of_dv_and_regions(tmp_path: Path) -> None:
    pytest.importorskip("aedat")
    sound = make(300, 2)
    outputs = (("capture", "events", "EVTS"), ("accumulator", "frames", "FRME"),
               ("capture", "frames", "FRME"))
    xml = "".join(STREAM.format(i, kind).replace("Name\" type=\"string\">capture", f"Name\" type="
                  f"\"string\">{module}").replace(f"OutputName\" type=\"string\">{kind}",
                  f"OutputName\" type=\"string\">{name}") for i, (module, name, kind) in
                  enumerate(outputs))
    times = [int(t) for t in sound.frame_times]
    path = tmp_path / "a.aedat4"
    path.write_bytes(header4(XML.format(xml)) + packet(0, event_packet(sound.events)) + b"".join(
        packet(1, frame_packet(255 - frame, t)) + packet(2, frame_packet(frame, t))
        for frame, t in zip(sound.frames, times, strict=True))
        + packet(2, frame_packet(sound.frames[0][10:30, 20:60].copy(), times[1] + 9000, (20, 10))))
    got = read_recording(path)
    np.testing.assert_array_equal(got.frames, sound.frames)
    said = " ".join(note.text for note in got.notes)
    assert "frames are from capture/frames; not used: accumulator/frames" in said
    assert "left out: 1 of 40x20 from x=20, y=10" in said
    assert not read_recording(path, no_frames=True).has_frames
    other = read_recording(path, frames_topic="accumulator/frames")
    np.testing.assert_array_equal(other.frames, 255 - sound.frames)
    assert other.frames_were_made


def test_the_commands_choose_and_do_without(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rosbags")
    sound = make(300, 2)
    path = write(tmp_path / "a.bag", [m for topic in ("/dvs/image_raw", "/dvs/image_corrupted")
                 for m in images(topic, "mono8", [f.tobytes() for f in sound.frames], 64)]
                 + array_messages(sound.events))
    for options, count in (((), 2), (("--no-frames",), 0),
                           (("--frames-topic", "/dvs/image_corrupted"), 2)):
        assert main(["info", str(path), "--json", *options]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["frames"] == count
        assert ("image_corrupted" in str(facts["notes"])) == (count > 0)
    assert main(["check", str(path)]) == 0
    assert "note: frames are from /dvs/image_raw; not used: /dvs/image_corrupted" in (
        capsys.readouterr().err)
    assert main(["info", str(path), "--no-frames", "--frames", "a.mp4"]) == 2
    with pytest.raises(EvflowDataError, match="EV020"):
        open_frames(path, frames_topic="/none")
    assert open_frames(path, frames_topic="/dvs/image_corrupted").size == SENSOR
