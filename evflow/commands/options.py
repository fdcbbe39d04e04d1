"""Options that several commands share, and how results are written."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from evflow.errors import EvflowDataError

if TYPE_CHECKING:
    from evflow.types import Recording


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """How a recording is read; what a command that reads one inherits."""

    start: float | None = None
    """Use the recording from here (seconds from its first event)."""
    stop: float | None = None
    """... to here."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the event times; auto takes the format's own."""
    polarity: Literal["auto", "01", "pm1", "invert"] = "auto"
    """What the file's polarities are; invert swaps ON and OFF."""
    size: str | None = None
    """Sensor size WxH (346x260), where the file does not tell it or is wrong."""

    def read(self, path: Path) -> Recording:
        """The recording at `path`, these options obeyed."""
        from evflow import io

        return io.read_recording(
            path, start_s=self.start, stop_s=self.stop, time_unit=self.time_unit,
            polarity=self.polarity, size=parse_size(self.size))


def parse_size(text: str | None) -> tuple[int, int] | None:
    """(width, height) of "346x260"; EV020 on anything else."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise EvflowDataError("EV020", f"size {text!r}.", "Give it as WxH: --size 346x260.")
    return int(width), int(height)


def write_json(path: Path, facts: dict[str, Any]) -> None:
    """`facts` as an indented JSON file, replaced whole or not at all."""
    from evflow.files import atomic_write

    with atomic_write(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(facts, indent=2) + "\n")
