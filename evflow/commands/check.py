"""`evflow check`: find common faults of recordings."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from evflow.commands.options import Reading, own_first, print_notes
from evflow.errors import EvflowDataError


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Check(Reading):
    """Check a recording: polarity, units, order, alignment, gaps, frames. Exit code 1 on errors.

    Example: evflow check flight.aedat4
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """File or folder in any known format."""
    json: bool = False
    """Print JSON."""
    strict: bool = False
    """Treat warnings as errors."""

    def run(self) -> None:
        from evflow.recordings.check import Finding, Report, check

        try:
            recording = self.read(self.recording)
        except EvflowDataError as error:
            if error.code == "EV020":  # of the command line, not of the recording
                raise
            report, what = Report((Finding.of(error),)), str(self.recording)
        else:
            report, what = check(recording), repr(recording)
            print_notes(recording, beside=report)
        report = report.strict() if self.strict else report
        print(report.to_json() if self.json else f"{what}\n{report}")
        if report.errors:
            sys.exit(1)
