"""The report's charts as SVG: rates, counts, intervals, histograms, scatter plots.

Text remains text, in the reader's own sans-serif font. ON is red and OFF is blue; recorded data are
solid, simulated ones dashed. A figure's size is in inches of 96 CSS pixels. Margins around axes are
fixed: measuring them would take as long as drawing.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from evflow.report.plots import OFF_COLOUR, ON_COLOUR, new_figure, printed, robust_range

INK = "#1d2129"
SIDES = {"on": ("ON", ON_COLOUR), "off": ("OFF", OFF_COLOUR)}
STREAMS = (("real", "-", 1.6), ("synthetic", (0, (3, 1.6)), 1.3))
LOOK: Any = {
    "svg.fonttype": "none", "svg.hashsalt": "evflow", "font.size": 9, "axes.spines.top": False,
    "axes.spines.right": False, "axes.linewidth": 0.7, "axes.edgecolor": "#5d6673",
    "xtick.color": "#5d6673", "ytick.color": "#5d6673", "xtick.labelcolor": "#1d2129",
    "ytick.labelcolor": "#1d2129", "legend.frameon": False, "legend.fontsize": 8,
    "axes.titlesize": 9.5, "axes.titleweight": "bold", "axes.titlelocation": "left",
}
FONTS = "-apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
BINS = 48
SPIKE = 3.0  # times the 95th percentile: rates above are cut and their height written
WIDE = 2.5  # a common range of ON and OFF this much wider than their own would hide both
TICKS = 14  # labels that fit an axis
NUMBERED = (0.75, 0.1, 0.5, 0.12)  # inches left, right, below and above an axis: labels and numbers
TITLED = (0.75, 0.1, 0.5, 0.3)
BAR = 0.85  # inches that a bar of colour takes beside it, with its numbers
COUNT_TICKS = (0, 1, 2, 4, 10, 30, 100, 300, 1000, 3000, 10_000, 100_000)


def svg(
    draw: Callable[[Any], None], width: float, height: float,
    around: tuple[float, float, float, float] = NUMBERED,
) -> bytes:
    """What `draw` makes of the axis of a fresh figure. around: inches left, right, below, above."""
    import matplotlib

    with matplotlib.rc_context(LOOK):
        figure = new_figure(width, height, layout=None)
        left, right, below, above = around
        draw(figure.add_axes((left / width, below / height, (width - left - right) / width,
                              (height - below - above) / height)))
        drawn = printed(figure, "svg", 150).decode()
    return re.sub(r"(?<=[ :])'?DejaVu Sans'?(?=[;\"',])[^;\"]*", FONTS, drawn).encode()


def histogram(values: np.ndarray, summary: float, colour: Any, unit: str) -> bytes:
    """Of a map's pixels (N,): bars, the median with its MAD, the camera's summary dashed."""
    def draw(axis: Any) -> None:
        low, high = robust_range(values)
        axis.hist(np.clip(values, low, high), bins=np.linspace(low, high, BINS), color=colour,
                  alpha=0.75, histtype="stepfilled")
        axis.axvline(np.median(values), color=INK, lw=1.2)
        if np.isfinite(summary) and low <= summary <= high:
            axis.axvline(summary, color=INK, lw=1.2, ls=(0, (2, 2)))
        axis.set_xlabel(unit)
        axis.locator_params(axis="x", nbins=5)
        axis.set_yticks([])
        axis.spines["left"].set_visible(False)

    return svg(draw, 3.0, 1.5, (0.1, 0.1, 0.45, 0.06))


def explained(curve: np.ndarray, ideal: float, found_hz: float, where: str) -> bytes:
    """Share of the brightness that events explain, over the cutoff: curve (K, 2) of cutoff in Hz
    (inf at the right edge) and share; ideal: for an ideal pixel and ideal frames, dashed; found_hz:
    the measured cutoff, 0 for none; where: the light for which it holds."""
    def draw(axis: Any) -> None:
        finite = curve[np.isfinite(curve[:, 0])]
        edge = 3.0 * finite[:, 0].max()
        at = np.where(np.isfinite(curve[:, 0]), curve[:, 0], edge)
        axis.plot(at, curve[:, 1], color=INK, marker="o", ms=3, lw=1.3)
        axis.axhline(ideal, color="#5d6673", lw=1.2, ls=(0, (3, 2)))
        axis.axvline(found_hz or edge, color=ON_COLOUR, lw=1.2)
        axis.set_xscale("log")
        ticks = [20, 50, 100, 200, 500, edge]
        axis.set_xticks(ticks, [*(str(t) for t in ticks[:-1]), "none"], minor=False)
        axis.set_xticks([], minor=True)
        axis.set_xlabel(f"cutoff of the photoreceptor [Hz {where}]")
        axis.set_ylabel("share explained")

    return svg(draw, 3.6, 2.2)


def on_against_off(on: np.ndarray, off: np.ndarray, symbol: str, unit: str) -> bytes:
    """Density of (ON, OFF) of the same pixels (N,), with the diagonal; where the two are far apart
    each axis has its own range."""
    def draw(axis: Any) -> None:
        spans = [robust_range(values, 0.3) for values in (on, off)]
        low, high = min(s[0] for s in spans), max(s[1] for s in spans)
        if high - low < WIDE * min(s[1] - s[0] for s in spans):
            spans = [(low, high)] * 2
        _density(axis, on, off, [np.linspace(*span, 61) for span in spans], "Greys")
        ends = [min(s[0] for s in spans), max(s[1] for s in spans)]
        axis.plot(ends, ends, color="#5d6673", lw=0.8, ls=(0, (4, 3)))
        axis.plot(np.median(on), np.median(off), "+", color=ON_COLOUR, ms=11, mew=1.8)
        axis.locator_params(nbins=5)  # of four digits: noise rates differ in the third
        axis.set(xlim=spans[0], ylim=spans[1], xlabel=f"{symbol} ON [{unit}]",
                 ylabel=f"{symbol} OFF [{unit}]")

    return svg(draw, 5.0, 3.9)


def _density(
    axis: Any, x: np.ndarray, y: np.ndarray, edges: Sequence[np.ndarray], cmap: str
) -> None:
    """Pixels per cell on a logarithmic scale of colour; what lies outside is left out."""
    from matplotlib.colors import LogNorm

    cells, _, _ = np.histogram2d(x, y, edges)
    top = max(2.0, float(cells.max()))
    mesh = axis.pcolormesh(*edges, np.ma.masked_equal(cells.T, 0), cmap=cmap, rasterized=True,
                           norm=LogNorm(0.3, top))  # from .3: a single pixel must be seen
    left, bottom, width, height = axis.get_position().bounds
    inch = 1 / axis.figure.get_figwidth()
    axis.set_position((left, bottom, width - BAR * inch, height))
    beside = axis.figure.add_axes((left + width - (BAR - 0.1) * inch, bottom, 0.11 * inch, height))
    bar = axis.figure.colorbar(mesh, cax=beside)
    bar.ax.set_ylim(1, top)
    ticks = [10**k for k in range(7) if 10**k <= top]
    bar.set_ticks(ticks, labels=[f"{n:,}" for n in ticks])
    bar.ax.minorticks_off()
    bar.set_label("pixels")
    bar.outline.set_visible(False)


def rates(numbers: dict[str, Any], key: str, names: tuple[str, str]) -> bytes:
    """Events per pixel and second of one polarity over time, of both streams."""
    curve = numbers["curve"]
    everything = np.concatenate([curve[s][k] for s, _, _ in STREAMS for k in SIDES])
    top = min(_top(everything), SPIKE * _top(np.percentile(everything, [95])))

    def draw(axis: Any) -> None:
        title, colour = SIDES[key]
        for (stream, style, width), name in zip(STREAMS, names, strict=True):
            rate = np.asarray(curve[stream][key])
            seconds = curve["step_us"] * 1e-6 * (np.arange(len(rate)) + 0.5)
            axis.plot(seconds, rate, ls=style, lw=width, label=name,
                      color=colour if stream == "real" else INK)
            if rate.size and rate.max() > top:  # a spike would flatten all the rest
                axis.annotate(f"{rate.max():.3g} ↑", (seconds[rate.argmax()], 0.8 * top), (5, 0),
                              textcoords="offset points", fontsize=8, color="#5d6673")
        axis.set_title(title, color=colour)
        axis.set(xlabel="time [s]", ylabel="events / pixel / s", ylim=(0, top))
        axis.margins(x=0)
        axis.legend(loc="upper right", ncols=2)

    return svg(draw, 5.0, 2.7, TITLED)


def _top(values: np.ndarray) -> float:
    """Room for the legend above the highest point."""
    return 1.28 * float(values.max()) if values.size and values.max() > 0 else 1.0


def counts(real: np.ndarray, made: np.ndarray, key: str, names: tuple[str, str]) -> bytes:
    """Density of the events per pixel (H, W) of both streams: cells of one number each up to some
    ten, of geometrically growing ranges above."""
    def draw(axis: Any) -> None:
        title, colour = SIDES[key]
        top = max(6.0, float(np.percentile(np.maximum(real, made), 99.98)))
        begins = np.append(0, np.unique(np.rint(np.geomspace(1, top, 60)).astype(int)))
        fired = (real > 0) | (made > 0)
        x, y = (np.searchsorted(begins, n[fired], side="right") - 1 for n in (real, made))
        edges = np.arange(len(begins) + 1) - 0.5
        _density(axis, x, y, (edges, edges), "Reds" if key == "on" else "Blues")
        axis.plot(edges[[0, -1]], edges[[0, -1]], color="#5d6673", lw=0.8, ls=(0, (4, 3)))
        axis.set_title(title, color=colour)
        ticks: list[int] = []
        for n in COUNT_TICKS:
            place = np.searchsorted(begins, [n, *ticks[-1:]], side="right")
            if n <= top and (not ticks or place[0] - place[1] >= len(begins) / TICKS):
                ticks.append(n)
        at = np.searchsorted(begins, ticks, side="right") - 1
        axis.set_xticks(at, [f"{n:,}" for n in ticks])
        axis.set_yticks(at, [f"{n:,}" for n in ticks])
        axis.set(xlabel=f"events of a pixel, {names[0]}", ylabel=f"events of a pixel, {names[1]}")

    return svg(draw, 5.0, 3.9, TITLED)


def times(numbers: dict[str, Any], names: tuple[str, str], xlabel: str) -> bytes:
    """The histogram of `intervals` or `neighbours` of a comparison, share per bin."""
    shown = numbers["histogram"]
    edges = np.asarray(shown["log10_s_edges"])

    def draw(axis: Any) -> None:
        both = np.asarray(shown["real"]) + np.asarray(shown["synthetic"])
        used = np.flatnonzero(both > 1e-4)
        axis.stairs(shown["real"], edges, fill=True, color="#c9ced6", label=names[0])
        axis.stairs(shown["synthetic"], edges, color=INK, lw=1.4, label=names[1])
        if used.size:
            axis.set_xlim(edges[used[0]], edges[used[-1] + 1])
        labels = {-6: "1 µs", -5: "10 µs", -4: "0.1 ms", -3: "1 ms", -2: "10 ms", -1: "0.1 s",
                  0: "1 s", 1: "10 s", 2: "100 s"}
        low, high = axis.get_xlim()
        kept = [at for at in labels if low <= at <= high]
        axis.set_xticks(kept, [labels[at] for at in kept])
        axis.set_xlabel(xlabel)
        axis.set_ylabel("share")
        axis.set_ylim(0, _top(np.maximum(shown["real"], shown["synthetic"])))
        axis.legend(loc="upper left", ncols=2)

    # room on the right for half of a last label that stands at the edge
    return svg(draw, 5.0, 2.7, (NUMBERED[0], 0.3, *NUMBERED[2:]))
