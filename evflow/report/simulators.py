"""Which simulator predicts this camera best? The pixels of v2e, ESIM and DVS-Voltmeter compared.

Each has its own best constants, from the first half of a recording, and is tested on the same
frames of the second. v2e's pixel is the measured camera, pixel by pixel, with its photoreceptor;
ESIM's has one threshold per polarity, the same dead time and no noise; DVS-Voltmeter's comes from
`baselines/voltmeter_fit.py`. All thresholds are scaled so that the first half gets as many events
as were recorded; the camera as measured is shown too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from evflow.baselines.voltmeter_fit import THETA, measured_constants, regressed
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.estimation.pooled import quiet_times
from evflow.estimation.refine import frame_noise, receptor_sample
from evflow.estimation.refine.stretches import INTERVALS
from evflow.estimation.result import CameraEstimate
from evflow.metrics.space_time import space_time_r
from evflow.metrics.streams import compare
from evflow.recordings.region import outside
from evflow.recordings.windows import iter_windows
from evflow.report.page import Panel, number, paragraph, table
from evflow.report.resimulate import LEARNT_SECONDS, Trial, usable_runs
from evflow.report.running import running
from evflow.simulator import simulate
from evflow.simulator.interpolate import upsample
from evflow.simulator.photoreceptor import IDEAL, Photoreceptor, as_measured, seen_frames
from evflow.types import Events, Recording

Array = np.ndarray
Run = tuple[int, int]  # first and last frame
Pixels = Callable[[Array], tuple[Camera, SensorModel]]  # given thresholds (2,), ON and OFF

LEARNT, TRIED = 4, 5  # maximum frame intervals of each half, the busiest ones
TRIES = 4  # simulations of the first half to scale thresholds
CLOSE = 0.02  # distances that differ by less count as equal
DARKEST = 0.255  # DN: ESIM's log(L / 255 + .001)
LABELS = {"measured": "the camera as measured", "v2e": "v2e", "esim": "ESIM",
          "voltmeter": "DVS-Voltmeter"}


@dataclasses.dataclass(frozen=True)
class Tried:
    """name: from LABELS; constants: its best; undetermined: those that the recording
    leaves open; numbers: "counts_r" and "space_time_r", recorded against simulated, and the same
    for two simulations, "counts_ceiling" and "space_time_ceiling"; "intervals" (in decades);
    "events_on" and "events_off" (simulated over recorded); distance: from `distance`."""

    name: str
    constants: dict[str, float]
    undetermined: tuple[str, ...]
    numbers: dict[str, float | None]
    distance: float


@dataclasses.dataclass(frozen=True, eq=False)
class Film:
    """Frames (T, H, W) in DN, interpolated by optical flow, at times_us (T,); real: what was
    recorded in that span, which begins a frame later if there is room; hot: (H, W) bool, pixels
    whose events are left out, here and of simulations."""

    frames: Array
    times_us: Array
    real: Events
    span_us: tuple[int, int]
    hot: Array

    @staticmethod
    def of(recording: Recording, run: Run, most: int, hot: Array) -> Film:
        """The busiest frame intervals of a run, at most `most`."""
        times = recording.frame_times
        before = np.searchsorted(recording.events.t, times)
        n = min(most, run[1] - run[0])
        starts = np.arange(run[0], run[1] - n + 1)
        first = int(starts[np.argmax(before[starts + n] - before[starts])])
        pairs = ((recording.frame_dn(i), int(times[i])) for i in range(first, first + n + 1))
        frames, instants = zip(
            *upsample(pairs, exposure_us=recording.exposure_us), strict=True)
        span = int(times[first + (n > 1)]), int(times[first + n])
        return Film(np.stack([np.asarray(f, np.float32) for f in frames]), np.array(instants),
                    outside(recording.events.slice(*span), hot), span, hot)

    def simulated(
        self, key: jax.Array, camera: Camera, model: SensorModel, seen_by: Photoreceptor = IDEAL
    ) -> Events:
        """Events of a running camera in the span."""
        pairs = zip(self.frames, self.times_us.tolist(), strict=True)
        added = {"voltmeter": model.voltmeter.k2, "esim": DARKEST}.get(model.kind, 0.0)
        k_memory, k_events = jax.random.split(key)
        frames, times = zip(
            *running(k_memory, seen_frames(pairs, seen_by), camera, added), strict=True)
        events = simulate(k_events, np.stack(frames), np.array(times), camera, model=model,
                          full_scale=255)
        return outside(events.slice(*self.span_us), self.hot)


def which_simulator(
    recording: Recording, found: CameraEstimate, first: Run, second: Run, seed: int = 0
) -> tuple[Tried, ...]:
    """The pixels on frames of the second run, the nearest first. found: the estimate of the first
    run. Raises EV017 if too little happens."""
    run = tuple(range(*first))
    noise_dn = frame_noise([(recording, i) for i in run])
    data = receptor_sample([(recording, run[k:k + INTERVALS])
                            for k in range(0, len(run), INTERVALS)], noise_dn)
    learnt, tried = (Film.of(recording, run, most, found.hot)
                     for run, most in ((first, LEARNT), (second, TRIED)))
    if data is None or not len(learnt.real) or not len(tried.real):
        raise EvflowDataError("EV017", "too little happens to distinguish simulators.",
                              "Record more motion.")
    key, shape = jax.random.key(seed), found.n_events.shape
    seen_by, own = as_measured(found.sensor, found.optics)

    def v2e(scale: Array) -> tuple[Camera, SensorModel]:
        camera = dataclasses.replace(
            found.camera, theta_on=found.camera.theta_on * np.float32(scale[0]),
            theta_off=found.camera.theta_off * np.float32(scale[1]))
        return camera, dataclasses.replace(own, dead_contrast="keeps")

    def esim(theta: Array) -> tuple[Camera, SensorModel]:
        return _even(shape, theta), SensorModel(kind="esim", refractory_s=own.refractory_s)

    constants = measured_constants(data, quiet_light(recording, first, found))

    def voltmeter(theta: Array) -> tuple[Camera, SensorModel]:
        fitted = dataclasses.replace(constants.voltmeter, k1=1.0 / float(theta[0]))
        return _even(shape, theta), SensorModel(kind="voltmeter", voltmeter=fitted)

    scale = matched(key, np.ones(2), v2e, learnt, seen_by)
    theta = matched(key, regressed(data, DARKEST, tied=False)[0], esim, learnt)
    level = matched(key, np.full(2, 1.0 / constants.voltmeter.k1), voltmeter, learnt, tied=True)
    circuit = voltmeter(level)[1].voltmeter
    rows = (("measured", (found.camera, own), seen_by, _constants(found, np.ones(2)), ()),
            ("v2e", v2e(scale), seen_by, _constants(found, scale), ()),
            ("esim", esim(theta), IDEAL,
             {"theta_on": theta[0], "theta_off": theta[1], "refractory_s": own.refractory_s}, ()),
            ("voltmeter", voltmeter(level), IDEAL, dataclasses.asdict(circuit),
             constants.undetermined))
    made = []
    for name, (camera, model), sight, values, undetermined in rows:
        numbers = likeness(tried, *(tried.simulated(k, camera, model, sight)
                                    for k in jax.random.split(key)))
        made.append(Tried(name, {k: float(v) for k, v in values.items()}, undetermined, numbers,
                          distance(numbers)))
    return tuple(sorted(made, key=lambda one: one.distance))


def try_simulators(
    recording: Recording, half: CameraEstimate | None, held: Trial | None, seed: int = 0
) -> tuple[tuple[Tried, ...], str]:
    """`which_simulator` on a report's held-out half: the estimate of the first half, and the frames
    it was tested on; or why not."""
    if half is None or held is None:
        return (), "there is no second half to test them on."
    times, end = recording.frame_times, held.frames[0]
    runs = [(a, min(b, end)) for a, b in usable_runs(recording) if a < end]
    first, last = max(runs, key=lambda run: run[1] - run[0])
    late = int(np.searchsorted(times, times[last] - LEARNT_SECONDS * 1e6))
    try:
        return which_simulator(recording, half, (max(first, late), last), held.frames, seed), ""
    except EvflowDataError as error:
        return (), error.seen


def _even(shape: tuple[int, ...], theta: Array) -> Camera:
    """Identical pixels, without noise of their own."""
    return Camera.constant(shape, theta_on=float(theta[0]), theta_off=float(theta[1]), eta_on=0.0,
                           eta_off=0.0)


def _constants(found: CameraEstimate, scale: Array) -> dict[str, float]:
    """The constants of a camera's pixel, with its thresholds scaled."""
    return {"theta_on": float(found.summary.theta_on) * float(scale[0]),
            "theta_off": float(found.summary.theta_off) * float(scale[1]),
            "sigma_on": float(found.summary.sigma_on), "sigma_off": float(found.summary.sigma_off),
            "eta_on": float(found.summary.eta_on), "eta_off": float(found.summary.eta_off),
            "cutoff_hz": found.sensor.cutoff_hz, "refractory_s": found.sensor.refractory_s,
            "offset_dn": found.optics.offset_dn, "delay_s": found.optics.delay_s}


