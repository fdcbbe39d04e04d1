"""A text summary of an estimate."""

from __future__ import annotations

import dataclasses
import math

from evflow.estimation.result import CameraEstimate

LABELS = {
    "theta_on": "threshold ON", "theta_off": "threshold OFF", "eta_on": "noise ON (Hz/pixel)",
    "eta_off": "noise OFF (Hz/pixel)", "sigma_on": "mismatch ON", "sigma_off": "mismatch OFF",
}


def describe(found: CameraEstimate) -> str:
    """The summary as a table, then what to know before trusting it."""
    std = dataclasses.asdict(found.summary_std)
    lines = [f"{LABELS[name]:22} {float(value):7.3f} ± {float(std[name]):.3f}"
             for name, value in dataclasses.asdict(found.summary).items()]
    lines += measured(found)
    events = f"from {int(found.n_events.sum()):,} events"
    windows = "1 window" if found.windows == 1 else f"{found.windows} windows"
    lines.append(f"{events} in {windows}; {found.valid.mean():.0%} of the pixels have events of "
                 "their own" if found.windows else f"{events} of a static scene")
    lines += [f"note: {note}" for note in found.notes]
    return "\n".join(lines)


def measured(found: CameraEstimate) -> list[str]:
    """Of the circuit and the frames, a line for what was measured."""
    optics, sensor, std = found.optics, found.sensor, found.sensor_std
    rows = [("cutoff (Hz at 255 DN)", sensor.cutoff_hz, std.get("cutoff_hz", math.nan), 0),
            ("dead time (ms)", 1e3 * sensor.refractory_s,
             1e3 * std.get("refractory_s", math.nan), 2),
            ("light added (DN)", optics.offset_dn, optics.offset_dn_std, 1),
            ("events after frames (ms)", 1e3 * optics.delay_s, 1e3 * optics.delay_s_std, 2)]
    return [f"{name:24} {value:5.{digits}f} ± {std:.{digits}f}"
            for name, value, std, digits in rows if value and math.isfinite(std)]
