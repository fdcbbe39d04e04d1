"""Plots: maps, histograms, event images, and the quickstart's one-page comparison.

matplotlib is imported on first use (extra `viz`) and always draws off-screen.
"""

from __future__ import annotations

import io
import os
from typing import Any, Literal

import numpy as np

from evflow.camera import PARAMETERS, Camera
from evflow.errors import EvflowDataError
from evflow.estimation.result import CameraEstimate
from evflow.files.atomic import atomic_text
from evflow.report.page import spread
from evflow.types import Events

TITLES = {"theta_on": "θ ON", "theta_off": "θ OFF", "eta_on": "η ON [Hz]", "eta_off": "η OFF [Hz]"}
SYMBOLS = {"theta_on": "θ ON", "theta_off": "θ OFF", "eta_on": "η ON", "eta_off": "η OFF"}
UNITS = {"the": "natural log units", "eta": "Hz per pixel"}
PRINT_DPI = 250
FAST_PNG = 2  # compression level: 6 takes four times as long for a tenth less
PRINT: Any = {
    "font.size": 7, "axes.titlesize": 8, "axes.linewidth": 0.6, "xtick.major.width": 0.6,
    "ytick.major.width": 0.6, "xtick.major.size": 2.5, "ytick.major.size": 2.5,
    "legend.frameon": False, "legend.handlelength": 1.2, "axes.spines.top": False,
    "axes.spines.right": False, "pdf.fonttype": 42, "svg.fonttype": "none",
    "svg.hashsalt": "evflow"}
ON_COLOUR, OFF_COLOUR = (0.80, 0.20, 0.18), (0.13, 0.35, 0.75)  # red and blue, as in the paper
FIGURES = ("png", "pdf", "svg")
LEAST_RANGE = 0.05  # minimum colour range to either side, relative to a map's middle value


def require() -> None:
    """Raise EV010 if matplotlib is missing, before any long work."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as e:
        raise EvflowDataError("EV010", "pictures need matplotlib.",
                              'pip install "evflow-jax[viz]".') from e


def new_figure(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Any:
    """An off-screen figure of width x height inches; EV010 without matplotlib. layout: None for
    axes with explicit positions, which takes half the time."""
    require()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)


def save_figure(figure: Any, path: str | os.PathLike, dpi: float = 110) -> None:
    """Write it as PNG, or as PDF or SVG by the extension; an existing file is replaced."""
    kind = os.fspath(path).rpartition(".")[2].lower()
    atomic_text(path, printed(figure, kind if kind in FIGURES else "png", dpi), overwrite=True)


def printed(figure: Any, kind: str, dpi: float) -> bytes:
    """The bytes of a .png, .pdf or .svg, the same for the same figure. A canvas prints it in one
    drawing; `savefig` draws twice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    figure.set_dpi(dpi)
    if kind == "pdf":
        from matplotlib.backends.backend_pdf import FigureCanvasPdf

        FigureCanvasPdf(figure).print_pdf(buffer, metadata={"CreationDate": None})
    elif kind == "svg":
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        FigureCanvasSVG(figure).print_svg(buffer, metadata=dict.fromkeys(
            ("Date", "Creator", "Format", "Type")))
    else:
        FigureCanvasAgg(figure).print_png(buffer, pil_kwargs={"compress_level": FAST_PNG})
    return buffer.getvalue()


def event_image(events: Events, t0_us: int, t1_us: int) -> np.ndarray:
    """(H, W, 3) in 0..1: white ground, ON and OFF in their colours, saturating at three events."""
    on, off = events.slice(t0_us, t1_us).count_map().astype(np.float32)
    net = np.clip((on - off) / 3.0, -1.0, 1.0)[..., None]
    both = np.clip((on + off) / 3.0, 0.0, 1.0)[..., None]
    colour = np.where(net >= 0, ON_COLOUR, OFF_COLOUR)
    strength = np.maximum(np.abs(net), 0.35 * both)
    return 1.0 - strength * (1.0 - colour)


