"""`evflow info`: what a recording contains."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from evflow.commands.options import Reading, own_first
from evflow.errors import EvflowDataError
from evflow.notes import as_dicts

if TYPE_CHECKING:
    from evflow.types import Recording


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Info(Reading):
    """Show what a recording contains: events, frames, size, duration, usable windows.

    Example: evflow info flight.aedat4
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """File or folder in any known format."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        recording = self.read(self.recording)
        facts = _facts(recording)
        if self.json:
            print(json.dumps(facts, indent=2))
            return
        print(recording)
        for name, value in facts.items():
            lines = ([note["text"] for note in value] if name in ("notes", "skipped") else
                     [value])
            for line in lines:
                print(f"  {name:16} {'x'.join(map(str, line)) if name == 'size' else line}")


def _facts(recording: Recording) -> dict[str, Any]:
    from evflow.recordings.windows import condensed, plan_windows

    events, times = recording.events, recording.frame_times
    facts = {
        "events": len(events), "size": list(events.size), "duration_s": events.duration_us / 1e6,
        "first_us": int(events.t[0]) if len(events) else None,
        "last_us": int(events.t[-1]) if len(events) else None,
        "on_fraction": float(events.p.mean()) if len(events) else None,
        "frames": len(times),
        "first_frame_us": int(times[0]) if len(times) else None,
        "last_frame_us": int(times[-1]) if len(times) else None,
        "frame_dtype": str(recording.frames.dtype), "notes": as_dicts(recording.notes),
    }
    if len(times) > 1 and len(events):
        try:
            plan = plan_windows(recording)
        except EvflowDataError as error:  # as where frames and events do not overlap
            return facts | {"windows": 0, "skipped": [{"code": error.code, "text": str(error)}]}
        facts["windows"] = len(plan.pairs)
        facts["skipped"] = as_dicts(condensed(plan.skipped))
    return facts
