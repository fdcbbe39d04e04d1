"""A text summary of an estimate."""

from __future__ import annotations

import dataclasses
import math

from evflow.camera import Summary
from evflow.camera.optics import LOSS_WORDS
from evflow.estimation.bench.levels import Bench
from evflow.estimation.result import CameraEstimate
from evflow.report.page import number, plural, short, spread

LABELS = {
    "theta_on": "threshold ON", "theta_off": "threshold OFF", "eta_on": "noise ON (Hz/pixel)",
    "eta_off": "noise OFF (Hz/pixel)", "sigma_on": "mismatch ON", "sigma_off": "mismatch OFF",
}


def thresholds(summary: Summary, std: Summary) -> str:
    """The thresholds on one line, while a recording is read."""
    return ", ".join(f"θ {side.upper()} {float(getattr(summary, f'theta_{side}')):.3f} ± "
                     f"{float(getattr(std, f'theta_{side}')):.3f}" for side in ("on", "off"))


def describe(found: CameraEstimate) -> str:
    """The summary as a table, then what to know before trusting it."""
    names = [field.name for field in dataclasses.fields(found.summary)]
    lines = [_line(found, name, float(getattr(found.summary, name)),
                   float(getattr(found.summary_std, name))) for name in names]
    lines += [*measured(found), *(by_light(found.bench) if found.bench else ())]
    events = f"from {int(found.n_events.sum()):,} events"
    parts = plural(found.windows, "step" if found.bench else "window")
    lines.append(f"{events} in {parts}; {found.valid.mean():.0%} of the pixels have events of "
                 "their own" if found.windows else f"{events} of a static scene")
    lines += [f"note: {note}" for note in found.notes]
    return "\n".join(lines)


def by_light(bench: Bench) -> list[str]:
    """Noise at each illuminance, and latency by kind of step, a line each."""
    unit = {"DN": " DN", "lux": " lux", "light": ""}[bench.unit]
    levels = bench.levels if bench.unit == "lux" and len(bench.levels) > 1 else ()
    return [*(f"{f'noise at {short(level.light)}{unit}':22} "
              f"ON {spread(level.eta_on, level.eta_on_std)}, "
              f"OFF {spread(level.eta_off, level.eta_off_std)} Hz/pixel" for level in levels),
            *(f"{f'latency to {short(v.light)}{unit}':22} {100 * math.expm1(v.change):+.0f} %: "
              f"{_ms(v.seconds, v.std_s)} ms, jitter {1e3 * v.jitter_s:.3g} ms, "
              f"{v.responded:.0%} of the pixels" for v in bench.latency)]


def _ms(seconds: float, std: float | None) -> str:
    return number(1e3 * seconds) if std is None else spread(1e3 * seconds, 1e3 * std)


def _line(found: CameraEstimate, name: str, value: float, std: float) -> str:
    """One quantity of the summary; of a threshold also in percent of contrast."""
    kind, _, side = name.partition("_")
    if kind != "eta" and f"theta_{side}" in found.undetermined:
        return f"{LABELS[name]:22}   not measured"
    percent = 100 * math.exp(value)
    shown = f"   {spread(percent - 100, percent * std)} % of contrast" if kind == "theta" else ""
    return f"{LABELS[name]:22} {spread(value, std):>15}{shown}"


def measured(found: CameraEstimate) -> list[str]:
    """Of the circuit and the frames, a line for what was measured."""
    optics, sensor, std = found.optics, found.sensor, found.sensor_std
    where = "at 255 DN" if sensor.cutoff_by_light else "in any light"
    rows = [(f"cutoff (Hz {where})", sensor.cutoff_hz, std.get("cutoff_hz", math.nan)),
            (f"dead time (ms){LOSS_WORDS[sensor.in_dead_time]}", 1e3 * sensor.refractory_s,
             1e3 * std.get("refractory_s", math.nan)),
            ("leak (Hz/pixel)", sensor.leak_hz, std.get("leak_hz", math.nan)),
            ("shot noise (Hz, dark)", sensor.shot_hz, std.get("shot_hz", math.nan)),
            ("light added (DN)", optics.offset_dn, optics.offset_dn_std),
            ("events after frames (ms)", 1e3 * optics.delay_s, 1e3 * optics.delay_s_std),
            ("frames' exposure (ms)", 1e3 * optics.exposure_s, 1e3 * optics.exposure_s_std)]
    return [f"{name:22} {spread(value, std):>15}"
            for name, value, std in rows if value and math.isfinite(std)]
