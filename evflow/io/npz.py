"""evflow's own .npz: t (int64 us), x, y, p, size = (width, height); frames and frame_times beside
them where there are any. `wh` is read as another name of `size`. Pickles are never loaded.

Members are checked against the bytes that the archive really holds before memory is taken.
"""

from __future__ import annotations

import contextlib
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.archives import DAMAGE, load_npz
from evflow.io.arrays import GrowingArray
from evflow.io.hints import Hints
from evflow.io.writer import EventWriter
from evflow.types import Events, Recording

NAME = "npz"
EXTENSIONS: tuple[str, ...] = (".npz",)


def sniff(path: Path, head: bytes) -> bool:
    if not head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except DAMAGE:
        return path.suffix.lower() in EXTENSIONS  # cut off: the extension decides


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (a column is missing), EV009 (damaged), and what `Events` raises."""
    arrays = load_npz(path)
    missing = [name for name in ("t", "x", "y", "p") if name not in arrays]
    if missing:
        raise EvflowDataError(
            "EV008", f"{path} holds {sorted(arrays)} but not {missing}.",
            "Expected the keys t, x, y, p, size, and optionally frames, frame_times.")
    stored = arrays.get("size", arrays.get("wh"))
    x, y = arrays["x"], arrays["y"]
    reach = (int(x.max()), int(y.max())) if x.dtype.kind in "iu" and x.size and y.size else None
    size = hints.sensor(None if stored is None else tuple(stored.ravel().tolist()), reach=reach)
    events = hints.events(
        x, y, hints.microseconds(arrays["t"], "us"), hints.on(arrays["p"]), size)
    if "frames" not in arrays:
        return hints.crop(Recording.of_events(events))
    if "frame_times" not in arrays:
        raise EvflowDataError("EV008", f"{path} holds frames but no frame_times.")
    times = hints.microseconds(arrays["frame_times"], "us")
    return hints.crop(Recording(events, arrays["frames"], times))


class NpzWriter(EventWriter):
    """The columns grow as .npy files in a folder beside the output, which goes with them; at the
    end they are compressed one after the other, and no array is ever in memory."""

    NAME = NAME

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        self._archive = stack.enter_context(zipfile.ZipFile(
            temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1))
        self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory(
            prefix=f".{self.path.name}.", dir=self.path.parent)))
        kinds = {"t": "i8", "x": "u2", "y": "u2", "p": "?"}
        self._columns = {name: self._column(name, kind, stack) for name, kind in kinds.items()}

    def _column(
        self, name: str, dtype: Any, stack: contextlib.ExitStack, item: tuple[int, ...] = ()
    ) -> GrowingArray:
        return stack.enter_context(GrowingArray(self._folder / f"{name}.npy", dtype, item))

    def _write(self, events: Events) -> None:
        for name in ("t", "x", "y", "p"):
            self._columns[name].append(getattr(events, name))

    def _write_frames(self, frames: np.ndarray, times: np.ndarray) -> None:
        if "frames" not in self._columns:
            for name, dtype, item in (("frames", frames.dtype, frames.shape[1:]),
                                      ("frame_times", "i8", ())):
                self._columns[name] = self._column(name, dtype, self._stack, item)
        self._columns["frames"].append(frames)
        self._columns["frame_times"].append(times)

    def _finish(self) -> None:
        for name, column in self._columns.items():
            column.close()
            self._archive.write(self._folder / f"{name}.npy", f"{name}.npy")
        with self._archive.open("size.npy", "w") as f:
            np.lib.format.write_array(f, np.array(self.size, np.int32))
