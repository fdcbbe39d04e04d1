"""The panel on how much of a recording was read, and whether its camera stayed the same."""

from __future__ import annotations

from evflow.estimation.drift import changed
from evflow.estimation.result import CameraEstimate
from evflow.notes import texts
from evflow.report.page import Panel, paragraph, plural, spread, table


def extent_panel(found: CameraEstimate) -> Panel:
    """What was read, and a comparison of its thirds."""
    return Panel("extent", "What was read, and did the camera stay the same",
                 paragraph(_read(found)) + _thirds(found))


def _read(found: CameraEstimate) -> str:
    extent = found.extent
    if not extent.of:
        return f"{plural(found.windows, 'window')}." if found.windows else "The whole recording."
    if extent.whole:
        return f"All of it, {extent.seconds:.1f} s in {plural(extent.of, 'part')}."
    return " ".join(texts(extent.notes()))


def _thirds(found: CameraEstimate) -> str:
    if not found.thirds:
        return paragraph("Too few stretches were read to compare the thirds of the recording, "
                         "which takes three in each.", "note")
    zero = found.thirds[0].begin_us
    rows = [[f"{(t.begin_us - zero) / 1e6:.1f} to {(t.end_us - zero) / 1e6:.1f} s",
             str(t.stretches), spread(t.theta_on, t.std_on), spread(t.theta_off, t.std_off)]
            for t in found.thirds]
    names = [name.upper() for name in changed(found.thirds)]
    verdict = (f"θ {' and θ '.join(names)} changed by more than the errors allow." if names else
               "They agree within their errors.")
    return table(["third", "stretches", "θ ON", "θ OFF"], rows) + paragraph(
        f"{verdict} Thresholds are from the pooled regression and differ slightly from the "
        "estimate's own; their errors are from the scatter of the stretches.")
