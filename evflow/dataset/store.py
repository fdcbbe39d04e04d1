"""Sequences as files. NumPy only: reading never imports JAX, so that PyTorch workers may fork.

"dsec": one HDF5 file, NAME.h5, with events, frames and frame_times in the layout of
`evflow.io.formats.dsec` (any reader of DSEC can read it), and flow, flow_visible, changes,
camera/*, nominal.
"npy": a folder NAME of flat arrays: events_x.npy, ..., frames.npy, flow.npy, camera_theta_on.npy.
Neither contains a time of day: equal sequences have equal bytes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evflow.checks import COLUMNS
from evflow.dataset.sequence import SPLITS, Arrays, EventSequence, truth_layout
from evflow.errors import EvflowDataError
from evflow.files.folders import atomic_folder
from evflow.files.whole import need_size
from evflow.io import DsecWriter, read_recording
from evflow.io.decode import tables
from evflow.io.decode.hdf5 import plausible
from evflow.types import Events, Recording

Format = Literal["dsec", "npy"]
SUFFIXES: dict[Format, str] = {"dsec": ".h5", "npy": ""}


def sequence_paths(folder: str | os.PathLike, split: str = "train") -> list[Path]:
    """The finished sequences of one split ("train", "test"), in order; EV016 if there are none. A
    set that is still being made has fewer."""
    if split not in SPLITS:
        raise EvflowDataError("EV020", f"split={split!r}.", f"Choose from {SPLITS}.")
    place = Path(folder) / split
    found = sorted(place.iterdir()) if place.is_dir() else []
    # A file without extension, as somebody's README, is none of them.
    paths = [p for p in found if not p.name.startswith(".")
             and (p.suffix == SUFFIXES["dsec"] or (p.suffix == SUFFIXES["npy"] and p.is_dir()))]
    if not paths:
        raise EvflowDataError("EV016", f"no sequences in {place}.", "Is this the set's folder?")
    return paths


def iter_sequences(folder: str | os.PathLike, split: str = "train") -> Iterator[EventSequence]:
    """Read the sequences of one split, in order.

    A PyTorch data set takes five lines:

    >>> class Flows(torch.utils.data.Dataset):
    ...     def __init__(self, folder): self.paths = sequence_paths(folder, "train")
    ...     def __len__(self): return len(self.paths)
    ...     def __getitem__(self, i):
    ...         s = read_sequence(self.paths[i])
    ...         return torch.from_numpy(s.changes), torch.from_numpy(s.flow)
    """
    for path in sequence_paths(folder, split):
        yield read_sequence(path)


def read_sequence(path: str | os.PathLike) -> EventSequence:
    """One sequence of either format, as plain NumPy arrays.

    Arrays of an .npy folder are memory-mapped, copy on write: unused ones are not read.
    Raises EV008 (another file), EV009 (damaged), EV010 (no h5py), EV016 (not found).
    """
    path = Path(path)
    if not path.exists():
        raise EvflowDataError("EV016", f"no sequence at {path}.",
                              "List them with evflow.dataset.sequence_paths(folder).")
    try:
        return _read_npy(path) if path.is_dir() else _read_dsec(path)
    except EvflowDataError as e:
        if str(path) in e.seen:
            raise
        raise EvflowDataError(e.code, f"{path}: {e.seen}", e.fix) from e


def write_sequence(path: str | os.PathLike, sequence: EventSequence, format: Format) -> None:
    """Write a sequence to `path` (an .h5 file, or a folder to be created), which must not exist; it
    appears when it is complete.
    Raises EV010 (no h5py), EV013 (exists), EV019 (cannot be written).
    """
    {"dsec": _write_dsec, "npy": _write_npy}[format](Path(path), sequence)


class _SequenceWriter(DsecWriter):
    """A DSEC file with the truth beside events and frames."""

    def append_truth(self, truth: Arrays) -> None:
        """A chunk is one frame's array, or a whole map."""
        for name, array in truth.items():
            values = array.astype(np.uint8) if array.dtype == bool else array
            rows = 1 if array.ndim > 2 else len(array)
            with self._guard():
                self._create(name, array.shape[1:], values.dtype, rows)
                self._extend(name, values)


def _write_dsec(path: Path, sequence: EventSequence) -> None:
    out = _SequenceWriter(path, sequence.events.size)
    with out:
        out.append(sequence.events)
        out.append_frames(sequence.frames, sequence.frame_times)
        out.append_truth(sequence.truth)


def _read_dsec(path: Path) -> EventSequence:
    recording = read_recording(path)
    if not recording.has_frames:
        raise EvflowDataError("EV008", f"{path} has no frames: no sequence of a data set.")
    layout = truth_layout(*recording.frames.shape)
    with tables.opened(path) as f:
        _need(path, layout, f.__contains__)
        stored = {name: plausible(path, f[name])[()] for name in layout}
    flags = stored["flow_visible"]
    return EventSequence.of(recording, stored | {"flow_visible": flags.astype(bool)})


def _write_npy(path: Path, sequence: EventSequence) -> None:
    events = {f"events/{name}": getattr(sequence.events, name) for name in COLUMNS}
    frames = {"frames": sequence.frames, "frame_times": sequence.frame_times}
    with atomic_folder(path, names=()) as folder:
        for name, array in (events | frames | sequence.truth).items():
            _save(_npy(folder, name), array)


def _save(path: Path, array: np.ndarray) -> None:
    """numpy.save, except that a full disk raises with its errno, which tofile loses."""
    npy, array = np.lib.format, np.asarray(array, order="C")
    with open(path, "wb") as file:
        npy.write_array_header_1_0(file, npy.header_data_from_array_1_0(array))
        size = file.tell() + array.nbytes
        file.write(array.data)
    need_size(path, size)


def _read_npy(path: Path) -> EventSequence:
    columns = [f"events/{name}" for name in COLUMNS]
    _need(path, [*columns, "frames", "frame_times"], lambda name: _npy(path, name).is_file())
    frames = _load(path, "frames")
    if frames.ndim != 3 or frames.dtype != np.uint8:
        raise EvflowDataError("EV009", f"{path}: frames are {frames.dtype} {frames.shape}.")
    layout = truth_layout(*frames.shape)
    _need(path, layout, lambda name: _npy(path, name).is_file())
    x, y, t, p = (_load(path, name) for name in columns)
    events = Events(x, y, t, p, (frames.shape[2], frames.shape[1]))
    recording = Recording(events, frames, _load(path, "frame_times"))
    return EventSequence.of(recording, {name: _load(path, name) for name in layout})


def _npy(folder: Path, name: str) -> Path:
    return folder / f"{name.replace('/', '_')}.npy"


def _load(folder: Path, name: str) -> np.ndarray:
    path = _npy(folder, name)
    try:
        array = np.load(path, mmap_mode="c", allow_pickle=False)
    except (ValueError, OSError, EOFError, TypeError) as e:
        raise EvflowDataError("EV009", f"{path} is damaged ({e}).", "Make it again.") from e
    return array.view(np.ndarray)


def _need(path: Path, names: Any, there: Callable[[str], bool]) -> None:
    missing = [name for name in names if not there(name)]
    if missing:
        raise EvflowDataError(
            "EV008", f"{path} lacks {missing}.", "Is it a sequence of a data set, and complete?")
