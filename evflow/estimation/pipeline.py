"""Whole recordings: windows -> additive statistics -> the camera's summary -> per-pixel maps.

The windows are pooled: their `Stats` add up to the network's summary. The recording is surveyed
stretch by stretch (refine/): some are simulated, to refine the summary, and the regression
on all of them gives each pixel's thresholds. The flow is not run. Only without a path between the
frames (refine="off", or frames too small for optical flow) the flow estimates every pixel of
every window, and the windows are fused by their precision. Noise rates are those of the quiet
time, either way. A pixel that says nothing keeps the camera's summary, with a wide std.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow import io
from evflow.camera import PARAMETERS, Camera, Summary
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.estimation.dead_time import DeadTime, dead_time
from evflow.estimation.one_polarity import untold, without
from evflow.estimation.pixel_noise import pixel_rates, quiet_time, threshold_law
from evflow.estimation.refine import (
    Chunk,
    Found,
    PixelEvidence,
    find_photoreceptor,
    frame_noise,
    pixel_posterior,
    plan_runs,
    refine_summary,
    survey,
)
from evflow.estimation.result import CameraEstimate
from evflow.estimation.static import estimate_noise
from evflow.light.log_maps import lin_log
from evflow.network import api, architecture
from evflow.network.coordinates import SCALE, camera_std, per_channel, squash, unsquash_summary
from evflow.network.weights import load_weights
from evflow.notes import Note
from evflow.recordings.check.contents import ACTIVE_SHARE, VALID_EVENTS
from evflow.recordings.faulty_pixels import dead_pixels, hot_pixels
from evflow.recordings.glitches import exposed
from evflow.recordings.repeats import without_repeats
from evflow.recordings.stillness import stands_still
from evflow.recordings.windows import condensed, iter_windows, plan_windows
from evflow.simulator.photoreceptor import IDEAL, Photoreceptor
from evflow.training.config import PRESETS
from evflow.types import Recording, Window
from evflow.voxel import voxelize

Array = jax.Array
Progress = Callable[[int, int], None]

FEW_EVENTS = 200  # of a polarity: with fewer its threshold is called uncertain


def estimate_camera(
    recording_or_path: Recording | str | os.PathLike, params: api.Params | None = None, *,
    refine: Literal["auto", "off"] = "auto", pixel: Literal["measured", "ideal"] = "measured",
    min_window_us: int = 40_000, progress: Progress | None = None,
) -> CameraEstimate:
    """Measure a camera, pixel by pixel, from a recording with frames.

    Of a scene that stands still, or without frames, the noise alone is measured. What usually goes
    wrong with a recording is not looked for here: `check(recording).raise_if_failed()` before.

    Args:
        recording_or_path: events and frames on one clock, or the path of a file that holds them.
        params: of `load_weights`; None loads the released ones.
        refine: "auto" corrects the network's estimate by simulation (error of theta .022 to .011).
        pixel: "measured" looks for the photoreceptor and for what frames do not show; "ideal" takes
            pixels and frames at their word.
        min_window_us: windows run from frame to frame until at least this long, microseconds.
        progress: progress(done, total) is called after every window and stretch.

    Returns:
        The maps, their standard deviations, the camera's summary, and what to know about them.

    Raises:
        EvflowDataError: EV001 (no events), EV011 (no frames, and no scene at rest), EV012 (no
            overlap in time), EV017 (too little), EV018 (weights), EV020; also `read_recording`'s.

    Example:
        >>> ef.estimate_camera("flight.h5").save("camera.npz")
    """
    for name, value, known in (("refine", refine, ("auto", "off")),
                               ("pixel", pixel, ("measured", "ideal"))):
        if value not in known:
            raise EvflowDataError("EV020", f"{name}={value!r}.", f"Choose from {known}.")
    recording = recording_or_path
    if not isinstance(recording, Recording):
        recording = io.read_recording(recording)
    recording = without_repeats(recording)
    if not recording.has_frames or stands_still(recording):
        return estimate_noise(recording)
    params = load_weights() if params is None else params
    plan = plan_windows(recording, min_window_us)
    runs = plan_runs(recording, plan.pairs) if refine == "auto" else []
    total, done = len(plan.pairs) * (2 if runs else 3) + len(runs), 0

    def advance() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    def windows() -> Iterator[Window]:
        for window in iter_windows(recording, min_window_us, plan):
            yield window
            advance()

    noise_dn = frame_noise(recording, [i for run in runs for i in run]) if runs else 0.0
    sought = bool(runs) and pixel == "measured"
    found = find_photoreceptor(recording, runs, noise_dn) if sought else None
    seen_by = found.seen if found is not None and found.needed else IDEAL
    stats, n_events, n_shown = _pool(params, windows(), seen_by)
    summary, summary_std = api.finish(params, stats)
    surveyed = survey(recording, runs, advance, seen_by, noise_dn)
    hot, chunks = np.zeros(n_events.shape, bool), surveyed.chunks
    if runs:
        hot = hot_pixels(surveyed.quiet, float(summary.eta_on + summary.eta_off))
        chunks = [dataclasses.replace(c, bright=c.bright & ~hot) for c in chunks]
        if found is not None and not seen_by.ideal:
            summary, summary_std = _regressed(summary, summary_std, found)
        summary, summary_std = _refined(params, chunks, summary, summary_std)
        if found is not None and not seen_by.ideal:
            summary_std = _widened(summary, summary_std, found)
    unknown = untold(stats, summary)
    if unknown:
        summary, summary_std = without(unknown, chunks, summary, summary_std)
    quiet = _quiet_time(windows(), summary, hot, seen_by)
    if runs:
        camera, std = _by_regression(surveyed.evidence, summary, summary_std)
    else:
        camera, std = _by_flow(params, windows(), summary, summary_std)
    camera, std = _with_rates(camera, std, quiet, hot, summary, summary_std)
    dead = dead_pixels(n_events)
    return CameraEstimate(
        camera, std, summary, summary_std, (n_shown >= VALID_EVENTS) & ~hot, n_events, hot, dead,
        len(plan.pairs),
        (*condensed(plan.skipped), *_notes(stats, unknown, n_events, summary, hot, dead),
         *_receptor_notes(found), *(n for n in recording.notes if n.code == "frames.repeated")),
        tuple(f"theta_{name}" for name in unknown),
        **_measured(found, dead_time(recording.events)))


def _measured(found: Found | None, dead: DeadTime) -> dict[str, Any]:
    """The fields of a CameraEstimate that are not per pixel."""
    sensor, std = found.sensor if found else (SensorModel(noise_resets_memory=True), {})
    fields = {"sensor": dataclasses.replace(sensor, refractory_s=dead.seconds),
              "sensor_std": {**std, "refractory_s": dead.std_s}}
    return {**fields, "optics": found.optics} if found else fields


def _receptor_notes(found: Found | None) -> list[Note]:
    if found is None:
        return []
    notes = [Note("pixels.fast", "the photoreceptor is too fast for its cutoff to be seen: it is "
                  f"above {found.least_cutoff_hz:.0f} Hz at 255 DN.")]
    if found.sensor[0].cutoff_hz:
        notes = [Note("pixels.slow", "the thresholds are those of the light behind the "
                      "photoreceptor's low-pass; without it they come out otherwise where things "
                      "move fast.")]
    optics = found.optics
    if abs(optics.offset_dn) > 2.0 * optics.offset_dn_std:
        more = "more" if optics.offset_dn > 0 else "less"
        notes.append(Note(
            "frames.light", f"pixels see {abs(optics.offset_dn):.0f} DN {more} light than the "
            "frames show (dark current, black level): thresholds are those of that light. A gamma "
            "of the frames cannot be told from one recording."))
    return notes


def window_inputs(
    window: Window, seen_by: Photoreceptor = IDEAL
) -> tuple[ArrayLike, ArrayLike, dict[str, ArrayLike]]:
    """voxels (H, W, 32), dlogI (H, W) and conditions of one window of a recording."""
    voxels = voxelize(window.events, window.t0_us, window.t1_us - window.t0_us)
    before, after = (_log_light(f, seen_by) for f in (window.frame0, window.frame1))
    intensity, dlogI = 0.5 * (before + after), after - before
    return voxels, dlogI, {"window_s": window.window_s, "intensity": intensity}


def _log_light(frame: np.ndarray, seen_by: Photoreceptor) -> Array:
    """A frame (H, W) in log units, with the light that its pixels see beside it."""
    if not seen_by.offset_dn:
        return lin_log(frame)
    return lin_log(np.maximum(frame.astype(np.float32) + seen_by.offset_dn, 0.0))


def pool_recording(
    params: api.Params, recording: Recording, min_window_us: int = 40_000
) -> tuple[api.Stats, np.ndarray]:
    """Summed Stats of all windows, and the events (H, W) in them."""
    return _pool(params, iter_windows(recording, min_window_us))[:2]


def _pool(
    params: api.Params, windows: Iterator[Window], seen_by: Photoreceptor = IDEAL
) -> tuple[api.Stats, np.ndarray, np.ndarray]:
    """Summed Stats of what the frames show, all events (H, W), and those that the frames show."""
    total: api.Stats | None = None
    n_events = n_shown = np.zeros(())
    for window in windows:
        shown = exposed(window.frame0, window.frame1)
        stats = _shown_stats(params, window, shown, seen_by)
        counts = window.events.count_map().sum(0).astype(np.uint32)
        total = stats if total is None else total + stats
        n_events, n_shown = n_events + counts, n_shown + counts * shown
    assert total is not None  # iter_windows raises EV017 rather than yield nothing
    if n_events.any() and not n_shown.any():
        raise EvflowDataError(
            "EV017", "no event happens where the frames are neither saturated nor black.",
            "Expose the frames so that they show what moves.")
    return total, n_events.astype(np.uint32), n_shown


def _shown_stats(
    params: api.Params, window: Window, shown: np.ndarray, seen_by: Photoreceptor
) -> api.Stats:
    """Stats of the pixels that are shown (H, W). The others are replaced by random ones of them
    and the sums scaled down to their number: arrays of one shape are compiled once."""
    voxels, dlogI, given = window_inputs(window, seen_by)
    share = float(shown.mean())
    if 0 < share < 1:
        rng = np.random.default_rng(window.index)
        source = np.arange(shown.size)
        source[~shown.ravel()] = rng.choice(np.flatnonzero(shown), int((~shown).sum()))

        def filled(values: ArrayLike) -> np.ndarray:
            pixels = np.asarray(values).reshape(shown.size, -1)
            return pixels[source].reshape(np.shape(values))

        voxels, dlogI = filled(voxels), filled(dlogI)
        given["intensity"] = filled(given["intensity"])
    stats = api.summarize(params, voxels, dlogI, **given)
    return stats if share == 1 else jax.tree.map(lambda leaf: leaf * share, stats)


def _quiet_time(
    windows: Iterator[Window], summary: Summary, hot: np.ndarray, seen_by: Photoreceptor
) -> np.ndarray:
    """The `quiet_time` of all windows: (2, 2, H, W), ON and OFF, events and seconds."""
    noise = np.array([summary.eta_on, summary.eta_off])
    total = np.zeros((2, 2, *hot.shape))
    for window in windows:
        frames = window.frame0, window.frame1
        before, after = (_log_light(f, seen_by) for f in frames)
        total += quiet_time(window.events.count_map(), np.asarray(after - before),
                            exposed(*frames), hot, window.window_s, noise)
    return total


def _by_flow(
    params: api.Params, windows: Iterator[Window], summary: Summary, summary_std: Summary
) -> tuple[Camera, Camera]:
    """Product of the windows' posteriors by the flow: each is N(y, s^2) and contains the prior (the
    summary and the mismatch) once, so the prior's precision is taken off all but one. The
    summary's own error, which all pixels share, is added to the std at the end."""
    y6 = unsquash_summary(summary)[None, None]
    prior, prior_precision = y6[..., :4], architecture.base_std(y6) ** -2.0
    precision, weighted = jnp.zeros_like(prior), jnp.zeros_like(prior)
    for window in windows:
        voxels, dlogI, given = window_inputs(window)
        y, s = api.estimate_y(params, voxels, dlogI, summary=summary, **given)
        shown = exposed(window.frame0, window.frame1)
        told = jnp.maximum(s**-2.0 - prior_precision, 0.0)
        gained = jnp.where(jnp.asarray(shown)[..., None], told, 0.0)
        # A posterior mean is shrunk towards the prior; (gained) (x - prior) = s^-2 (y - prior)
        # is the window's own evidence x before shrinkage.
        weighted += jnp.where(gained > 0, s**-2.0 * (y - prior), 0.0)
        precision += gained
    total = prior_precision + precision
    y = prior + weighted / total
    relative = [getattr(summary_std, n) / getattr(summary, n) for n in PARAMETERS]
    shared = jnp.stack(relative, -1)[None, None] / per_channel(SCALE, y6)
    return squash(y), camera_std(y, jnp.sqrt(1.0 / total + shared**2))


