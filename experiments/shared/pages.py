"""Pages of experiments: noise against its laws, noise sources, sensor models, slow pixels.

Each function draws what an experiment has measured and writes one PNG. As in the paper, ON is red
and OFF is blue here.
"""

from __future__ import annotations

import itertools
import os
from typing import Any

import numpy as np

from evflow.report.plots import OFF_COLOUR, ON_COLOUR, event_image, new_figure, save_figure
from evflow.types import Events

SIDES = (("on", ON_COLOUR), ("off", OFF_COLOUR))


def _image(axis: Any, events: Events, span_us: tuple[int, int], title: str) -> None:
    axis.imshow(event_image(events, *span_us), interpolation="nearest")
    axis.set_title(title, fontsize=10)
    axis.set_xticks([])
    axis.set_yticks([])


def noise_laws(
    path: str | os.PathLike, result: dict[str, Any], paper: dict[str, np.ndarray],
    lux: np.ndarray,
) -> None:
    """A column per sensor: events of a changing screen over thresholds, then ON and OFF noise over
    luminance. Marks are measured, lines the law."""
    names = tuple(result["table II"])
    figure = new_figure(3.3 * len(names), 9.0)
    axes = figure.subplots(3, len(names), squeeze=False)
    for column, name in enumerate(names):
        _counts(axes[0, column], result["table II"][name], paper)
        axes[0, column].set_title(name)
        for row, (polarity, _) in enumerate(SIDES, 1):
            _rest(axes[row, column], result["figure 5"][name], polarity, paper[polarity][:, 0], lux)
    axes[0, 0].set_ylabel("events of SCP 161 = 1")
    for row, (polarity, _) in enumerate(SIDES, 1):
        axes[row, 0].set_ylabel(f"{polarity.upper()} noise [Hz / pixel]")
    axes[0, 0].legend(fontsize=7)
    axes[1, 0].legend(fontsize=7, title="θ", title_fontsize=7)
    axes[2, 0].legend(fontsize=7, title="θ", title_fontsize=7)
    figure.suptitle("Marks: simulated. Lines: the law. Top: a ninefold brighter (ON) or darker "
                    "(OFF) screen, thresholds of Table II; below: screens at rest")
    save_figure(figure, path)


