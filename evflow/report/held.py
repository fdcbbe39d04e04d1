"""Panel: an estimate from the first part of a recording, tested on the second."""

from __future__ import annotations

from evflow.estimation.result import CameraEstimate
from evflow.report.page import Panel, number, paragraph, plural, spread, table
from evflow.report.resimulate import Trial
from evflow.report.streams import Names, ceiling_row

NAMES: Names = ("recorded", "re-simulated")


def held_panel(
    found: CameraEstimate, half: CameraEstimate | None, held: Trial | None, why_not: str
) -> Panel:
    """half: the estimate from the first part; held: its test on the second; if they are None,
    why_not gives the reason."""
    title = "Held out: estimated on the first half, tested on the second"
    if half is None or held is None:
        return Panel("held-out", title, paragraph(f"Absent: {why_not}", "note"))
    rates, r = held.numbers["rate_hz"], held.numbers["counts"]["r"]
    rows = [[f"events / pixel / s, {p.upper()}", number(rates["real"][p]),
             number(rates["synthetic"][p]), number(rates["ratio"][p])] for p in ("on", "off")]
    estimates = [[label, *(
        spread(float(getattr(f.summary, n)), float(getattr(f.summary_std, n)))
        for f in (half, found))]
                 for n, label in (("theta_on", "θ ON"), ("theta_off", "θ OFF"),
                                  ("eta_on", "η ON [Hz]"), ("eta_off", "η OFF [Hz]"))]
    counts = [["r, recorded against re-simulated", *(number(r[k], 3)
                                                     for k in ("on", "off", "both"))],
              ceiling_row(held.ceiling)]
    return Panel("held-out", title, paragraph(
        "The longest stretch without a gap is divided near its middle. The camera was estimated "
        f"from {plural(half.windows, 'window')} of its first part only; of the second, "
        f"{held.numbers['duration_s']:.3f} s are simulated.")
        + table(["second half", *NAMES, "ratio"], rows)
        + table(["events per pixel", "ON", "OFF", "both"], counts)
        + table(["estimate", "first half", "all"], estimates))
