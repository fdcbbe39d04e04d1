"""Options of commands that write a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from evflow.errors import EvflowDataError

Format = Literal["auto", "dsec", "e2vid", "event_utils", "evreal", "npz", "aedat4"]


def named(format: Format) -> str | None:
    """The format as `evflow.io` takes it: None for what the extension stands for."""
    return None if format == "auto" else format


def need_absent(path: Path, overwrite: bool) -> None:
    """EV013 before long work, where its output exists already."""
    if path.exists() and not overwrite:
        raise EvflowDataError("EV013", f"{path} exists.", "Pass --overwrite.")