def _counts(axis: Any, rows: list[dict[str, Any]], paper: dict[str, np.ndarray]) -> None:
    for polarity, colour in SIDES:
        theta, events = paper[polarity][:, 0], paper[polarity][:, 2]
        ramp = [row[f"{polarity} ramp"] for row in rows]
        base = ramp[len(ramp) // 2]
        axis.plot(theta, [c["law"] / base["law"] for c in ramp], color=colour, lw=1)
        axis.plot(theta, [c["events"] / base["law"] for c in ramp], "o", color=colour, ms=5,
                  label=f"{polarity.upper()}")
        axis.plot(theta, events / events[len(rows) // 2], "x", color=colour, ms=6,
                  label=f"{polarity.upper()}, paper")
    axis.set_xscale("log")
    axis.set_yscale("log")
    ticks = (0.12, 0.2, 0.3, 0.45)
    axis.set_xticks(ticks, [str(t) for t in ticks])
    axis.set_xticks([], minor=True)
    axis.set_yticks((0.5, 1, 2, 4), ("0.5", "1", "2", "4"))
    axis.set_yticks([], minor=True)
    axis.set_ylim(0.4, 5)
    axis.set_xlabel("threshold θ")


def _rest(
    axis: Any, rows: list[dict[str, Any]], polarity: str, theta: np.ndarray, lux: np.ndarray
) -> None:
    import matplotlib

    shades = matplotlib.colormaps["plasma"](np.linspace(0.0, 0.85, len(rows)))
    for row, th, shade in zip(rows, theta, shades, strict=True):
        exposure = row["pixels"] * row["seconds"]
        law, events = (np.array([c[k] / exposure for c in row[polarity]])
                       for k in ("law", "events"))
        axis.plot(lux, law, color=shade, lw=1)
        axis.plot(lux, events, "o", color=shade, ms=3.5, label=f"{th:.2f}")
    axis.set_xlabel("luminance [lx]")
    top = max(line.get_ydata().max() for line in axis.lines)
    if top < 1e-3:
        axis.text(0.5, 0.5, "below .001 Hz", ha="center", transform=axis.transAxes, color="0.4")
        axis.set_yticks([])
    axis.set_xlim(0, 1.05 * lux[-1])
    axis.set_ylim(0, 1.12 * max(top, 1e-3))


def event_rates(path: str | os.PathLike, scenes: list[dict[str, Any]]) -> None:
    """As Figure 4 of the paper: 30 ms of events, the luminance, and the distribution of rates.

    scenes: title, dn (T,), seconds, events, span_us; drawn in two rows."""
    columns = len(scenes) // 2
    figure = new_figure(5.0 * columns, 9.4)
    grid = figure.add_gridspec(4, 2 * columns, height_ratios=(2.0, 1.0, 2.0, 1.0))
    for k, scene in enumerate(scenes):
        row, column = 2 * (k // columns), 2 * (k % columns)
        events, seconds = scene["events"], scene["seconds"]
        _image(figure.add_subplot(grid[row, column:column + 2]), events, scene["span_us"],
               f"{scene['title']}: {len(events):,} events in {seconds:g} s")
        light, rates = (figure.add_subplot(grid[row + 1, column + i]) for i in (0, 1))
        light.plot(np.linspace(0, seconds, len(scene["dn"])), scene["dn"], color="0.3")
        light.set_ylim(0, 255)
        light.set_xlabel("s")
        light.set_ylabel("DN")
        _rate_histogram(rates, events.count_map() / seconds)
    figure.suptitle("The last 30 ms of events (ON red, OFF blue), luminance, and pixels by rate")
    save_figure(figure, path)


def _rate_histogram(axis: Any, rates: np.ndarray) -> None:
    """Pixels by log10 of their event rate; rates (2, H, W), silent pixels as a number."""
    logs = [np.log10(side[side > 0]) for side in rates]
    found = np.concatenate(logs)
    silent: list[str] = []
    low, high = (found.min() - 0.2, found.max() + 0.2) if found.size else (-1.0, 1.0)
    for values, side, (polarity, colour) in zip(logs, rates, SIDES, strict=True):
        axis.hist(values, np.linspace(low, high, 28), histtype="stepfilled", color=colour,
                  alpha=0.45)
        silent.append(f"{polarity.upper()} {np.mean(side == 0):.0%}")
    axis.set_title(f"silent: {', '.join(silent)}", fontsize=8)
    axis.set_xlabel("log10 Hz")
    axis.set_ylabel("pixels")


def noise_sources(path: str | os.PathLike, sources: list[dict[str, Any]]) -> None:
    """Each source of noise: its map above the measured curve and its law."""
    columns = len(sources) // 2
    figure = new_figure(4.2 * columns, 11.0)
    axes = figure.subplots(4, columns, height_ratios=(1.0, 0.9, 1.0, 0.9))
    for k, source in enumerate(sources):
        row, column = 2 * (k // columns), k % columns
        _source_map(axes[row, column], source)
        _source_curve(axes[row + 1, column], source)
    save_figure(figure, path)


def _source_map(axis: Any, source: dict[str, Any]) -> None:
    values = np.asarray(source["map"])
    unit = "events" if source["xlabel"] == "events" else "Hz"
    top = max(float(np.percentile(values, 99.5)), 1.0)
    image = axis.imshow(values, vmin=0, vmax=top, cmap="magma", interpolation="nearest")
    axis.figure.colorbar(image, ax=axis, shrink=0.75, label=unit)
    axis.set_title(source["title"], fontsize=10)
    axis.set_axis_off()


def _source_curve(axis: Any, source: dict[str, Any]) -> None:
    x, measured, law = (np.asarray(source[k]) for k in ("x", "measured", "law"))
    if source.get("steps") or source.get("discrete"):
        axis.bar(x, measured, width=x[1] - x[0], color="0.75", label="simulated")
        axis.plot(x, law, "o" if source.get("discrete") else "-", color=ON_COLOUR, ms=4, lw=1.3,
                  label="law")
    else:
        axis.plot(x, law, color=ON_COLOUR, lw=1.3, label="law")
        axis.plot(x, measured, "o", color="0.35", ms=4, label="simulated")
    axis.set_ylim(bottom=0)
    if source.get("log") is True:
        axis.set_xscale("log")
    if source.get("log"):
        axis.set_yscale("log")
        axis.set_ylim(1e-4, 1.5)
    axis.set_xlabel(source["xlabel"])
    axis.set_ylabel(source["ylabel"])
    axis.legend(fontsize=7)


def sensor_models(
    path: str | os.PathLike, frame: np.ndarray, seen: dict[str, Events], figures: dict[str, Any],
    span_us: tuple[int, int],
) -> None:
    """One scene seen by many sensors: the frame and event images of a span to the left; event
    rates, intervals, counts and distinct time stamps to the right.

    figures: per sensor "rate_s" (T,), "rate_on", "rate_off" (T,), "interval_s" (B,), "intervals"
    (B,) density per decade, "on", "off", "distinct".
    """
    import matplotlib

    columns = 3
    rows = -(-(len(seen) + 1) // columns)
    figure = new_figure(18.5, 3.2 * rows)
    grid = figure.add_gridspec(3 * rows, columns + 2)
    places = [figure.add_subplot(grid[3 * (k // columns):3 * (k // columns) + 3, k % columns])
              for k in range(len(seen) + 1)]
    places[0].imshow(frame, cmap="gray", vmin=0, vmax=255)
    places[0].set_title("frame", fontsize=10)
    places[0].set_xticks([])
    places[0].set_yticks([])
    for axis, (name, events) in zip(places[1:], seen.items(), strict=True):
        _image(axis, events, span_us, f"{name}: {len(events):,} events")
    shades = matplotlib.colormaps["tab10"](range(10))
    colours = dict(zip(seen, shades, strict=False))
    side = [figure.add_subplot(grid[rows * k:rows * (k + 1), columns:]) for k in range(3)]
    _rate_curves(side[0], figures, colours)
    _intervals(side[1], figures, colours)
    _bars(side[2], figures)
    save_figure(figure, path)


def _rate_curves(axis: Any, figures: dict[str, Any], colours: dict[str, Any]) -> None:
    """ON rates upwards, OFF rates downwards."""
    for (name, row), style in zip(figures.items(), itertools.cycle(("-", "--"))):
        ms, look = 1e3 * np.asarray(row["rate_s"]), {"color": colours[name], "ls": style, "lw": 1.3}
        axis.plot(ms, row["rate_on"], label=name, **look)
        axis.plot(ms, -np.asarray(row["rate_off"]), **look)
    axis.axhline(0.0, color="0.3", lw=0.8)
    axis.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
    axis.set_xlabel("ms")
    axis.set_ylabel("OFF    events / pixel / s    ON")
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _intervals(axis: Any, figures: dict[str, Any], colours: dict[str, Any]) -> None:
    for name, row in figures.items():
        axis.plot(1e3 * np.asarray(row["interval_s"]), row["intervals"], color=colours[name],
                  lw=1.3, drawstyle="steps-mid", label=name)
    axis.set_xscale("log")
    axis.set_ylim(bottom=0)
    axis.set_xlabel("interval between events of a pixel [ms]")
    axis.set_ylabel("density per decade")


def _bars(axis: Any, figures: dict[str, Any]) -> None:
    names = list(figures)
    at = np.arange(len(names))
    for (polarity, colour), shift in zip(SIDES, (-0.25, 0.0), strict=True):
        axis.barh(at + shift, [figures[n][polarity] for n in names], 0.25, color=colour,
                  label=polarity.upper())
    axis.barh(at + 0.25, [figures[n]["distinct"] for n in names], 0.25, color="0.5",
              label="distinct time stamps")
    axis.set_yticks(at, names)
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.set_xlabel("events, time stamps")
    axis.grid(axis="x", color="0.85")
    axis.set_axisbelow(True)
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))


def slow_pixels(path: str | os.PathLike, rows: dict[str, list[dict[str, Any]]]) -> None:
    """Every threshold's |error|, in per cent and over its standard deviation."""
    figure = new_figure(11.0, 0.3 * len(rows) + 1.5)
    axes = figure.subplots(1, 2, sharey=True)
    looks = (("0.6", "ideal", "pixels taken for ideal"), ("tab:blue", "measured", "measured"))
    for k, (colour, which, label) in enumerate(looks):
        for place, found in enumerate(rows.values()):
            error, std = (np.array([r[which][name] for r in found if which in r]).ravel()
                          for name in ("error", "std"))
            y = np.full(error.size, place + 0.3 * k - 0.15)
            axes[0].plot(100 * np.abs(error) + 0.1, y, ".", color=colour, label=label)
            axes[1].plot(np.abs(error) / std, y, ".", color=colour)
            label = ""  # once in the legend
    axes[0].set(xscale="log", xlabel="|error| of θ [%]", yticks=range(len(rows)),
                yticklabels=list(rows))
    axes[0].invert_yaxis()
    axes[0].legend(fontsize=8)
    axes[1].set(xlim=(0, 8), xlabel="|error| / std (beyond 8: off the scale)")
    for at in (1.0, 1.96):
        axes[1].axvline(at, color="0.3", lw=0.8)
    save_figure(figure, path)
