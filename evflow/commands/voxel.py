"""`evflow voxel`: voxel grids of a recording's windows."""

from __future__ import annotations

import dataclasses
import json
import sys
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from evflow.commands.options import Reading, check_finite, own_first
from evflow.commands.writing import need_absent, need_suffix
from evflow.errors import EvflowDataError
from evflow.notes import Note, as_dicts

if TYPE_CHECKING:
    from evflow.types import Recording


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Voxel(Reading):
    """Write voxel grids (Eq. 2) of a recording's windows, for a network or a notebook.

    The .npz holds voxels (N, H, W, 2 * bins) float32 [ON bins..., OFF bins...], t0_us and
    window_us (N,) int64, and dlogI (N, H, W) float32, the change of log intensity from the
    window's first frame to its last. Windows run from frame to frame as in evflow estimate; a
    recording without frames is cut into windows of --window-ms, without dlogI.

    Example: evflow voxel flight.aedat4 -o voxels.npz --stop 10
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """File or folder in any known format."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Output, .npz (compressed; one grid is in memory at a time)."""
    bins: int = 16
    """Bins per polarity."""
    window_ms: float = 40.0
    """Minimum length of a window; without frames, the length of every window."""
    overwrite: bool = False
    """Replace the output if it exists."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        from evflow.files.atomic import atomic_write
        from evflow.files.whole import need_members
        from evflow.process.terminal import bar
        from evflow.voxel import voxelize

        check_finite(self)
        if self.bins < 2 or not self.window_ms >= 0.001:
            raise EvflowDataError("EV020", f"--bins {self.bins}, --window-ms {self.window_ms:g}.",
                                  "Need at least two bins and 0.001 ms.")
        need_suffix(self.out, ".npz")
        need_absent(self.out, self.overwrite, self.recording, self.frames,
                    self.timestamps)
        recording = self.read(self.recording)
        pairs, starts, lengths, notes = _windows(recording, round(self.window_ms * 1000))
        width, height = recording.events.size
        shape = (len(starts), height, width, 2 * self.bins)

        def grids() -> Iterator[np.ndarray]:
            for i, (t0, length) in enumerate(zip(starts, lengths, strict=True)):
                yield voxelize(recording.events, int(t0), int(length), self.bins)
                progress(i + 1, len(starts))

        with (bar("voxels") as progress,
              atomic_write(self.out, overwrite=self.overwrite) as temporary):
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
                _store(archive, "voxels", shape, np.float32, grids())
                _store(archive, "t0_us", starts.shape, np.int64, [starts])
                _store(archive, "window_us", lengths.shape, np.int64, [lengths])
                if len(pairs):
                    _store(archive, "dlogI", shape[:3], np.float32, _changes(recording, pairs))
                members = archive.namelist()
            need_members(temporary, dict.fromkeys(members))
        notes = (*recording.notes, *notes)
        for note in notes:
            print(f"note: {note}", file=sys.stderr)
        gigabytes = 4e-9 * np.prod(shape, dtype=float)
        facts = {"out": str(self.out), "windows": len(starts), "size": [width, height],
                 "bins": self.bins, "gigabytes": gigabytes, "notes": as_dicts(notes)}
        print(json.dumps(facts) if self.json else
              f"{len(starts)} windows, {width}x{height}, {self.bins} bins "
              f"({gigabytes:.3g} GB in memory) -> {self.out}")


def _windows(
    recording: Recording, window_us: int
) -> tuple[tuple[tuple[int, int], ...], np.ndarray, np.ndarray, tuple[Note, ...]]:
    """The frames that bound each window, window starts and lengths (N,) int64 us, and notes.

    Raises EV001, EV011, EV012 as `plan_windows`, EV017 if no window is left, EV026 for more
    than 10 million windows of equal length.
    """
    from evflow.recordings.windows import condensed, need_few_windows, plan_windows

    t = recording.events.t
    if len(recording.frames) > 1:
        plan = plan_windows(recording, window_us)
        ends = recording.frame_times[np.array(plan.pairs, int).reshape(-1, 2)]
        pairs, starts, lengths = plan.pairs, ends[:, 0], ends[:, 1] - ends[:, 0]
        notes = condensed(plan.skipped)
    else:
        if not len(t):
            raise EvflowDataError("EV001", "the recording has no events.")
        need_few_windows(t, window_us)
        starts = np.arange(t[0], t[-1] + 2 - window_us, window_us)
        pairs, lengths = (), np.full(len(starts), window_us)
        notes = (Note("frames.none", f"{'one frame' if recording.has_frames else 'no frames'}: "
                      "windows of equal length, without dlogI."),)
    if not len(starts):
        why = ("; ".join(map(str, notes[:3])) or "the frames span less than that"
               if recording.has_frames else f"the events span {(t[-1] - t[0]) / 1e3:g} ms")
        raise EvflowDataError(
            "EV017", f"no window of {window_us / 1e3:g} ms can be used ({why}).",
            "Record longer, or lower --window-ms.")
    return pairs, starts, lengths, notes


def _changes(recording: Recording, pairs: tuple[tuple[int, int], ...]) -> Iterator[np.ndarray]:
    from evflow.light.log_maps import to_log

    for first, last in pairs:
        before, after = (to_log(recording.frame_dn(i)) for i in (first, last))
        yield np.asarray(after - before)


def _store(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], dtype: Any,
    parts: Iterable[np.ndarray],
) -> None:
    """A member of an .npz, written in parts."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as f:
        np.lib.format.write_array_header_1_0(f, {
            "descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False,
            "shape": shape})
        for part in parts:
            f.write(np.ascontiguousarray(part, dtype).data)
