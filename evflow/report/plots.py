"""Plots: maps, histograms, event images, and the quickstart's one-page comparison.

matplotlib is imported on first use (extra `viz`) and always draws off-screen.
"""

from __future__ import annotations

import io
import os
from typing import Any

import numpy as np

from evflow.camera import PARAMETERS, Camera
from evflow.errors import EvflowDataError
from evflow.estimation.result import CameraEstimate
from evflow.files.atomic import atomic_text
from evflow.types import Events

TITLES = {"theta_on": "θ ON", "theta_off": "θ OFF", "eta_on": "η ON [Hz]", "eta_off": "η OFF [Hz]"}
ON_COLOUR, OFF_COLOUR = (0.80, 0.20, 0.18), (0.13, 0.35, 0.75)  # red and blue, as in the paper
LEAST_RANGE = 0.05  # of a map's middle value, to either side


def require() -> None:
    """Raise EV010 where matplotlib is missing, before any long work."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as e:
        raise EvflowDataError("EV010", "pictures need matplotlib.",
                              'pip install "evflow-jax[viz]", '
                              'or pass --no-plots --no-report.') from e


def new_figure(width: float, height: float) -> Any:
    """An off-screen figure of width x height inches; EV010 without matplotlib."""
    require()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Any, path: str | os.PathLike) -> None:
    """Write it as PNG; an existing file is replaced."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    atomic_text(path, buffer.getvalue(), overwrite=True)


def event_image(events: Events, t0_us: int, t1_us: int) -> np.ndarray:
    """(H, W, 3) in 0..1: white ground, ON and OFF in their colours, saturating at three events."""
    on, off = events.slice(t0_us, t1_us).count_map().astype(np.float32)
    net = np.clip((on - off) / 3.0, -1.0, 1.0)[..., None]
    both = np.clip((on + off) / 3.0, 0.0, 1.0)[..., None]
    colour = np.where(net >= 0, ON_COLOUR, OFF_COLOUR)
    strength = np.maximum(np.abs(net), 0.35 * both)
    return 1.0 - strength * (1.0 - colour)


def robust_range(values: np.ndarray, share: float = 1.0) -> tuple[float, float]:
    """(low, high): all but `share` per cent of the finite values at either end; at least a tenth of
    their middle apart, or a map that is all but even would look as uneven as any."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(finite, [share, 100 - share]))
    middle = 0.5 * (low + high)
    half = max(0.5 * (high - low), LEAST_RANGE * abs(middle) + 1e-6)
    return middle - half, middle + half


def _map(axis: Any, values: np.ndarray, title: str) -> None:
    low, high = robust_range(values)
    image = axis.imshow(values, vmin=low, vmax=high, cmap="viridis")
    axis.figure.colorbar(image, ax=axis, shrink=0.8)
    axis.set_title(title)
    axis.set_axis_off()


def camera_maps(found: CameraEstimate, path: str | os.PathLike) -> None:
    """The four maps above their standard deviations."""
    figure = new_figure(15, 6.2)
    axes = figure.subplots(2, 4)
    for column, name in enumerate(PARAMETERS):
        _map(axes[0, column], np.asarray(getattr(found.camera, name)), TITLES[name])
        _map(axes[1, column], np.asarray(getattr(found.std, name)), f"std of {TITLES[name]}")
    save_figure(figure, path)


def _histogram(axis: Any, found: CameraEstimate, name: str, truth: Camera | None) -> None:
    values = np.asarray(getattr(found.camera, name))
    parts = {"all pixels": values.ravel(), "pixels with events": values[found.valid]}
    if truth is not None:
        parts["truth"] = np.asarray(getattr(truth, name)).ravel()
    top = max(float(np.percentile(v, 99.5)) for v in parts.values() if v.size)
    bins = np.linspace(0.0, max(1.2 * top, 1e-3), 60)
    for label, v in parts.items():
        if v.size:
            axis.hist(v, bins=bins, density=True, histtype="step", label=label)
    summary = float(getattr(found.summary, name))
    axis.axvline(summary, color="0.4", lw=1, ls="--", label=f"summary {summary:.3f}")
    axis.set_title(TITLES[name])
    axis.set_yticks([])
    axis.legend(fontsize=7)


def camera_histograms(
    found: CameraEstimate, path: str | os.PathLike, truth: Camera | None = None
) -> None:
    """Histograms of the four maps; the truth beside them where it is known."""
    figure = new_figure(14, 3.2)
    for axis, name in zip(figure.subplots(1, 4), PARAMETERS, strict=True):
        _histogram(axis, found, name, truth)
    save_figure(figure, path)


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
                                (axes[0, 2], made, "re-made with the estimate")):
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
    """Events per pixel and second over time, per polarity: recorded solid, re-made dashed."""
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
