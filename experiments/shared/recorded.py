"""Real recordings prepared for evaluating event networks: the scored part of a sequence, the events
of each frame, and equalisation of histograms.

The clock of a sequence starts at its first event or frame, whichever is earlier (EVREAL). An image
is made at every frame's time, from the events since the frame before; networks with a memory run
`warmup_s` before what counts. EVREAL also leaves out frames farther than 1 ms from their events'
window; here a window ends at its frame.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import cv2
import numpy as np
from skimage.exposure import equalize_hist
from skimage.filters.rank import equalize
from skimage.morphology import disk

from evflow import Recording, read_recording
from evflow.errors import EvflowDataError
from evflow.types import Events

# Seconds from the start of the clock, as in EVREAL's and S2R's evaluations; other sequences (HQF,
# EVIMO2v2, the user's) are scored whole.
CUTS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("boxes_6dof", "calibration", "dynamic_6dof", "poster_6dof", "shapes_6dof"),
                    (5.0, 20.0)),
    "office_zigzag": (5.0, 12.0), "slider_depth": (1.0, 2.5),
    **dict.fromkeys(("indoor_flying1", "indoor_flying2", "indoor_flying3"), (10.0, 70.0)),
    "indoor_flying4": (10.0, 19.8), "outdoor_day1": (0.0, 60.0), "outdoor_day2": (100.0, 160.0)}
ENDINGS = ("_data", "_cut", "_events")  # of file names, after the sequence's own
GENERAL = ("events", "data", "recording")  # names of files in a folder that has the sequence's
HISTEQ = ("none", "global", "local", "clahe")
LOCAL_PX = 55  # radius of the disk of E2VID's local equalisation
CLAHE = (2.0, (8, 8))  # clip limit, tiles
ROBUST = (1.0, 99.0)  # percentiles that become 0 and 1


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """The part of a sequence to run. edges_us (T + 1,): image i is made at edges_us[i + 1] from the
    events since edges_us[i]; the first `warmup` images are not scored; frames (T, H, W) on
    [0, 1], or None."""

    name: str
    events: Events
    edges_us: np.ndarray
    frames: np.ndarray | None
    warmup: int


def sequence_name(path: Path) -> str:
    """`indoor_flying1` of indoor_flying1_data.hdf5, and of indoor_flying1/events.h5."""
    name = _stem(path)
    for ending in ENDINGS:
        name = name.removesuffix(ending)
    return name


def cut_of(path: Path) -> tuple[float, float]:
    """Seconds (start, stop) of a sequence that are scored; all of it if its file is called cut."""
    whole = (0.0, np.inf)
    return whole if _stem(path).endswith("_cut") else CUTS.get(sequence_name(path).lower(), whole)


def _stem(path: Path) -> str:
    path = Path(os.path.abspath(path))  # "." has no name; a link keeps its own
    name = path.name.split(".")[0]
    return path.parent.name.split(".")[0] if name in GENERAL else name


def read_part(
    path: Path, warmup_s: float, window_ms: float, cut: bool = True,
    size: tuple[int, int] | None = None,
) -> Part:
    """The scored part of a sequence, and its warm-up. window_ms: of recordings without frames;
    size: (width, height) of the sensor, if the file does not contain it. Raises as
    `read_recording`, and EV012 where the cut is empty."""
    start, stop = cut_of(path) if cut else (0.0, np.inf)
    recording = read_recording(path, size=size)
    return part_of(recording, sequence_name(path), start, stop, warmup_s, window_ms)


def part_of(
    recording: Recording, name: str, start_s: float, stop_s: float, warmup_s: float,
    window_ms: float,
) -> Part:
    """The part of a recording between two instants of its clock."""
    events, times = recording.events, recording.frame_times
    firsts = [int(t[0]) for t in (events.t, times) if len(t)]
    if not len(events):
        raise EvflowDataError("EV001", f"{name} has no events.")
    zero, last = min(firsts), int(events.t[-1])
    begin = zero + round(1e6 * start_s)
    end = last + 1 if np.isinf(stop_s) else min(last + 1, zero + round(1e6 * stop_s))
    warm = max(begin - round(1e6 * warmup_s), int(events.t[0]))
    if recording.has_frames:
        first, after = np.searchsorted(times, (warm, end))
        before = times[first - 1] if first else int(events.t[0]) - 1
        edges = np.append(before, times[first:after])
    else:
        edges = np.arange(warm, end + 1, round(1e3 * window_ms), dtype=np.int64)
    warmup = int(np.searchsorted(edges[1:], begin))
    if len(edges) - 1 <= warmup:
        what = "frame" if recording.has_frames else f"window of {window_ms:g} ms"
        raise EvflowDataError(
            "EV012", f"{name}: no {what} between {start_s} and {stop_s} s with events before it; "
            f"it lasts {1e-6 * (last - zero):.2f} s.", "Is it the sequence that its name says?")
    frames = None
    if recording.has_frames:
        kept = np.searchsorted(times, edges[1:])
        frames = np.stack([recording.frame_dn(int(i)) / np.float32(255) for i in kept])
    # An event at an edge belongs to the frame there; no frame is at a recording's first event.
    first_us = int(edges[0]) + recording.has_frames
    inside = events.slice(first_us, int(edges[-1]) + 1)
    return Part(name, inside, edges, frames, warmup)


def equalised(images: np.ndarray, how: str) -> np.ndarray:
    """Images (T, H, W) on [0, 1] with equalised histograms, as bytes are: "global", "local" (a
    disk of 55 px) or "clahe"; unchanged by "none". Raises EV020."""
    if how not in HISTEQ:
        raise EvflowDataError("EV020", f"histeq={how!r}.", f"Choose one of {HISTEQ}.")
    if how == "none":
        return images
    clahe, footprint = cv2.createCLAHE(*CLAHE), disk(LOCAL_PX)

    def one(image: np.ndarray) -> np.ndarray:
        if how == "global":
            return np.rint(255 * equalize_hist(image)).astype(np.uint8)
        return clahe.apply(image) if how == "clahe" else equalize(image, footprint)

    gray = np.rint(255 * np.clip(images, 0, 1)).astype(np.uint8)
    return np.stack([one(image) for image in gray]).astype(np.float32) / np.float32(255)


def stretched(images: np.ndarray) -> np.ndarray:
    """Images (T, H, W), each with its percentiles 1 and 99 at 0 and 1, as EVREAL shows E2VID."""
    low, high = np.percentile(images, ROBUST, axis=(1, 2), keepdims=True)
    return ((images - low) / np.maximum(high - low, 1e-6)).astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class Rotation:
    """A slice of a rotating camera. xy (N, 2): undistorted, between pixels; t (N,): 0 to 1 over
    the slice; p; flow (2, H, W): of its gyroscope, px over the slice, on the undistorted grid."""

    xy: np.ndarray
    t: np.ndarray
    p: np.ndarray
    flow: np.ndarray

    @property
    def events(self) -> Events:
        """At the nearest pixels of the undistorted grid, in us; those outside are left out."""
        height, width = self.flow.shape[-2:]
        x, y = np.rint(self.xy).astype(np.int64).T
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        t = np.rint(1e6 * self.t).astype(np.int64)
        return Events(x[inside], y[inside], t[inside], self.p[inside] > 0, (width, height))


def read_rotation(folder: Path) -> Rotation:
    """A folder of events.npz and extra.npz (calibration, flow)."""
    with np.load(folder / "events.npz") as e, np.load(folder / "extra.npz") as extra:
        fx, fy, cx, cy, *bent = extra["calib_fx_fy_cx_cy_k1_k2_p1_p2_k3"]
        flow = extra["flow_xy_px_per_slice"]
        t, p, xy = e["t"], e["p"], np.stack([e["x"], e["y"]], -1).astype(np.float32)
    k, distortion = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(bent)
    height, width = flow.shape[-2:]
    new, _ = cv2.getOptimalNewCameraMatrix(k, distortion, (width, height), 0)
    straight = np.asarray(cv2.undistortPoints(xy[:, None], k, distortion, P=new)[:, 0])
    time = ((t - t[0]) / (t[-1] - t[0])).astype(np.float32)
    return Rotation(straight, time, p.astype(np.float32), np.asarray(flow, np.float32))