def quiet_light(recording: Recording, run: Run, found: CameraEstimate) -> Array:
    """(2, 3, LIGHTS), of `by_light`, of the windows between the frames of a run."""
    begin, end = (int(recording.frame_times[i]) for i in run)
    part = dataclasses.replace(
        recording, events=recording.events.slice(begin, end), notes=(),
        frames=recording.frames[run[0]:run[1] + 1],
        frame_times=recording.frame_times[run[0]:run[1] + 1])
    return quiet_times(iter_windows(part), found.summary, found.hot, IDEAL).light


def matched(
    key: jax.Array, theta: Array, pixels: Pixels, film: Film, seen_by: Photoreceptor = IDEAL, *,
    tied: bool = False,
) -> Array:
    """theta (2,) at which as many events are simulated as were recorded: secant steps in the logs
    of both, with slope -1 at first. tied: the same for both polarities."""
    def counts(events: Events) -> Array:
        on = float(events.p.sum())
        return np.log((np.full(2, len(events)) if tied else np.array([on, len(events) - on])) + 0.5)

    logs, slope, wanted = np.log(theta), -np.ones(2), counts(film.real)
    before: tuple[Array, Array] | None = None
    best = (np.inf, theta)
    for _ in range(TRIES):
        made = counts(film.simulated(key, *pixels(np.exp(logs)), seen_by))
        best = min(best, (float(np.abs(made - wanted).sum()), np.exp(logs)), key=lambda b: b[0])
        if before is not None and (moved := np.abs(logs - before[0]) > 1e-3).any():
            step = np.where(moved, logs - before[0], 1.0)
            slope = np.where(moved, np.clip((made - before[1]) / step, -3.0, -0.3), slope)
        before = logs, made
        logs = np.clip(logs + (wanted - made) / slope, *np.log(THETA))
        if np.abs(made - wanted).max() < CLOSE:
            break
    return best[1]


