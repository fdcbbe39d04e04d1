"""Noise of real sensors beside the closed forms and ours (paper, Figs. 10, 11): measured histograms
at three lights (IEBCS) and a DVXplorer at rest, where the folder EVFLOW_DATA has them. Part of
`noise_rates`, which prints and draws them.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

from evflow import Recording, estimate_camera, read_recording, simulate
from evflow.baselines import v2e_noise, voltmeter_noise
from evflow.camera import Camera
from evflow.camera.perturb import read_noise_histogram, with_noise_histogram
from evflow.errors import EvflowDataError
from evflow.report import plots

Rates = dict[str, np.ndarray]

HISTOGRAMS = {"0.1lux": 0.1, "161lux": 161.0, "3klux": 3000.0}
LUX_PER_DN = 3000 / 255  # of the histograms: assumed, the brightest is full scale
HISTOGRAM_S = 20  # of a recording made of them
SIDES = (("ON", plots.ON_COLOUR), ("OFF", plots.OFF_COLOUR))


def ours(params: Any, recording: Recording) -> Rates:
    """The camera's rates (2,) and their std; NaN where the estimate is refused."""
    try:
        found = estimate_camera(recording, params)
    except EvflowDataError as error:
        print(f"refused: {error}")
        return {"ours": np.full(2, np.nan), "std": np.full(2, np.nan)}
    return {name: np.array([float(s.eta_on), float(s.eta_off)])
            for name, s in (("ours", found.summary), ("std", found.summary_std))}


def histograms(path: Path, params: Any, key: jax.Array) -> dict[str, Any]:
    """How noise is shared out over three levels of light and two polarities, (3, 2) summing to 1
    as recordings of unknown length allow: measured, by closed forms, and by ours on recordings of
    cameras with the measured pixels' rates (NaN where it refuses; on the scale of the measured).
    distance: half the summed differences."""
    shares: Rates = {"measured": np.zeros((3, 2)), "ours, maps": np.full((3, 2), np.nan)}
    dn = np.minimum(np.array(list(HISTOGRAMS.values())) / LUX_PER_DN, 255.0)
    shares["v2e"] = np.stack([v2e_noise(1.0, dn, nominal=1.0)] * 2, -1)
    shares["evolt"] = np.stack(voltmeter_noise(dn), -1)
    result: dict[str, Any] = {"notes": []}
    grey = np.full((64, 64), 128.0, np.float32)  # the rates are those measured, whatever is shown
    for i, name in enumerate(HISTOGRAMS):
        pair = [read_noise_histogram(path, f"{side}_{name}") for side in ("pos", "neg")]
        camera = with_noise_histogram(
            jax.random.fold_in(key, i), Camera.constant((64, 64)), pair[0], pair[1])
        times = 250_000 * np.arange(4 * HISTOGRAM_S + 1)
        events = simulate(key, np.stack([grey] * len(times)), times, camera)
        shares["measured"][i] = [h.rates().mean() for h in pair]
        try:
            found = estimate_camera(Recording.of_events(events), params)
            shares["ours, maps"][i] = [found.camera.eta_on.mean(), found.camera.eta_off.mean()]
            result["notes"].append(f"{name}: {found.hot.sum()} hot pixels")
        except EvflowDataError as error:
            result["notes"].append(f"{name}: {error}")
    total = {k: np.sum(v) for k, v in shares.items()} | {"ours, maps": shares["measured"].sum()}
    shares = {k: np.asarray(v) / total[k] for k, v in shares.items()}
    return result | {"lux": list(HISTOGRAMS.values()), "shares": shares, "distance": {
        k: float(0.5 * np.abs(v - shares["measured"]).sum()) for k, v in shares.items()}}


def at_rest(path: Path, params: Any) -> dict[str, Any]:
    """Rates (ON, OFF) of a DVXplorer at rest, light and thresholds unknown: counted, ours (and
    from the first half of the recording what the second half counts), and what the closed forms
    say in the dark, at 127 DN and at full scale, v2e at r = 1 or 5 Hz (its preset "noisy")."""
    recording = read_recording(path)
    events, counts = recording.events, recording.events.count_map()
    seconds = 1e-6 * events.duration_us
    total = counts.sum(0)
    usual = total <= np.quantile(total, 0.999)
    middle = int(events.t[0] + events.t[-1]) // 2
    first, second = (events.slice(a, b) for a, b in (
        (int(events.t[0]), middle), (middle, int(events.t[-1]) + 1)))
    early = estimate_camera(Recording.of_events(first), params)
    rows = {"counted": counts.mean((1, 2)) / seconds,
            "counted, without the top .1 %": counts[:, usual].mean(1) / seconds,
            "counted, second half": (
                second.count_map()[:, ~early.hot].mean(1) / (1e-6 * second.duration_us)),
            "ours": ours(params, recording)["ours"],
            "ours, first half": np.array([early.summary.eta_on, early.summary.eta_off])}
    for dn in (0.0, 127.0, 255.0):
        for rate in (1.0, 5.0):
            eta = float(v2e_noise(1.0, dn, nominal=1.0, rate_hz=rate))
            rows[f"v2e, r = {rate:g}, {dn:g} DN"] = np.full(2, eta)
        rows[f"evolt, {dn:g} DN"] = np.array([float(r) for r in voltmeter_noise(dn)])
    return rows


def measured(params: Any, key: jax.Array) -> dict[str, Any]:
    """What the real sensors' files say, where they are."""
    found: dict[str, Any] = {}
    folder = Path(os.environ.get("EVFLOW_DATA") or "absent") / "data/recordings"
    for name, run in (("iebcs_noise_hist/noise_cumhist.npz", lambda p: histograms(p, params, key)),
                      ("noise_static_dvxplorer640/events.npz", lambda p: at_rest(p, params))):
        if (folder / name).exists():
            found[name.split("/")[0]] = run(folder / name)
        else:
            print(f"left out: {name} is not under $EVFLOW_DATA/data/recordings.")
    return found


def measured_page(path: Path, real: dict[str, Any]) -> None:
    """As Fig. 11: the histograms' shares over light, and the rates of the camera at rest."""
    figure = plots.new_figure(13, 4.6)
    left, right = figure.subplots(1, 2)
    shape = real.get("iebcs_noise_hist", {"shares": {}})
    for (name, v), style in zip(shape["shares"].items(), ("-", "o", "--", ":"), strict=False):
        for i, (side, colour) in enumerate(SIDES):
            left.plot(shape["lux"], v[:, i], style, color=colour, label=f"{name}, {side}")
    left.set(xscale="log", yscale="log", ylim=(1e-4, 2), xlabel="luminance [lx]",
             ylabel="share of the noise", title="IEBCS (below 1e-4: none)")
    rows = real.get("noise_static_dvxplorer640", {})
    for i, (side, colour) in enumerate(SIDES):
        right.barh(np.arange(len(rows)) + 0.4 * i, [v[i] for v in rows.values()], 0.4,
                   color=colour, label=side)
    right.set_yticks(np.arange(len(rows)) + 0.2, list(rows))
    right.invert_yaxis()
    right.set(xlabel="Hz / pixel", title="DVXplorer at rest")
    for axis in (left, right):
        axis.legend(fontsize=7)
    plots.save_figure(figure, path)
