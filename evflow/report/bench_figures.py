"""Charts of a bench: distribution of thresholds in percent of contrast, events over step size,
noise and speed over light. As in figures.py, ON is red and OFF is blue."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from evflow.estimation.bench.levels import Bench, Level, Step
from evflow.report.figures import INK, SIDES, svg
from evflow.report.page import short
from evflow.report.plots import robust_range

AXES = {"DN": "light [DN of 255]", "lux": "illuminance [lux]", "light": "light [as given]"}
SOFT = "#5d6673"
BINS = 60
WIDTH, HEIGHT = 5.0, 3.0

Sides = dict[str, np.ndarray]  # "on", "off" -> values (N,) of the pixels that were measured


def contrast(theta: np.ndarray | float) -> Any:
    """Percent by which the brighter light exceeds the darker, for a change in log units."""
    return 100.0 * np.expm1(theta)


def distribution(thetas: Sides) -> bytes:
    """Histograms of the pixels' thresholds in percent of contrast."""
    def draw(axis: Any) -> None:
        low, high = _range(thetas)
        for side, theta in thetas.items():
            title, colour = SIDES[side]
            axis.hist(np.clip(contrast(theta), low, high), bins=np.linspace(low, high, BINS),
                      color=colour, histtype="stepfilled", alpha=0.35)
            axis.hist(np.clip(contrast(theta), low, high), bins=np.linspace(low, high, BINS),
                      color=colour, histtype="step", lw=1.3, label=title)
        axis.set(xlabel="contrast threshold [%]", ylabel="pixels", xlim=(low, high))
        axis.legend(loc="upper right")

    return svg(draw, WIDTH, HEIGHT)


def s_curve(thetas: Sides) -> bytes:
    """Share of the pixels that fire, over the contrast of a change."""
    def draw(axis: Any) -> None:
        low, high = _range(thetas)
        for side, theta in thetas.items():
            title, colour = SIDES[side]
            axis.plot(np.sort(contrast(theta)), 100.0 * (np.arange(len(theta)) + 1) / len(theta),
                      color=colour, lw=1.6, label=title)
        axis.axhline(50.0, color=SOFT, lw=0.8, ls=(0, (4, 3)))
        axis.set(xlabel="contrast [%]", ylabel="pixels that respond [%]", xlim=(low, high),
                 ylim=(0, 100))
        axis.legend(loc="lower right")

    return svg(draw, WIDTH, HEIGHT)


def _range(thetas: Sides) -> tuple[float, float]:
    spans = [robust_range(contrast(theta), 0.3) for theta in thetas.values()]
    low, high = min(s[0] for s in spans), max(s[1] for s in spans)
    return max(0.0, low - 0.15 * (high - low)), high + 0.15 * (high - low)


def steps(taken: Sequence[Step], thetas: Sides) -> bytes:
    """Events per pixel and step over its size; lines are predicted from the thresholds."""
    def draw(axis: Any) -> None:
        top = max(abs(step.change) for step in taken)
        for (side, (title, colour)), sign in zip(SIDES.items(), (1, -1), strict=True):
            own = [step for step in taken if sign * step.change > 0]
            axis.plot([abs(s.change) for s in own], [s.events for s in own], "o", color=colour,
                      ms=4, alpha=0.6, mew=0,
                      label=f"{title}, light {'up' if sign > 0 else 'down'}")
            if side in thetas and own:
                axis.plot([0, 1.05 * top], [0, 1.05 * top * np.mean(1.0 / thetas[side])],
                          color=colour, lw=1.0, ls=(0, (4, 3)))
        axis.set(xlabel="size of the step [natural log units]", ylabel="events per pixel",
                 xlim=(0, 1.05 * top))
        axis.set_ylim(bottom=0)
        axis.legend(loc="upper left")

    return svg(draw, WIDTH, HEIGHT)


def noise(bench: Bench) -> bytes:
    """Noise rates over light, with their errors."""
    def draw(axis: Any) -> None:
        levels = [level for level in bench.levels if level.seconds > 0]
        for side, (title, colour) in SIDES.items():
            rate, error = (np.array([getattr(level, f"eta_{side}{part}") for level in levels])
                           for part in ("", "_std"))
            axis.errorbar([level.light for level in levels], rate, error, color=colour, lw=1.2,
                          marker="o", ms=4, capsize=2, label=title)
        _light_axis(axis, bench, levels)
        axis.set_ylabel("noise [Hz per pixel]")
        rates = [v for level in levels for v in (level.eta_on, level.eta_off) if v > 0]
        if rates and max(rates) > 10 * min(rates):
            axis.set_yscale("log")
        else:
            axis.set_ylim(bottom=0)
        axis.legend()

    return svg(draw, WIDTH, HEIGHT)


def speed(bench: Bench) -> bytes:
    """Duration of steps over the light they lead to."""
    def draw(axis: Any) -> None:
        for name, (side, title) in (("up_s", ("on", "up to it (ON)")),
                                    ("down_s", ("off", "down to it (OFF)"))):
            levels = [level for level in bench.levels if getattr(level, name) is not None]
            axis.plot([level.light for level in levels],
                      [1e3 * getattr(level, name) for level in levels], marker="o", ms=4, lw=1.2,
                      color=SIDES[side][1], label=title)
        _light_axis(axis, bench, list(bench.levels))
        axis.set_ylabel("50 to 90 % of a step [ms]")
        axis.set_ylim(0, 1.1 * axis.dataLim.ymax)
        axis.legend()

    return svg(draw, WIDTH, HEIGHT)


def latency(bench: Bench) -> bytes:
    """Median latency and jitter over step size; darker colours for brighter light."""
    lights = sorted({v.light for v in bench.latency})

    def draw(axis: Any) -> None:
        for side, (title, colour) in SIDES.items():
            own = [v for v in bench.latency if (v.change > 0) == (side == "on")]
            for i, v in enumerate(own):
                axis.errorbar(abs(v.change), 1e3 * v.seconds, 1e3 * v.jitter_s, color=colour,
                              marker="o", ms=4, capsize=2, lw=1.0,
                              alpha=0.35 + 0.65 * (1 + lights.index(v.light)) / len(lights),
                              label=title if not i else None)
        axis.set(xlabel="size of the step [natural log units]", ylabel="latency [ms]")
        axis.set_xlim(left=0)
        axis.set_ylim(bottom=0)
        axis.legend(loc="upper right")

    return svg(draw, WIDTH, HEIGHT)


def _light_axis(axis: Any, bench: Bench, levels: list[Level]) -> None:
    light = [level.light for level in levels]
    axis.set_xlabel(AXES[bench.unit])
    if light and min(light) > 0 and max(light) > 5 * min(light):
        axis.set_xscale("log")
        ticks = light if len(light) <= 6 else light[:: -(-len(light) // 6)]
        axis.set_xticks(ticks, [short(v) for v in ticks])
        axis.set_xticks([], minor=True)
    for edge in ("left", "bottom"):
        axis.spines[edge].set_color(INK)
