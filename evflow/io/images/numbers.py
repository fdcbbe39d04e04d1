"""The running number in the names of images: their order, gaps in it, and whether it is a time."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from evflow.io.decode.units import S_US, UNITS_US, usual_step, video_unit
from evflow.io.images.frames import FrameHints
from evflow.notes import Note

TIME_STEP = 1000  # numbers of images seldom skip so many, times in us or ns do
GAP = 1.5  # usual steps: times vary a little
KEEP = "a text file with these numbers, one a line, for --timestamps keeps them"


def natural(name: str) -> tuple[list[str | int], str]:
    """A sort key that compares digits in names as numbers."""
    parts = re.split(r"([0-9]+)", name.lower())
    return [int(p) if i % 2 else p for i, p in enumerate(parts)], name


def running(files: list[Path]) -> np.ndarray:
    """The number that alone differs between the files' names, (T,) int64 (exact, also for ns since
    1970); empty if there is no such number."""
    parts = [natural(file.name)[0] for file in files]
    alike = len({len(part) for part in parts}) == 1
    varying = [i for i, same in enumerate(zip(*parts, strict=False)) if len(set(same)) > 1]
    if not alike or len(varying) != 1 or not (at := varying[0]) % 2:
        return np.zeros(0, np.int64)
    numbers = [int(part[at]) for part in parts]
    return np.array(numbers if numbers[-1] < 2**63 else [], np.int64)


def unit_of(numbers: np.ndarray) -> str:
    """The unit in which running numbers are times of a video, "" if they are none."""
    if len(numbers) < 2 or usual_step(numbers - numbers[0]) < TIME_STEP:
        return ""
    return video_unit(numbers)[0] or ""


def gaps(files: list[Path], hints: FrameHints) -> tuple[Note, ...]:
    """A note if numbers in the names are missing, or are times that are not those of --fps."""
    numbers = running(files)
    if unit := unit_of(numbers):
        named = (numbers - numbers[0]) * UNITS_US[unit]
        taken = np.array([hints.at_rate(i) for i in range(len(files))])
        away, step = np.abs(named - taken), usual_step(named)
        if away.max() <= step / 2:
            return ()
        return (Note("frames.gaps", f"image names look like times in {unit}, "
                     f"{S_US / step:.4g} frames/s; those of --fps {hints.fps:g} are up to "
                     f"{1e-3 * away.max():.3g} ms away, first by half a frame at "
                     f"{files[int(np.argmax(away > step / 2))].name}: {KEEP}."),)
    steps = np.diff(numbers)
    jumps = np.flatnonzero(steps > GAP * np.median(steps)) if len(steps) else steps
    if not len(jumps):
        return ()
    many = f", and in {len(jumps) - 1} more places" if len(jumps) > 1 else ""
    return (Note("frames.gaps", f"image numbers jump from {files[jumps[0]].name} to "
                 f"{files[jumps[0] + 1].name}{many}: are images missing? They are assumed to be "
                 "evenly spaced; --timestamps keeps gaps in time."),)
