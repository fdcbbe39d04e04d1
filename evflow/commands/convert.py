"""`evflow convert`: write a recording in another format."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated

import tyro

from evflow.commands.options import Reading, own_first
from evflow.commands.writing import Format, named, need_absent
from evflow.notes import Note, as_dicts


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Convert(Reading):
    """Write a recording, or a part of it, in another format.

    Example: evflow convert flight.aedat4 flight.h5

    Example: evflow convert flight.aedat4 flight.zip --start 1 --stop 3
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """File or folder in any known format."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output. Its extension selects the format: .h5 dsec, .zip or .txt e2vid, .npz npz, .aedat4
    aedat4, .aedat aedat2 (jAER), none (a folder) evreal."""
    format: Format = "auto"
    """Format of the output, if its extension leaves a choice (event_utils in .h5)."""
    overwrite: bool = False
    """Replace the output if it exists."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        from evflow import io
        from evflow.files.spool import on_disk
        from evflow.io.registry import writer_of
        from evflow.types import Recording

        writer = writer_of(self.out, named(self.format, self.out))
        need_absent(self.out, self.overwrite, self.recording, self.frames,
                    self.timestamps)
        with on_disk():
            recording = self.read(self.recording)
        notes = list(recording.notes)
        if recording.has_frames and (why := writer.refuses(recording.frames.dtype)):
            notes.append(Note(
                "frames.unused", f"{why}: the {len(recording.frames)} frames were left out; .h5 "
                "and .npz can hold them."))
            recording = Recording.of_events(recording.events)
        io.write_recording(self.out, recording, writer.NAME, overwrite=self.overwrite)
        for note in notes:
            print(f"note: {note}", file=sys.stderr)
        facts = {"out": str(self.out), "format": writer.NAME, "events": len(recording.events),
                 "frames": len(recording.frames), "notes": as_dicts(notes)}
        print(json.dumps(facts) if self.json else f"{recording} -> {self.out} ({writer.NAME})")
