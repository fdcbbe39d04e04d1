"""metrics.jsonl and the progress bar of a training, one line a step.

Metrics come from the device one step late: `add` writes those of the step before, so that the
device already works on the next one while the host waits for them.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

from evflow.files.atomic import atomic_text
from evflow.files.json_text import parse_json
from evflow.files.limits import read_whole
from evflow.files.regular import is_there
from evflow.process import devices
from evflow.process.terminal import bar

RECENT = 100  # steps whose mean metrics are a run's figures
Metrics = dict[str, float]
Headline = Callable[[Metrics], str]


class Log:
    """metrics.jsonl and the bar; only the main process has them. A context manager.

    path: of metrics.jsonl. Lines up to `step`, from which the run continues, count among the recent
    ones; those beyond are dropped, so that no step is logged twice. headline: text of the bar;
    "compiling" before the first step.
    """

    def __init__(self, path: Path, steps: int, step: int, headline: Headline) -> None:
        self._main, self._steps, self._headline = devices.is_main(), steps, headline
        self._recent: list[Metrics] = []
        self._waiting: tuple[int, dict[str, jax.Array]] | None = None
        self._open = contextlib.ExitStack()
        self._progress = self._open.enter_context(bar("compiling", shown=self._main))
        self._progress(step, steps)
        if self._main:
            kept = list(lines_until(path, step))
            self._recent = [_metrics(line) for line in kept[-RECENT:]]
            atomic_text(path, "".join(f"{line}\n" for line in kept), overwrite=True)
            # By lines: a step is logged before its checkpoint is written.
            self._file = self._open.enter_context(path.open("a", buffering=1))
        self._started = time.monotonic()

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    @property
    def seconds(self) -> float:
        """Since the run (or its last resumption) started."""
        return time.monotonic() - self._started

    def add(self, step: int, metrics: dict[str, jax.Array]) -> str:
        """Keep one step's metrics, still being computed, and write those of the step before;
        returns a message naming non-finite ones among these, else ""."""
        lost = self.flush()
        self._waiting = step, metrics
        return lost

    def flush(self) -> str:
        """Wait for the kept metrics, if any, and write them; returns as `add`."""
        if self._waiting is None:
            return ""
        (step, metrics), self._waiting = self._waiting, None
        values = {k: float(v) for k, v in jax.device_get(metrics).items()}
        self._recent = [*self._recent[1 - RECENT:], values]
        if self._main:
            self._file.write(json.dumps({"step": step, "time": self.seconds, **values}) + "\n")
        self._progress(step, self._steps, self._headline(self.figures))
        lost = ", ".join(f"{k} = {v}" for k, v in values.items() if not math.isfinite(v))
        return lost and f"{lost} after step {step}"

    @property
    def figures(self) -> Metrics:
        """Mean metrics of the recent steps."""
        names = self._recent[-1] if self._recent else {}
        alike = [r for r in self._recent if r.keys() == names.keys()]
        return {k: sum(r[k] for r in alike) / len(alike) for k in names}


def _metrics(line: str) -> Metrics:
    """Of a line of the log."""
    return {k: v for k, v in parse_json(line).items() if k not in ("step", "time")}


def lines_until(path: Path, step: int) -> Iterator[str]:
    """The lines of a log up to `step`; none without a log. A line cut short by a crash is always
    beyond the last checkpoint."""
    for line in read_whole(path).decode(errors="replace").splitlines() if is_there(path) else ():
        with contextlib.suppress(ValueError, KeyError, TypeError):
            if parse_json(line)["step"] <= step:
                yield line