def likeness(film: Film, made: Events, again: Events) -> dict[str, float | None]:
    """The `numbers` of Tried. again: of another simulation."""
    if not len(made) or not len(again):
        return {"counts_r": None, "counts_ceiling": 1.0, "space_time_r": None,
                "space_time_ceiling": 1.0, "intervals": None, "events_on": 0.0, "events_off": 0.0}
    scores = compare(film.real, made, span_us=film.span_us)
    ratio = scores["rate_hz"]["ratio"]
    maps = (e.count_map().sum(0).ravel() for e in (made, again))
    return {"counts_r": scores["counts"]["r"]["both"],
            "counts_ceiling": float(np.corrcoef(*maps)[0, 1]),
            "space_time_r": scores["space_time_r"],
            "space_time_ceiling": space_time_r(made, again, *film.span_us),
            "intervals": scores["intervals"]["wasserstein_decades"],
            "events_on": ratio["on"], "events_off": ratio["off"]}


def distance(numbers: dict[str, float | None]) -> float:
    """The mean of four: relative shortfall of r of the counts, and of r in space and time, from
    that of two simulations (noise and unknown memory reduce both); the distance of the intervals in
    decades; the mean log ratio of events. Undefined values count as nothing in common."""
    def known(name: str, worst: float) -> float:
        value = numbers[name]
        return worst if value is None else value

    apart = [min(1.0, abs(1.0 - known(f"{name}_r", 0.0) / max(known(f"{name}_ceiling", 1.0), 0.01)))
             for name in ("counts", "space_time")]
    ratio = np.mean([abs(np.log(max(known(n, 1.0), 1e-2))) for n in ("events_on", "events_off")])
    return float(np.mean([*apart, known("intervals", 1.0), ratio]))


def verdict(tried: Sequence[Tried], why_not: str = "") -> str:
    """A sentence that names the nearest; why_not: the reason if none was tested."""
    if not tried:
        return f"No simulator was tested: {why_not}"
    best = [LABELS[t.name] for t in tried if t.distance < tried[0].distance + CLOSE]
    if len(best) == 1:
        return f"Nearest to what was recorded: {best[0]}."
    return f"Equally near to what was recorded: {', '.join(best[:-1])} and {best[-1]}."


def as_dicts(tried: Sequence[Tried]) -> list[dict[str, Any]]:
    """JSON-ready values."""
    return [{**dataclasses.asdict(one), "undetermined": list(one.undetermined)} for one in tried]


def simulators_panel(tried: Sequence[Tried], why_not: str) -> Panel:
    """The table; why_not: the reason where it is empty."""
    title = "Which simulator predicts this camera best?"
    if not tried:
        return Panel("simulators", title, paragraph(f"Absent: {why_not}", "note"))
    rows = [[LABELS[t.name], *(number(t.numbers[n], 3) for n in t.numbers), number(t.distance, 3)]
            for t in tried]
    constants = [[LABELS[t.name], ", ".join(
        f"{k} {'unknown' if k in t.undetermined else format(v, '.3g')}"
        for k, v in t.constants.items())]
                 for t in tried]
    return Panel("simulators", title, paragraph(
        f"{verdict(tried)} Constants are those of the first half, thresholds scaled to its number "
        f"of events (except for the camera as measured); tested on at most {TRIED} frame intervals "
        "of the second. Ceilings compare two simulations with different noise and "
        "initial memory: the nearer to them, the better.")
        + table(["pixel", "counts r", "its ceiling", "space-time r", "its ceiling",
                 "intervals [decades]", "ON made / recorded", "OFF", "distance"], rows)
        + table(["pixel", "constants"], constants, numeric=False))
