"""Sizes of iniVation's sensors by the names used in their files."""

from __future__ import annotations

from evflow.checks import Size

DVS128: Size = (128, 128)
CHIPS: dict[str, Size] = {
    "DAVIS240": (240, 180), "DAVIS346": (346, 260), "DAVIS640": (640, 480),
    "DAVIS208": (208, 192), "DAVIS128": DVS128, "DVS128": DVS128, "TMPDIFF128": DVS128,
    "DVS640": (640, 480),
}


def known_chip(name: str | None) -> str | None:
    """The key in `CHIPS` of the sensor of that name, e.g. "DAVIS240C" or "Davis346blue"; None if it
    is unknown."""
    return next((chip for chip in CHIPS if name and chip in name.upper()), None)


def chip_size(name: str | None) -> Size | None:
    """(width, height) of the sensor of that name; None if it is unknown."""
    chip = known_chip(name)
    return CHIPS[chip] if chip else None