def _with_rates(
    camera: Camera, std: Camera, quiet: np.ndarray, hot: np.ndarray, summary: Summary,
    summary_std: Summary,
) -> tuple[Camera, Camera]:
    """The maps with each pixel's noise rates from its quiet time: a window holds too little noise
    of a pixel for the network to say more than the camera's."""
    rates, errors = {}, {}
    law = threshold_law(quiet, np.stack([camera.theta_on, camera.theta_off]), hot)
    for name, (events, seconds), relative in zip(("eta_on", "eta_off"), quiet, law, strict=True):
        mean, error = (float(getattr(s, name)) for s in (summary, summary_std))
        rate, own = pixel_rates(events, seconds, mean, hot, relative)
        rates[name] = jnp.asarray(rate, jnp.float32)
        errors[name] = jnp.asarray(np.hypot(own, rate * (error / mean)), jnp.float32)
    return dataclasses.replace(camera, **rates), dataclasses.replace(std, **errors)


def _refined(
    params: api.Params, chunks: list[Chunk], summary: Summary, std: Summary
) -> tuple[Summary, Summary]:
    """The summary and its std after refinement."""
    parts = next(iter(params.values()))
    refined = refine_summary(chunks, summary, std, parts.get("fusion"), parts.get("signal"))
    return refined.summary, refined.std


