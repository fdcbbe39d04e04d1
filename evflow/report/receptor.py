"""Panel on the pixels' response: photoreceptor, additional light, delay."""

from __future__ import annotations

from evflow.camera.optics import LOSS_WORDS
from evflow.estimation.result import CameraEstimate
from evflow.report import figures, page
from evflow.report.page import Panel, figure, grid, number, paragraph, spread, table

TITLE = "Photoreceptor, additional light and delay"


def receptor_panel(found: CameraEstimate, held_out_shares: tuple[float, float] | None) -> Panel:
    """Share explained over the cutoff, what was measured, and its test on the other half.
    held_out_shares: shares of the second half explained with the first one's constants, for an
    ideal pixel and as measured; None if it was not tested."""
    receptor = found.receptor
    if receptor is None:
        return Panel("receptor", TITLE, paragraph(
            "Absent: not measured, or too little happens to measure it.", "note"))
    sensor, std, optics = found.sensor, found.sensor_std, found.optics
    where = "at 255 DN" if receptor.seen.by_light else "in any light"
    drawn = page.drawing(
        figures.explained(receptor.curve, receptor.explained[0], sensor.cutoff_hz, where),
        "share explained over the cutoff")
    fast = f"above {receptor.least_cutoff_hz:.0f}"
    rows = [[f"cutoff [Hz {where}]", spread(sensor.cutoff_hz, std["cutoff_hz"])
             if sensor.cutoff_hz else fast],
            ["light added [DN]", spread(optics.offset_dn, optics.offset_dn_std)],
            ["events after frames [ms]", spread(1e3 * optics.delay_s, 1e3 * optics.delay_s_std)],
            *([["frames' exposure [ms]", spread(1e3 * optics.exposure_s,
                                                1e3 * optics.exposure_s_std)]]
              if optics.exposure_s else []),
            [f"dead time [ms]{LOSS_WORDS[sensor.in_dead_time]}",
             spread(1e3 * sensor.refractory_s, 1e3 * std["refractory_s"])
             if sensor.refractory_s else "not seen"],
            *([f"{label} [Hz per pixel]", spread(value, std[name]) if value else "not separated"]
              for label, name, value in (("leak", "leak_hz", sensor.leak_hz),
                                         ("shot noise in the dark", "shot_hz", sensor.shot_hz)))]
    shares = [["pixels that were searched", *(number(v, 3) for v in receptor.explained)]]
    if held_out_shares is not None:
        shares.append(["second half, by the first", *(number(v, 3) for v in held_out_shares)])
    conclusion = ("The estimate assumes pixels with these constants." if receptor.needed else
                  "An ideal pixel is as probable: the estimate assumes one.")
    return Panel("receptor", TITLE, grid([
        figure(drawn, "Line: offset and delay as measured. Dashed: an ideal pixel and ideal "
               "frames. Red: the measured cutoff."),
        table(["", "measured"], rows)
        + table(["variance explained", "ideal pixel", "as measured"], shares)], 22)
        + paragraph("At each event a pixel stores the brightness it sees. Thresholds and events "
                    "explain a share of that brightness along the frames, which is larger the "
                    f"better the photoreceptor is described. {conclusion}", "note"))
