"""Real recordings with frames that a script takes where none is named."""

from __future__ import annotations

import os
from pathlib import Path

HELD = ("ijrr_slider_depth", "newton_cradle_davis346.aedat4")


def held_recordings() -> list[Path]:
    """Those of HELD that lie under $EVFLOW_DATA/data/recordings."""
    folder = Path(os.environ.get("EVFLOW_DATA") or "absent") / "data/recordings"
    return [folder / name for name in HELD if (folder / name).exists()]
