"""`evflow render`: a film or picture of events."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from evflow.commands.options import (
    Reading,
    check_finite,
    note_idle,
    own_first,
    print_notes,
    refuse,
    value,
)
from evflow.commands.writing import need_absent
from evflow.notes import as_dicts

LONG_S = 10.0  # without an event


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Render(Reading):
    """Show events: a film (.mp4, .gif), or a sheet for one instant (.png). Red: ON. Blue: OFF.

    Example: evflow render flight.aedat4 -o flight.mp4 --slow 10
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """File or folder in any known format."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """.mp4, .gif, or .png."""
    fps: float = 30.0
    """Pictures per second of the film (.mp4, .gif)."""
    window_ms: float = 33.0
    """Time over which a picture collects events."""
    window_events: Annotated[int | None, value("N")] = None
    """Instead: number of events per picture; a film shows consecutive pictures, --fps times a
    second."""
    slow: float = 1.0
    """How many times slower than life (.mp4, .gif)."""
    over_frames: bool = False
    """Draw the events over the frames nearest in time (a .png also shows both separately)."""
    at: Annotated[float | None, value("SECONDS")] = None
    """Time of the .png, seconds from the first event; by default the busiest."""
    scale: Annotated[int | None, value("N")] = None
    """Screen pixels per pixel; by default the film is about 640 wide."""
    caption: bool = True
    """Print time, duration and colours in a line below."""
    codec: Literal["mpeg4", "vp9"] = "mpeg4"
    """For .mp4: mpeg4 plays in video players; vp9 also in browsers, and takes some 50 times
    longer."""
    overwrite: bool = False
    """Replace the output if it exists."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        from evflow.process.terminal import bar
        from evflow.report.movie import Film, write_film, write_sheet

        check_finite(self)
        film = Film(fps=self.fps, window_us=round(1000 * self.window_ms), slow=self.slow,
                    over_frames=self.over_frames, scale=self.scale, codec=self.codec,
                    window_events=self.window_events, caption=self.caption)
        if self.window_events is not None:
            refuse(self, ("window_ms", "slow"), "--window-events defines the pictures")
        film.check_target(self.out, overwrite=self.overwrite)
        need_absent(self.out, self.overwrite, self.recording, self.frames,
                    self.timestamps)
        kind = self.out.suffix.lower()
        refuse(self, {".png": ("fps", "slow", "codec"), ".gif": ("at", "codec"),
                      ".mp4": ("at",)}[kind], f"does not apply to a {kind}")
        seen = self.over_frames or kind == ".png"
        if not seen:
            note_idle(self, "the film shows no frames without --over-frames")
        recording = print_notes(self.read(self.recording, with_frames=seen))
        if kind != ".png" and self.window_events is None:
            _note_pause(recording.events.t)
        if kind == ".png":
            described = write_sheet(self.out, recording, film, at_s=self.at,
                                    overwrite=self.overwrite)
        else:
            with bar("rendering") as progress:
                described = write_film(self.out, recording, film, overwrite=self.overwrite,
                                       progress=progress)
        if self.json:
            print(json.dumps({"out": str(self.out), "said": described,
                              "notes": as_dicts(recording.notes)}))
        else:
            print(f"{described} -> {self.out}", file=sys.stderr)


def _note_pause(t: np.ndarray) -> None:
    """Say on stderr if most of the film, of events at t (N,) us, would show none."""
    from evflow.recordings.gaps import event_gaps

    for at in event_gaps(t):
        pause, begin = 1e-6 * float(t[at + 1] - t[at]), 1e-6 * float(t[at] - t[0])
        if pause > max(0.5e-6 * float(t[-1] - t[0]), LONG_S):
            print(f"note: there are no events for {pause:,.0f} s after {begin:.3f} s. A clock that "
                  f"jumped? --stop {math.ceil(1e3 * begin) / 1e3:.3f} leaves out what comes later; "
                  "evflow check says more.", file=sys.stderr)
