"""Panels of the camera: its maps, ON against OFF, its hot and dead pixels."""

from __future__ import annotations

import numpy as np

from evflow.camera import PARAMETERS
from evflow.estimation.result import CameraEstimate
from evflow.report import figures, page
from evflow.report.page import Panel, figure, grid, number, paragraph, spread
from evflow.report.plots import OFF_COLOUR, ON_COLOUR, robust_range
from evflow.report.verdict import known

TITLES = {"theta_on": "θ ON", "theta_off": "θ OFF", "eta_on": "η ON", "eta_off": "η OFF"}
UNITS = {"theta": "natural log units", "eta": "Hz per pixel"}
LEVELS = 100
PALE = 0.7  # blend towards white for pixels without events of their own
LISTED = 60  # faulty pixels that are listed, the rest are in camera.json


def map_panel(found: CameraEstimate) -> Panel:
    """Four maps, their std, their distribution."""
    pale = ("Pale pixels have no events of their own (fewer than three in the windows used) and "
            "show the camera's summary, or are hot." if found.valid.any() else "")
    body = paragraph(
        "Thresholds θ in natural-log units of brightness, noise rates η in Hz per pixel, each "
        "above its standard deviation. Colours span the central 98 % of a map's pixels, "
        "but at least a tenth of its value. " + pale)
    k = page.blocks(found.n_events)[1]
    if k > 1:
        body += paragraph(f"Each point of a map is the mean of {k}×{k} pixels.", "note")
    return Panel("maps", "The camera, pixel by pixel",
                 body + grid([_card(found, name) for name in PARAMETERS], 13.5))


def _card(found: CameraEstimate, name: str) -> str:
    kind, _, side = name.partition("_")
    if kind == "theta" and not known(found, side):
        return figure(paragraph("Not determined by this recording.", "note"),
                      title=TITLES[name])
    parts = []
    for maps, label in ((found.camera, TITLES[name]), (found.std, "std")):
        values = np.asarray(getattr(maps, name))
        span = robust_range(_trusted(values, found))
        parts.append(_coloured(values, found.valid, span, label))
    values = _trusted(np.asarray(getattr(found.camera, name)), found)
    summary, std = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
    median = float(np.median(values))
    mad = float(np.median(np.abs(values - median)))
    colour = ON_COLOUR if side == "on" else OFF_COLOUR
    drawn = page.drawing(figures.histogram(values, summary, colour, f"{TITLES[name]} "
                                           f"[{UNITS[kind]}]"), f"histogram of {TITLES[name]}")
    which = "pixels with events" if found.valid.any() else "all pixels"
    caption = (f"{which.capitalize()}: median {number(median)}, MAD {number(mad)}. "
               f"Camera (dashed): {spread(summary, std)}.")
    return figure("".join([*parts, drawn]), caption, TITLES[name])


def _trusted(values: np.ndarray, found: CameraEstimate) -> np.ndarray:
    """(N,) the pixels with events of their own; all where there is none."""
    return values[found.valid] if found.valid.any() else values.ravel()


def _coloured(
    values: np.ndarray, valid: np.ndarray, span: tuple[float, float], title: str
) -> str:
    """A map as a picture above its colour bar; pixels that are not valid are pale."""
    from matplotlib import colormaps

    levels = colormaps["viridis"](np.linspace(0, 1, LEVELS))[:, :3]
    level = np.nan_to_num((values - span[0]) / (span[1] - span[0]) * (LEVELS - 1))
    colours = levels[np.clip(np.rint(level), 0, LEVELS - 1).astype(int)]
    if valid.any():
        colours = np.where(valid[..., None], colours, PALE + (1 - PALE) * colours)
    stops = ",".join("#" + "".join(f"{round(255 * c):02x}" for c in levels[i])
                     for i in np.linspace(0, LEVELS - 1, 9).astype(int))
    digits = next((d for d in (3, 4, 5) if number(span[0], d) != number(span[1], d)), 6)
    return (page.picture(page.blocks(colours)[0], f"map: {title}")
            + f'<div class="bar" style="background:linear-gradient(90deg,{stops})"></div>'
            f'<div class="ends"><span>{number(span[0], digits)}</span>'
            f"<span>{page.text(title)}</span><span>{number(span[1], digits)}</span></div>")


def scatter_panel(found: CameraEstimate) -> Panel:
    """ON against OFF, pixel by pixel."""
    kinds = [("θ", "theta", "natural log"), ("η", "eta", "Hz per pixel")]
    if not (known(found, "on") and known(found, "off")):
        kinds = kinds[1:]
    cells = []
    for symbol, kind, unit in kinds:
        on, off = (_trusted(np.asarray(getattr(found.camera, f"{kind}_{side}")), found)
                   for side in ("on", "off"))
        drawn = page.drawing(figures.on_against_off(on, off, symbol, unit),
                             f"{symbol} ON against OFF per pixel")
        medians = [number(float(np.median(v))) for v in (on, off)]
        cells.append(figure(drawn, f"{symbol}: correlation over pixels r = "
                            f"{number(_r(on, off), 2)}; medians (cross) {' and '.join(medians)}."))
    which = "Pixels with events of their own" if found.valid.any() else "All pixels"
    return Panel("on-off", "ON against OFF", grid(cells, 22) + paragraph(
        f"{which}; darker: more pixels (logarithmic). Dashed: equal.",
        "note"))


def _r(a: np.ndarray, b: np.ndarray) -> float | None:
    return float(np.corrcoef(a, b)[0, 1]) if a.size > 1 and np.ptp(a) > 0 < np.ptp(b) else None


def fault_panel(found: CameraEstimate) -> Panel:
    """Hot and dead pixels over the number of events."""
    height, width = found.n_events.shape
    logs = np.log1p(found.n_events.astype(np.float64))
    grey = 1 - 0.75 * page.blocks(logs)[0] / max(float(logs.max()), 1.0)
    radius = max(width, height) / 90
    marks = "".join(
        f'<circle cx="{x + 0.5}" cy="{y + 0.5}" r="{radius:.1f}" fill="none" stroke="{colour}" '
        f'stroke-width="{radius / 3.5:.2f}"/>'
        for mask, colour in ((found.hot, "#b3261e"), (found.dead, "#2159bf"))
        for y, x in np.argwhere(mask)[:2000])
    image = (f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="hot and dead pixels" '
             f'style="border:1px solid var(--line)"><image width="{width}" height="{height}" '
             f'style="image-rendering:pixelated" '
             f'href="{page.png_uri(np.repeat(grey[..., None], 3, -1))}"/>{marks}</svg>')
    lists = "".join(_listed(found, mask, what) for mask, what in (
        (found.hot, "Hot (red): fire without a signal"),
        (found.dead, "Dead (blue): never fire although their neighbours do")))
    return Panel("faults", "Hot and dead pixels", grid([
        figure(image, "Grey: events per pixel in the windows used, logarithmic."),
        f"<div>{lists}</div>"], 22))


def _listed(found: CameraEstimate, mask: np.ndarray, what: str) -> str:
    places = np.argwhere(mask)
    places = places[np.argsort(-found.n_events[mask].astype(np.int64), kind="stable")]
    head = f"<h3>{page.text(what)}: {len(places):,}</h3>"
    if not len(places):
        return head + paragraph("None found.", "note")
    words = ", ".join(f"({x}, {y})" for y, x in places[:LISTED])
    rest = f" and {len(places) - LISTED:,} more (camera.json)" if len(places) > LISTED else ""
    return f"{head}<p class='note'>x, y: {words}{rest}</p>"
