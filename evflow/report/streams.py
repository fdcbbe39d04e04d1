"""Two event streams compared, as panels of a page, and as a page of their own (`evflow
compare`)."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from evflow.report import figures, page
from evflow.report.alike import ALIKE, RULE_STREAMS, how_compared, judge_streams
from evflow.report.page import Panel, bullets, figure, grid, number, paragraph, table
from evflow.report.plots import event_image, require
from evflow.report.resimulate import INSTANT_US, busiest_instant
from evflow.report.verdict import Judged, advice, worst
from evflow.types import Events

Names = tuple[str, str]


def rate_panel(numbers: dict[str, Any], names: Names, note: str = "") -> Panel:
    """Rates over time."""
    rates = numbers["rate_hz"]
    r = numbers["curve"]["r"]
    rows = [[key.upper(), *(number(rates[s][key]) for s in ("real", "synthetic")),
             number(rates["ratio"][key]), number(r[key], 2)] for key in ("on", "off")]
    rows.append(["ON per OFF", *(number(numbers["on_off"][s]) for s in ("real", "synthetic")),
                 "", ""])
    step = numbers["curve"]["step_us"] / 1e3
    drawn = [figure(page.drawing(figures.rates(numbers, key, names), f"{key.upper()} rate"))
             for key in ("on", "off")]
    return Panel("rates", "Event rate over time", note + grid(drawn, 22) + paragraph(
        f"Coloured: {names[0]}. Black, dashed: {names[1]}. Steps of {page.short(step)} ms.", "note")
        + table(["events / pixel / s", *names, "ratio", "r over time"], rows))


def image_panel(
    real: Events, made: Events, instant_us: int, t0_us: int, names: Names,
    frame: np.ndarray | None = None,
) -> Panel:
    """Events of one instant, and the frame at that time if there is one."""
    cells = []
    if frame is not None:
        white = max(1.0, float(np.percentile(frame, 99.5)))
        grey = np.repeat(page.blocks(frame)[0][..., None] / white, 3, -1)
        cells.append(figure(page.picture(grey, "frame"), f"White: {white:.0f} of 255", "Frame"))
    for events, name in zip((real, made), names, strict=True):
        inside = events.slice(instant_us, instant_us + INSTANT_US)
        image = page.blocks(event_image(inside, instant_us, instant_us + INSTANT_US))[0]
        on = int(inside.p.sum())
        cells.append(figure(page.picture(image, f"{name} events"),
                            f"{on:,} ON, {len(inside) - on:,} OFF", name.capitalize()))
    when = (instant_us - t0_us) / 1e6
    return Panel("images", "The same 30 ms", paragraph(
        f"Events from {when:.3f} to {when + INSTANT_US / 1e6:.3f} s of the compared stretch, its "
        "busiest instant. Red: ON (brighter). Blue: OFF (darker). Full colour: three events or "
        "more.") + grid(cells, 17))


def count_panel(
    real: Events, made: Events, numbers: dict[str, Any], names: Names,
    ceiling: dict[str, float | None] | None = None,
) -> Panel:
    """Events per pixel of one stream against the other."""
    r, active = numbers["counts"]["r"], numbers["active"]
    keys = ("on", "off", "both")
    rows = [[f"r, {names[0]} against {names[1]}", *(number(r[k], 3) for k in keys)]]
    if ceiling:
        rows.append(ceiling_row(ceiling))
    most = f" (two re-simulations: {number(ceiling['space_time_r'], 3)})" if ceiling else ""
    drawn = [figure(page.drawing(figures.counts(a, b, key, names), f"{key.upper()} per pixel"))
             for key, a, b in zip(("on", "off"), real.count_map(), made.count_map(), strict=True)]
    return Panel("counts", "Events per pixel", grid(drawn, 22) + paragraph(
        "Each pixel that fires in either stream is a point; colour: number of pixels, on a "
        "logarithmic scale. Dashed: equal.", "note")
        + table(["correlation over pixels", "ON", "OFF", "both"], rows)
        + paragraph(f"{active['real']:.1%} of the pixels fire in the {names[0]} stream, "
                    f"{active['synthetic']:.1%} in the {names[1]} one; of those that fire in "
                    f"either, {active['common'] or 0:.1%} fire in both. In space and time (ON "
                    "minus OFF events in cubes of 3×3 pixels and 2 ms): r = "
                    f"{number(numbers['space_time_r'], 3)}{most}.", "note"))


def ceiling_row(ceiling: dict[str, float | None]) -> list[str]:
    """Of a table of correlations: those of two re-simulations, of which one begins with unknown
    memories."""
    return ["r of two re-simulations, the ceiling", *(number(ceiling[k], 3)
                                                      for k in ("on", "off", "both"))]


def time_panel(numbers: dict[str, Any], names: Names) -> Panel:
    """Intervals between a pixel's events, and delays after its neighbours' events."""
    own, around = numbers["intervals"], numbers["neighbours"]
    same = numbers["same_polarity"]

    def ms(values: dict[str, float | None]) -> list[str]:
        return [number(None if (v := values[s]) is None else 1e3 * v)
                for s in ("real", "synthetic")]

    def share(values: dict[str, float | None]) -> list[str]:
        return ["–" if (v := values[s]) is None else f"{v:.1%}" for s in ("real", "synthetic")]

    rows = [["median interval of a pixel [ms]", *ms(own["median_s"]), number(own["ks"], 2),
             number(own["wasserstein_decades"], 2)],
            ["median delay after a neighbour [ms]", *ms(around["median_s"]),
             number(around["ks"], 2), number(around["wasserstein_decades"], 2)],
            ["events without a neighbour's within 5 ms", *share(around["alone"]), "", ""],
            ["events of the same polarity as the pixel's last", *share(same), "", ""]]
    drawn = [figure(page.drawing(figures.times(numbers[kind], names, label), label))
             for kind, label in (("intervals", "interval between events of a pixel"),
                                 ("neighbours", "delay after an event next to it"))]
    return Panel("intervals", "Intervals between events", grid(drawn, 22)
                 + table(["", *names, "KS", "decades apart"], rows)
                 + paragraph("KS: largest distance of the two cumulative distributions, 0 to 1. "
                             "Decades apart: Wasserstein distance in log10 time. Signal follows "
                             "its neighbours; noise comes alone.", "note"))


def write_comparison(
    path: str | os.PathLike, real: Events, synthetic: Events, numbers: dict[str, Any], *,
    labels: Names, facts: dict[str, str], overwrite: bool = False,
) -> None:
    """compare.html: the verdict and what it rests on. numbers: of `compare(real, synthetic)`;
    labels: what the streams are called in the title; facts: rows on the files.

    Raises EV010 (no matplotlib), EV013 (exists), EV019 (cannot be written).
    """
    require()
    names = ("real", "synthetic")
    t0, t1 = numbers["span_us"]
    moved = Events.unchecked(synthetic.x, synthetic.y, synthetic.t + numbers["shift_us"],
                             synthetic.p, synthetic.size)
    real, made = real.slice(t0, t1), moved.slice(t0, t1)
    panels = [
        _verdict(numbers), rate_panel(numbers, names),
        image_panel(real, made, busiest_instant(real, (t0, t1)), t0, names),
        count_panel(real, made, numbers, names), time_panel(numbers, names),
        Panel("facts", "What was compared", table(
            ["", ""], [[page.text(k), f"<code>{page.text(v)}</code>"] for k, v in facts.items()],
            numeric=False))]
    page.write_page(path, f"{labels[0]} and {labels[1]}", f"{len(real):,} real and {len(made):,} "
                    f"synthetic events, {real.size[0]}×{real.size[1]} pixels, "
                    f"{numbers['duration_s']:.3f} s", panels, numbers, overwrite=overwrite)


def _verdict(numbers: dict[str, Any]) -> Panel:
    judged = judge_streams(numbers)
    grade, todo = worst(judged), advice(judged)
    body = (f'<div class="verdict {grade}"><strong class="grade">{ALIKE[grade]}</strong>'
            f"{paragraph(how_compared(numbers))}</div>" + verdict_rows(judged))
    if todo:
        body += "<h3>What to do</h3>" + bullets(todo)
    return Panel("verdict", "Verdict", body + paragraph(RULE_STREAMS, "note"))


def verdict_rows(judged: list[Judged]) -> str:
    """A row per matter, a column per polarity; below what concerns both."""
    matters = list(dict.fromkeys(j.matter for j in judged if j.matter))
    cells = {(j.about, j.matter): page.badge(j.grade, j.short) for j in judged if j.matter}
    rows = [[page.text(m), *(cells.get((about, m), "–") for about in ("ON", "OFF"))]
            for m in matters]
    others = [[page.badge(j.grade, ""), page.text(j.seen)] for j in judged if not j.matter]
    return table(["", "ON", "OFF"], rows, numeric=False) + (
        table(["", ""], others, numeric=False) if others else "")
