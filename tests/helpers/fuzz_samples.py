"""A small sound file of every format that evflow reads, as fuzzing starts from.

`SAMPLES[kind](folder)` writes one and says how it is read. Everything is made here, except that
`aedat4-lz4` is the beginning of a real recording and needs EVFLOW_DATA.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from helpers import bags, streams, tables
from helpers.fuzz_aedat4 import STREAM, XML, event_packet, frame_packet, header, packet
from helpers.fuzz_formats import FORMATS
from helpers.fuzz_sample import FRAMES, N, Sample, sample
from helpers.recordings import SIZE, make, write_ijrr, zipped
from helpers.videos import drifting

from evflow.io import write_events
from evflow.io.source import open_frames
from evflow.types import Events, Recording

REAL_AEDAT4 = "data/formats/dvxplorer320.aedat4"


# ------------------------------------------------------------------------------------ recordings


TEXTS = ("v2e-text", "text")


def stream(folder: Path, kind: str) -> Sample:
    return sample(streams.write(folder, kind, streams.clustered(N)))


def table(folder: Path, kind: str) -> Sample:
    path = tables.write(folder, kind, N)
    if path.is_dir():
        names = (("events_ts", "images", "events_xy", "events_p", "images_ts")
                 if kind == "evreal" else
                 tuple(f"dataset_events_{name}" for name in ("t", "xy", "p")))
        targets = [path / f"{name}.npy" for name in names]
        targets += [path / "metadata.json"] if kind == "evreal" else []
    else:
        targets = [path]
    return sample(path, *targets, text=kind in TEXTS, counted=kind not in TEXTS,
                  sealed=kind == "e2vid", **tables.hint(kind))


def dsec(folder: Path) -> Sample:
    write_events(folder / "a.h5", make(N, FRAMES))
    return sample(folder / "a.h5", sealed=True)


def npz(folder: Path) -> Sample:
    write_events(folder / "a.npz", make(N, FRAMES), "npz")
    return sample(folder / "a.npz", sealed=True)


def ijrr(folder: Path) -> Sample:
    path = write_ijrr(folder / "ijrr", make(N, FRAMES))
    return sample(path, path / "events.txt", path / "images.txt",
                  path / "images/frame_00000000.png", text=True)


def ijrr_zip(folder: Path) -> Sample:
    return sample(zipped(write_ijrr(folder / "ijrr", make(N, FRAMES)), "deep/"), sealed=True)


def e2vid_text(folder: Path) -> Sample:
    tables.write(folder, "e2vid", N)
    rows = (f"{t / 1e6:.9f} {x} {y} {p}" for t, x, y, p in tables.rows(
        tables.want("e2vid", N)))
    (folder / "a.txt").write_text("\n".join((f"{SIZE[0]} {SIZE[1]}", *rows)) + "\n")
    return sample(folder / "a.txt", text=True)


def bag(folder: Path, encoding: str, lz4: bool) -> Sample:
    recording = make(N, FRAMES)
    messages = (bags.packet_messages(recording.events, encoding) if encoding else
                bags.array_messages(recording.events))
    messages += bags.image_messages(
        recording, "/cam/image_raw" if encoding else "/dvs/image_raw")
    return sample(bags.write(folder / "a.bag", messages, lz4), counted=True)


def bag2(folder: Path, storage: str, encoding: str, compression: str | None) -> Sample:
    """A folder; its metadata have the ends of time and the counts, which nothing is read by."""
    from helpers import bags2

    recording, store = make(N, FRAMES), bags2.Store.new()
    events = (store.packets(recording.events, encoding) if encoding else
              store.arrays(recording.events))
    path = store.write(folder / "bag", {
        "/cam/events": events, "/cam/image_raw": store.images(recording)}, storage, compression)
    metadata = path / "metadata.yaml"
    file, = (p for p in path.iterdir() if p != metadata)
    return sample(path, file, metadata)


def aedat4(folder: Path) -> Sample:
    """Uncompressed, so that damage reaches the tables behind the decompression."""
    recording = make(N, FRAMES)
    xml = XML.format(STREAM.format(0, "EVTS") + STREAM.format(1, "FRME"))
    data = b"".join(packet(0, event_packet(part))
                    for part in bags.split(recording.events))
    data += b"".join(packet(1, frame_packet(*pair)) for pair in zip(
        recording.frames, recording.frame_times.tolist(), strict=True))
    (folder / "a.aedat4").write_bytes(header(xml) + data)
    return sample(folder / "a.aedat4")


def aedat4_lz4(folder: Path) -> Sample:
    real = Path(os.environ["EVFLOW_DATA"]) / REAL_AEDAT4
    with open(real, "rb") as f:
        data = f.read(1 << 17)
    end = 18 + int.from_bytes(data[14:18], "little")
    for _ in range(8):  # packets {i32 stream, i32 size, size bytes}
        end += 8 + int.from_bytes(data[end + 4 : end + 8], "little")
    untabled = data[:54] + b"\xff" * 8 + data[62:end]  # no table of packets at the file's end
    (folder / "a.aedat4").write_bytes(untabled)
    return sample(folder / "a.aedat4")


def forgiving(folder: Path, kind: str) -> Sample:
    """The same, of which what lies before the damage is asked for."""
    made = SAMPLES[kind](folder)
    return dataclasses.replace(
        made, read=partial(made.read, partial=True), sealed=False, counted=False)


def mended(folder: Path, kind: str, late: str) -> Sample:
    """The same, with times that go back left out, sorted or joined."""
    made = SAMPLES[kind](folder)
    return dataclasses.replace(made, read=partial(made.read, late=late), sealed=False,
                               counted=False)


# --------------------------------------------------------------------------- what else is read


def as_recording(path: Path, **hints: Any) -> Recording:
    """All frames of a source, with no events."""
    source = open_frames(path, **hints)
    pairs = list(source.open())
    none = np.zeros(0, int)
    events = Events(none, none, none, none, source.size)
    frames = np.stack([frame for frame, _ in pairs]) if pairs else np.zeros((0, 1, 1), np.uint8)
    return Recording(events, frames, np.array([t for _, t in pairs], np.int64))


def frames_of(path: Path, *targets: Path, text: bool = False, counted: bool = False,
              sealed: bool = False, **hints: Any) -> Sample:
    return Sample(path, targets or (path,), partial(as_recording, **hints), sealed, counted, text)


def images(folder: Path, suffix: str) -> Sample:
    path = folder / "frames"
    path.mkdir()
    for i, frame in enumerate(drifting(3, SIZE[::-1]).astype(np.uint8)):
        assert cv2.imwrite(str(path / f"f{i}.{suffix}"), frame)
    (path / "timestamps.txt").write_text("0.1 f0\n0.2 f1\n0.3 f2\n")
    return frames_of(path, path / f"f1.{suffix}", sealed=suffix == "png")


def times(folder: Path) -> Sample:
    path = images(folder, "pgm").path
    (path / "timestamps.txt").write_text("# time [us]\n0 f0\n40000 f1\n80000 f2\n")
    return frames_of(path, path / "timestamps.txt", text=True)


def stack(folder: Path, suffix: str) -> Sample:
    path, frames = folder / f"a.{suffix}", drifting(4, SIZE[::-1]).astype(np.uint8)
    if suffix == "npy":
        np.save(path, frames)
        return frames_of(path, counted=True, fps=25)
    np.savez_compressed(path, frames=frames, timestamps=np.arange(4) * 40_000)
    return frames_of(path, sealed=True, counted=True, time_unit="us")


def video(folder: Path, suffix: str, fourcc: str) -> Sample:
    path = folder / f"a.{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), 25.0, SIZE)
    for frame in drifting(6, SIZE[::-1]).astype(np.uint8):
        writer.write(np.stack([frame, frame // 2, 255 - frame], -1))
    writer.release()
    return frames_of(path)


def camera(folder: Path) -> Sample:
    from evflow.camera import Camera

    rng = np.random.default_rng(0)
    maps = rng.uniform(0.1, 0.5, (4, 12, 16)).astype(np.float32)
    Camera(*maps).save(folder / "camera.npz")  # type: ignore[arg-type]
    return Sample(folder / "camera.npz", (folder / "camera.npz",), Camera.load, True, True)


def weights(folder: Path) -> Sample:
    from evflow.network.weights import load_weights, save_weights

    path = folder / "a.safetensors"
    save_weights(path, {"a": {"b": np.ones((3, 4)), "c": np.zeros(5)}, "d": np.ones(2)}, {"k": 1})
    return Sample(path, (path,), load_weights, counted=True)


def coco(folder: Path) -> Sample:
    from helpers.masks import pack

    from evflow.scenes import read_coco

    path = folder / "a.json"
    square = [10.5, 10, 30, 10, 30, 31.25, 10, 30]
    shapes: list[Any] = [[square], {"size": [48, 64], "counts": [1000, 72, 2000]},
                         {"size": [48, 64], "counts": pack([1000, 72, 2000])}]
    path.write_text(json.dumps({
        "images": [{"id": i, "file_name": f"f{i}.png", "width": 64, "height": 48}
                   for i in range(2)],
        "categories": [{"id": 1, "name": "thing"}],
        "annotations": [{"id": i, "image_id": i % 2, "category_id": 1, "area": 400.0,
                         "iscrowd": 0, "segmentation": shape} for i, shape in enumerate(shapes)]}))

    def read(path: Path) -> list[Any]:
        return [item.mask() for item in read_coco(path).objects]

    return Sample(path, (path,), read, text=True)


SAMPLES: dict[str, Callable[[Path], Sample]] = {
    **{kind: partial(stream, kind=kind) for kind in (
        "aedat2", "aedat3", "dat", "evt2", "evt2.1", "evt3")},
    **{kind: partial(table, kind=kind) for kind in tables.WRITERS},
    **FORMATS,
    "dsec": dsec, "npz": npz, "ijrr": ijrr, "ijrr-zip": ijrr_zip, "e2vid-text": e2vid_text,
    "images-png": partial(images, suffix="png"), "images-jpg": partial(images, suffix="jpg"),
    "images-tif": partial(images, suffix="tif"), "images-bmp": partial(images, suffix="bmp"),
    "images-pgm": partial(images, suffix="pgm"), "images-webp": partial(images, suffix="webp"),
    "times": times, "stack-npy": partial(stack, suffix="npy"),
    "stack-npz": partial(stack, suffix="npz"),
    "video-avi": partial(video, suffix="avi", fourcc="MJPG"),
    "video-mkv": partial(video, suffix="mkv", fourcc="MJPG"),
    "video-mp4": partial(video, suffix="mp4", fourcc="mp4v"),
    "camera": camera, "weights": weights, "coco": coco,
}
if importlib.util.find_spec("aedat") is not None:
    SAMPLES["aedat4"] = aedat4
    if (Path(os.environ.get("EVFLOW_DATA") or "/nowhere") / REAL_AEDAT4).is_file():
        SAMPLES["aedat4-lz4"] = aedat4_lz4
if importlib.util.find_spec("rosbags") is not None:
    SAMPLES["rosbag"] = partial(bag, encoding="", lz4=False)
    SAMPLES["rosbag-lz4"] = partial(bag, encoding="libcaer", lz4=True)
    SAMPLES["rosbag-evt3"] = partial(bag, encoding="evt3", lz4=False)
    SAMPLES["rosbag2"] = partial(bag2, storage="SQLITE3", encoding="", compression=None)
    SAMPLES["rosbag2-mcap"] = partial(bag2, storage="MCAP", encoding="libcaer_cmp",
                                      compression=None)
    SAMPLES["rosbag2-zstd"] = partial(bag2, storage="MCAP", encoding="evt3", compression="STORAGE")
SAMPLES |= {f"{kind}-partial": partial(forgiving, kind=kind)
            for kind in ("evt2", "evt3", "v2e-text", "e2vid", "ijrr", "v2e", "aedat4", "rosbag")
            if kind in SAMPLES}
SAMPLES |= {f"{kind}-{late}": partial(mended, kind=kind, late=late) for kind, late in (
    ("evt3", "drop"), ("evt2", "sort"), ("e2vid", "join"), ("rosbag", "drop")) if kind in SAMPLES}