def robust_range(values: np.ndarray, share: float = 1.0) -> tuple[float, float]:
    """(low, high): excludes `share` per cent of the finite values at either end; at least a tenth
    of their middle apart, so that a nearly uniform map looks uniform."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(finite, [share, 100 - share]))
    middle = 0.5 * (low + high)
    half = max(0.5 * (high - low), LEAST_RANGE * abs(middle) + 1e-6)
    return middle - half, middle + half


def _map(
    axis: Any, values: np.ndarray, title: str, unit: str = "", cmap: str = "viridis",
    below: Any = None,
) -> None:
    """A map with a colour range that is robust to hot pixels; arrows mark values outside. below:
    the axis of its colour bar, if any."""
    low, high = robust_range(values)
    finite = values[np.isfinite(values)]
    less, more = bool((finite < low).any()), bool((finite > high).any())
    image = axis.imshow(values, vmin=low, vmax=high, cmap=cmap, interpolation="nearest")
    where: dict[str, Any] = {"cax": below, "orientation": "horizontal"} if below else {
        "ax": axis, "location": "bottom", "pad": 0.03, "aspect": 22}
    bar = axis.figure.colorbar(image, **where, extend=(
        "both" if less and more else "min" if less else "max" if more else "neither"))
    bar.locator = _few_ticks()
    bar.update_ticks()
    if unit:
        bar.set_label(unit)
    axis.set_title(title)
    height, width = values.shape
    axis.set_xticks([-0.5, width / 2 - 0.5, width - 0.5], ["0", "x [pixels]", str(width)])
    axis.set_yticks([-0.5, height - 0.5], [0, height])
    axis.tick_params(axis="x", length=0)
    for tick, side in zip(axis.get_xticklabels(), ("left", "center", "right"), strict=True):
        tick.set_ha(side)
    axis.spines[:].set_visible(False)


def _few_ticks() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(3, steps=[1, 2, 5, 10])


def _printed() -> Any:
    """A context in which figures are drawn for two columns of a paper."""
    import matplotlib

    return matplotlib.rc_context(PRINT)


def camera_maps(found: CameraEstimate, path: str | os.PathLike) -> None:
    """The four maps above their standard deviations, of .png, .pdf or .svg by the ending."""
    require()
    with _printed():
        height, width = found.n_events.shape
        wide = 1.55
        tall = min(wide * height / width, 4.0)
        page = _Page(7.2, 2 * (tall + 0.85))
        for column, name in enumerate(PARAMETERS):
            left = 0.42 + column * (wide + 0.17)
            for bottom, maps, sign, cmap in ((tall + 1.45, found.camera, "", "viridis"),
                                             (0.6, found.std, "std of ", "cividis")):
                axis = page.axis(left, bottom, wide, tall)
                if name in found.undetermined:
                    axis.set_title(f"{sign}{SYMBOLS[name]}")
                    axis.text(0.5, 0.5, "not measured", ha="center", va="center")
                    axis.set(xticks=[], yticks=[])
                else:
                    _map(axis, np.asarray(getattr(maps, name)), f"{sign}{SYMBOLS[name]}",
                         UNITS[name[:3]], cmap, page.axis(left, bottom - 0.26, wide, 0.07))
                if column:
                    axis.set_yticks([])
                else:
                    axis.set_ylabel("y [pixels]", labelpad=-4)
        save_figure(page.figure, path, dpi=PRINT_DPI)


class _Page:
    """A figure of width x height inches whose axes are placed in inches."""

    def __init__(self, width: float, height: float) -> None:
        self.figure, self.size = new_figure(width, height, layout=None), (width, height)

    def axis(self, left: float, bottom: float, wide: float, tall: float) -> Any:
        width, height = self.size
        return self.figure.add_axes((left / width, bottom / height, wide / width, tall / height))


def _histogram(axis: Any, found: CameraEstimate, name: str, truth: Camera | None) -> None:
    """Histogram of the pixels that have events of their own (the others show the camera's summary
    and would be one dominant spike), and of the truth (black, dashed)."""
    values = np.asarray(getattr(found.camera, name))
    own = found.valid & np.isfinite(values)
    shown, label = (own, f"{own.mean():.0%}, with events") if 0 < own.sum() < own.size else (
        np.isfinite(values), "all pixels")
    colour = ON_COLOUR if name.endswith("on") else OFF_COLOUR
    parts: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
        label: (values[shown], {"color": colour, "alpha": 0.6})}
    if truth is not None:
        parts["truth"] = (np.asarray(getattr(truth, name))[shown],
                          {"color": "k", "histtype": "step", "ls": "--"})
    spans = [robust_range(v, 0.5) for v, _ in parts.values() if v.size]
    low, high = min(s[0] for s in spans), max(s[1] for s in spans)
    bins = np.linspace(max(0.0, low - 0.1 * (high - low)), high + 0.1 * (high - low), 60)
    for label, (v, look) in parts.items():
        if v.size:
            axis.hist(v, bins=bins, label=label, **{"histtype": "stepfilled", **look})
    summary, std = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
    axis.axvline(summary, ymax=0.6, color="k", lw=1, label=spread(summary, std))
    axis.set_title(SYMBOLS[name])
    axis.set_xlabel(UNITS[name[:3]])
    axis.set_ylabel("pixels")
    axis.xaxis.set_major_locator(_few_ticks())
    axis.set_ylim(top=1.6 * axis.get_ylim()[1])  # room for the legend
    axis.legend(fontsize="small", loc="upper right", labelspacing=0.25, borderaxespad=0.1)


def camera_histograms(
    found: CameraEstimate, path: str | os.PathLike, truth: Camera | None = None
) -> None:
    """Histograms of the four maps, with the truth if known; .png, .pdf or .svg."""
    require()
    with _printed():
        page = _Page(7.2, 2.2)
        for column, name in enumerate(PARAMETERS):
            axis = page.axis(0.62 + 1.76 * column, 0.36, 1.18, 1.44)
            if name in found.undetermined and truth is None:
                axis.set_title(SYMBOLS[name])
                axis.text(0.5, 0.5, "not measured", ha="center", va="center")
                axis.set(xticks=[], yticks=[])
            else:
                _histogram(axis, found, name, truth)
                _contrast_axis(axis, name)
        save_figure(page.figure, path, dpi=PRINT_DPI)


def _contrast_axis(axis: Any, name: str) -> None:
    """Thresholds in percent of contrast along the upper edge."""
    if name.startswith("theta"):
        axis.set_title("")
        upper = axis.secondary_xaxis("top", functions=(
            lambda theta: 100 * np.expm1(theta),
            lambda percent: np.log1p(np.maximum(percent, -99) / 100)))
        upper.set_xlabel(f"{SYMBOLS[name]}, contrast [%]")
        upper.xaxis.set_major_locator(_few_ticks())


def comparison(
    path: str | os.PathLike, frame: np.ndarray, real: Events, made: Events,
    span_us: tuple[int, int], found: CameraEstimate, truth: Camera | None = None,
) -> None:
    """One page: a frame, real and re-made events of the same instant, event rates, maps and
    histograms."""
    figure = new_figure(16, 9.6)
    axes = figure.subplots(3, 4, height_ratios=(1.1, 1.0, 0.8))
    axes[0, 0].imshow(frame, cmap="gray", vmin=0, vmax=255)
    axes[0, 0].set_title("frame")
    for axis, events, title in ((axes[0, 1], real, "recorded events"),
                                (axes[0, 2], made, "re-simulated with the estimate")):
        axis.imshow(event_image(events, *span_us))
        axis.set_title(f"{title}, {(span_us[1] - span_us[0]) / 1000:.0f} ms")
    for axis in axes[0, :3]:
        axis.set_xticks([])
        axis.set_yticks([])
    _rates(axes[0, 3], real, made)
    for column, name in enumerate(PARAMETERS):
        _map(axes[1, column], np.asarray(getattr(found.camera, name)), f"{TITLES[name]}, estimated")
        _histogram(axes[2, column], found, name, truth)
    save_figure(figure, path)


def _rates(axis: Any, real: Events, made: Events, step_us: int = 5_000) -> None:
    """Events per pixel and second over time, per polarity: recorded solid, re-simulated dashed."""
    start, stop = int(min(real.t[0], made.t[0])), int(max(real.t[-1], made.t[-1]))
    edges = np.arange(start, stop + step_us, step_us)
    for events, style, label in ((real, "-", "recorded"), (made, "--", "re-made")):
        for polarity, colour, name in ((True, ON_COLOUR, "ON"), (False, OFF_COLOUR, "OFF")):
            counts, _ = np.histogram(events.t[events.p == polarity], edges)
            rate = counts / (step_us * 1e-6) / (events.size[0] * events.size[1])
            axis.plot((edges[:-1] - start) / 1000, rate, style, color=colour, lw=1.2,
                      label=f"{label} {name}")
    axis.set_xlabel("ms")
    axis.set_ylabel("events / pixel / s")
    axis.set_ylim(bottom=0)
    axis.legend(fontsize=7)
    axis.set_title("event rate")
