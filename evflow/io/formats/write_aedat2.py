"""AEDAT 2 as jAER reads it, for the chips that it knows (see `aedat2` for the layout)."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.files.whole import need_size
from evflow.io.decode.chips import DVS128
from evflow.io.formats.aedat2 import MAGIC, NAME, RECORD
from evflow.io.writer import EventWriter
from evflow.types import Events

CHIPS: dict[Size, str] = {  # jAER's classes, by the sensor's size
    (346, 260): "eu.seebetter.ini.chips.davis.Davis346blue",
    (240, 180): "eu.seebetter.ini.chips.davis.DAVIS240C",
    (640, 480): "eu.seebetter.ini.chips.davis.Davis640",
    DVS128: "ch.unizh.ini.jaer.chip.retina.DVS128"}


class Aedat2Writer(EventWriter):
    """Events only; times of 31 bits, as jAER's are signed."""

    NAME = NAME
    DEPTHS = ()
    TIMES_US = (0, 2**31 - 1)
    BEYOND = ("That is 36 minutes from 0, however short the recording. Write aedat4, dsec or npz, "
              "which keep such times, or in Python times from 0: t - t[0].")

    def __init__(self, path: str | os.PathLike, size: Size, **options: Any) -> None:
        super().__init__(path, size, **options)
        if self.size not in CHIPS:
            sizes = ", ".join(f"{width}x{height}" for width, height in CHIPS)
            raise EvflowDataError(
                "EV003", f"jAER has no chip of {size[0]}x{size[1]} pixels; aedat2 is for "
                f"{sizes}.", "Write aedat4, which takes any size; or simulate with --sensor-size "
                "davis346.")

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        lines = (MAGIC, b"# This is a raw AE data file - do not edit",
                 b"# Data format is int32 address, int32 timestamp (8 bytes total), repeated for "
                 b"each event", b"# Timestamps tick is 1 us",
                 b"# AEChip: " + CHIPS[self.size].encode(), b"#End Of ASCII Header")
        self._file = stack.enter_context(open(temporary, "wb"))  # noqa: SIM115
        self._bytes = self._file.write(b"".join(line + b"\r\n" for line in lines))

    def _write(self, events: Events) -> None:
        width, height = self.size
        x = (width - 1 - events.x.astype(np.int64)).astype(np.uint32)  # from the right
        y = (height - 1 - events.y.astype(np.int64)).astype(np.uint32)  # from the bottom
        on = events.p.astype(np.uint32)
        table = np.empty(len(events), RECORD)
        table["address"] = ((y << 8) | (x << 1) | (1 - on) if self.size == DVS128 else
                            (y << 22) | (x << 12) | (on << 11))
        table["t"] = events.t
        self._bytes += self._file.write(table.tobytes())

    def _verify(self, temporary: Path) -> None:
        need_size(temporary, self._bytes)