def _regressed(summary: Summary, std: Summary, found: Found) -> tuple[Summary, Summary]:
    """The summary with the pooled regression's thresholds: the network knows few slow pixels."""
    (on, off), error = found.thresholds()
    on, off, error = jnp.float32(on), jnp.float32(off), jnp.float32(error)
    return (dataclasses.replace(summary, theta_on=on, theta_off=off),
            dataclasses.replace(std, theta_on=error * on, theta_off=error * off))


def _widened(summary: Summary, std: Summary, found: Found) -> Summary:
    """The std with what not knowing the photoreceptor leaves open of the thresholds."""
    on, off = found.theta_error
    return dataclasses.replace(
        std, theta_on=jnp.hypot(std.theta_on, jnp.float32(on) * summary.theta_on),
        theta_off=jnp.hypot(std.theta_off, jnp.float32(off) * summary.theta_off))


def _by_regression(
    evidence: PixelEvidence, summary: Summary, summary_std: Summary
) -> tuple[Camera, Camera]:
    """Each pixel's thresholds from its regression on the path, beside the summary's noise rates;
    the summary's own error, which all pixels share, is added to the std."""
    theta, error = pixel_posterior(evidence, summary)
    shared = (float(summary_std.theta_on), float(summary_std.theta_off))
    on, off = (jnp.sqrt(e**2 + s**2) for e, s in zip(jnp.asarray(error), shared, strict=True))
    flat = jnp.ones(theta.shape[1:])
    return (Camera(jnp.asarray(theta[0]), jnp.asarray(theta[1]), summary.eta_on * flat,
                   summary.eta_off * flat),
            Camera(on, off, summary_std.eta_on * flat, summary_std.eta_off * flat))


