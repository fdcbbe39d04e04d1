"""Options of every training; commands add their own. Free of JAX, as commands are parsed before it
is imported."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal

Resume = Literal["auto", "never", "must"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Where a training runs, how long, and whether it goes on."""

    out: Path
    """Folder of the run."""
    seed: int = 0
    """Of data and first parameters."""
    max_seconds: float = math.inf
    """Stop after this long, with a checkpoint; the schedule still spans all steps."""
    resume: Resume = "auto"
    """Go on with the run in --out: if there is one (its configuration must be this one), never
    (there must be none), or always (there must be one)."""
    save_every: int = 200
    """Steps between checkpoints."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainOptions(RunOptions):
    """What a training run of the network is, and among which processes it runs."""

    preset: str = "default"
    """default: all parts; pixels: those that see pixels one by one, on many small scenes; paper:
    the paper's network and losses; literal: all as it printed them; debug: tiny, to see that it
    runs. Others: `PRESETS` of
    evflow.training.config."""
    steps: int | None = None
    """Number of steps (default: the preset's)."""
    scenes: int | None = None
    """Scenes per step, a multiple of the number of devices (default: the preset's)."""
    parts: tuple[str, ...] | None = None
    """Parts that learn, of: summary encoder flow spread (default: the preset's)."""
    start: str | None = None
    """Weights (a name or a file) whose parts of equal shape are the starting point."""
    coordinator: str | None = None
    """HOST:PORT of process 0, where several processes train without Slurm or Open MPI."""
    processes: int | None = None
    """How many they are."""
    process_id: int | None = None
    """Which of them this is, from 0."""