def _notes(
    stats: api.Stats, unknown: tuple[str, ...], n_events: np.ndarray, summary: Summary,
    hot: np.ndarray, dead: np.ndarray,
) -> list[Note]:
    found = []
    for name, mask, what in (
        ("hot", hot, "they fire while nothing moves, and were left out of the refinement."),
        ("dead", dead, "they never fire while all around them do; the maps show the camera's "
         "summary there."),
    ):
        if mask.any():
            y, x = np.argwhere(mask)[0]
            found.append(Note(
                f"pixels.{name}",
                f"{name} pixels ({mask.sum()}, the first at x={x}, y={y}): {what}"))
    low, high = PRESETS["default"].prior.theta
    for name, events in (("on", stats.events_on), ("off", stats.events_off)):
        theta = float(getattr(summary, f"theta_{name}"))
        if name in unknown:
            found.append(Note(
                f"theta_{name}.undetermined", f"only {int(events)} {name.upper()} events, as noise "
                f"sends: theta_{name} is undetermined, its value is the prior's, and the other "
                "threshold was measured alone, less precisely."))
        elif float(events) < FEW_EVENTS:
            found.append(Note(
                f"theta_{name}.uncertain",
                f"only {int(events)} {name.upper()} events: theta_{name} is uncertain."))
        elif not low <= theta <= high:
            found.append(Note(
                f"theta_{name}.extrapolated", f"theta_{name} = {theta:.3f} lies outside the "
                f"{low}-{high} that the network was trained on: an extrapolation. Frames with a "
                "gamma or an offset stretch the scale."))
    active = float((n_events >= VALID_EVENTS).mean())
    if active < ACTIVE_SHARE:
        found.append(Note(
            "pixels.unsure", f"only {active:.1%} of the pixels have {VALID_EVENTS} or more events: "
            "elsewhere the maps show the camera's summary. Record more motion."))
    return found
