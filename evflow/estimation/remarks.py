"""Notes on an estimate: on its pixels, its thresholds, and what its pixels see."""

from __future__ import annotations

import numpy as np

from evflow.camera import Summary
from evflow.camera.optics import Optics
from evflow.estimation.refine import Found, Lost
from evflow.estimation.refine.frame_exposure import Late
from evflow.estimation.refine.frame_timing import Timing
from evflow.estimation.refine.receptor_result import OtherMap
from evflow.estimation.shot import Shot
from evflow.network.pooling import Stats
from evflow.notes import Note
from evflow.recordings.check.contents import ACTIVE_SHARE, VALID_EVENTS
from evflow.training.config import PRESETS

OPEN = 0.5  # of the stated error of theta: what is told to be open is so much of it
UNDETERMINED = 2.0  # times it: what an offset that was found may be wrong by is told
FEW_EVENTS = 200  # of a polarity: with fewer its threshold is called uncertain

BOUND_S = 3.8e-3  # delays beyond which a search is at its bound
LATE_S = 2.5e-3  # three standard deviations of frame times, a priori; up to 4 ms are looked for

UNMEASURED = Note(
    "pixels.open", "whether pixels are slow, and see other light than the frames show, was not "
    "measured: too little happens, or too much between two frames. They are taken for ideal: slow "
    "ones have lower thresholds than these. A longer recording, with slower motion or more frames "
    "per second, tells.")
LOGARITHMIC = Note(
    "pixels.log", "the pixels' response is logarithmic in dim light too, as ESIM's (log_eps), not "
    "linear below 20 DN as v2e's (linlog): the thresholds are of that.")


def camera_notes(
    stats: Stats, undetermined: tuple[str, ...], alone: tuple[str, ...], n_events: np.ndarray,
    summary: Summary, hot: np.ndarray, dead: np.ndarray, by_drift: np.ndarray,
) -> list[Note]:
    """Notes on pixels and thresholds. stats: without the events of hot pixels; undetermined, alone:
    polarities without a threshold, and measured by themselves; by_drift: of `drift_notes`."""
    found = _faulty(
        "hot", hot, "they fire while nothing moves and were left out of the refinement.")
    found += dead_notes(dead)
    low, high = PRESETS["default"].prior.theta
    for name, events, drift in (("on", stats.events_on, by_drift[0]),
                                ("off", stats.events_off, by_drift[1])):
        theta = float(getattr(summary, f"theta_{name}"))
        if name in undetermined:
            found.append(Note(
                f"theta_{name}.undetermined", f"only {int(events)} {name.upper()} events, no more "
                f"than noise{' and the drift of the light' if drift else ''}: theta_{name} is "
                "undetermined and has the prior's value"
                + "".join(f"; theta_{other} was measured by itself, less precisely"
                          for other in alone) + "."))
        elif float(events) < FEW_EVENTS:
            found.append(Note(
                f"theta_{name}.uncertain",
                f"only {int(events)} {name.upper()} events: theta_{name} is uncertain."))
        elif not low <= theta <= high:
            found.append(Note(
                f"theta_{name}.extrapolated", f"theta_{name} = {theta:.3f} lies outside the "
                f"network's training range {low}-{high}: an extrapolation. A gamma or an offset of "
                "the frames has this effect."))
    active = float((n_events >= VALID_EVENTS).mean())
    if active < ACTIVE_SHARE:
        found.append(Note(
            "pixels.unsure", f"only {active:.1%} of the pixels have {VALID_EVENTS} or more events: "
            "elsewhere the maps show the camera's summary. Record more motion."))
    return found


def dead_notes(dead: np.ndarray) -> list[Note]:
    return _faulty("dead", dead, "they never fire while those beside them do (whole columns or "
                   "rows: a region of interest?); the maps show the camera's summary there, and "
                   "their silence is left out of the noise rates.")


def _faulty(name: str, mask: np.ndarray, what: str) -> list[Note]:
    if not mask.any():
        return []
    y, x = np.argwhere(mask)[0]
    return [Note(f"pixels.{name}",
                 f"{name} pixels ({mask.sum()}, the first at x={x}, y={y}): {what}")]


def receptor_notes(
    found: Found | None, optics: Optics | None, summary: Summary, std: Summary, *, sought: bool
) -> list[Note]:
    """sought: whether a photoreceptor was looked for."""
    if found is None or optics is None:
        return [UNMEASURED] if sought else []
    notes = [Note("pixels.fast", "the photoreceptor is too fast for its cutoff to be measured: it "
                  f"is above {found.least_cutoff_hz:.0f} Hz at 255 DN, if it is proportional to "
                  "light.")]
    if found.sensor[0].cutoff_hz:
        notes = [Note("pixels.slow", "the thresholds refer to light filtered by the "
                      "photoreceptor's low-pass"
                      + ("" if found.seen.by_light else ", equally fast in dark and bright light")
                      + "; ignoring it would change them where things move fast.")]
    if found.seen.logarithmic:
        notes.append(LOGARITHMIC)
    stated = np.mean([float(std.theta_on) / float(summary.theta_on),
                      float(std.theta_off) / float(summary.theta_off)])
    open_ = np.hypot(found.offset_open.mean(), found.loss_open.mean())
    beside = np.sqrt(max(stated**2 - open_**2, 0.0))
    if found.other_map is not None and found.other_map.theta_error.mean() > OPEN * beside:
        notes.append(map_note(found.other_map, found.seen.logarithmic))
    if (due := float(found.loss_open.mean())) > OPEN * stated:
        notes.append(Note(
            "pixels.losing", "pixels may lose contrast in a dead time, which is not certain enough "
            "to be taken out: thresholds would then be lower, for which their errors include "
            f"{due:.0%}. A recording with more fast motion of clear contrast tells."))
    if abs(optics.offset_dn) > 2.0 * optics.offset_dn_std:
        more = "more" if optics.offset_dn > 0 else "less"
        notes.append(Note(
            "frames.light", f"pixels see {abs(optics.offset_dn):.0f} DN {more} light than the "
            "frames show (dark current, black level): the thresholds refer to that light. A gamma "
            "of the frames cannot be recognised in a single recording."))
        return notes
    errors, bound = (found.theta_error, UNDETERMINED) if found.needed else (found.offset_open, OPEN)
    if (due := float(errors.mean())) > bound * stated:
        notes.append(Note(
            "frames.offset", "how much more light the pixels see than the frames show is hardly "
            f"determined ({optics.offset_dn:.0f} ± {optics.offset_dn_std:.0f} DN), and by itself "
            f"changes the thresholds by {due:.0%}. Where none was found, their errors allow for "
            "one as if every second camera had it; two real DAVIS had 18 and 24 DN. A longer "
            "recording, with dark and bright areas, determines it."))
    return notes


def map_note(other: OtherMap, logarithmic: bool) -> Note:
    """logarithmic: whether the map that was taken is log_eps."""
    maps = ("lin-log, as v2e's", "logarithmic, as ESIM's")
    taken, left = maps[::-1] if logarithmic else maps
    on, off = 100.0 * (other.ratio - 1.0)
    return Note(
        "pixels.map", f"the light is too dim to tell the pixels' response: it is taken as {taken}, "
        f"and may be {left} (probability {other.chance:.0%}), with thresholds {on:+.0f} % (ON) and "
        f"{off:+.0f} % (OFF) from these, which their errors include. The two are the same in light "
        "above 20 DN: record a brighter scene.")


def timing_notes(timing: Timing, optics: Optics | None) -> list[Note]:
    exposure = timing.exposure
    if (rolling := timing.rolling).seconds:
        start = "" if rolling.first == "top" else f" --rolling-from {rolling.first}"
        return [Note(
            "frames.rolling", f"frames were read {rolling}, as by a rolling shutter: thresholds "
            "come out too high where things move, by as much as their errors now allow. To take "
            f"it out pass --rolling-ms {1e3 * rolling.seconds:.1f}{start}, or auto.")]
    found = _late_notes(timing.late, optics)
    if not exposure.seconds:
        return found
    return [*found, Note(
        "frames.exposure", "what moves is blurred in the frames, and not in the events, as by an "
        f"exposure of {1e3 * exposure.seconds:.0f} ± {1e3 * exposure.std_s:.0f} ms (frames out of "
        "focus look alike): the blur was taken out (--exposure-ms: the right one, or 0 to leave "
        "the blur).")]


def _late_notes(late: Late, optics: Optics | None) -> list[Note]:
    """On frame times that are probably wrong."""
    by, much = late.seconds, f"{1e3 * abs(late.seconds):.1f} ± {1e3 * late.std_s:.1f} ms"
    advice = f"Pass --frames-offset-ms {1e3 * by:.1f}, or auto."
    if late.exposed_s:
        advice = (f"Frames exposed for {1e3 * late.exposed_s:.0f} ms before slow pixels look "
                  "alike: pass --exposure-ms if that is so, else "
                  f"--frames-offset-ms {1e3 * by:.1f}, or auto.")
    if not by and optics is not None and abs(optics.delay_s) > LATE_S:
        by, much = optics.delay_s, f"{1e3 * abs(optics.delay_s):.1f} ms"
        much += " or more" * (abs(by) > BOUND_S)
        advice = "Pass --frames-offset-ms: auto, or a value that is known."
    return [Note(
        "frames.delay", f"events come {much} {'after' if by > 0 else 'before'} frames that show "
        "the same: frame times are probably wrong, as those of the exposure's begin or end, or of "
        "another clock. If so the cutoff is wrong too, and maps, noise rates and even thresholds "
        f"may be. {advice}")] if by else []


def lost_notes(lost: Lost | None, as_sent: Summary, summary: Summary) -> list[Note]:
    """as_sent: the summary of pixels that send all contrast."""
    if lost is None:
        return []
    how = {"keeps": "it fires later (as in v2e), but ON and OFF of one dead time cancel",
           "drops": "events that fall into it are dropped (as by ESIM)",
           "resets": "they begin anew at its end (as an amplifier that is held in reset)"}
    on, off = (100.0 * (float(getattr(as_sent, name)) / float(getattr(summary, name)) - 1.0)
               for name in ("theta_on", "theta_off"))
    return [Note(
        "pixels.lost", f"pixels lose contrast in their dead time of {1e3 * lost.dead_s:.1f} ms: "
        f"{how[lost.law]}. Taken as sent, the thresholds would be {on:.0f} % (ON) and {off:.0f} % "
        "(OFF) higher.")]


EVEN_NOISE = Note(
    "noise.even", "the noise does not fall with light as v2e's shot noise does: simulations have "
    "the same noise at any light.")
ASSUMED = Note(
    "noise.assumed", "that noise falls with light, as v2e's shot noise does, is assumed: the light "
    "on quiet pixels differs too little, or their events are too few, to show it. If it does not, "
    "there is no shot noise, and simulations of other light have too much or too little noise.")


UNLIT = Note(
    "noise.unlit", "noise falls with light, as the recordings at other illuminances show, but no "
    "frames show how bright the light on a pixel was: simulations have the first recording's noise "
    "in any light. If the camera has frames, record with them.")
UNEVEN, LEAST_ON = 3.0, 200  # times as many ON events as OFF ones, and how many


def uneven_notes(counts: np.ndarray, leak_hz: float) -> list[Note]:
    """A note where most noise (2, N) is ON, as by leak, that was not separated."""
    on, off = counts.sum(1, dtype=np.float64)
    if leak_hz or on < LEAST_ON or on < UNEVEN * off:
        return []
    return [Note("noise.on", f"{on / (on + off):.0%} of the noise is ON, as where pixels leak, but "
                 "its intervals are not regular enough, or too few, to tell: leak is not separated "
                 "from shot noise. Record for ten of its periods or more, at one temperature.")]


def noise_notes(shot: Shot) -> list[Note]:
    if shot.even:
        return [EVEN_NOISE]
    return [ASSUMED] if shot.hz and not shot.falls else []


def drift_notes(per_second: np.ndarray, by_drift: np.ndarray) -> list[Note]:
    """per_second: (2,) log units by which the light rises, and falls; by_drift: (2,) Hz of ON and
    OFF events that are not counted as noise therefore, 0 where nothing was changed."""
    return [Note(
        "noise.drift", f"the light of the whole scene {moves} by {change:.1%} a second on average "
        f"(a lamp, a cloud?): {hz:.2g} Hz per pixel of {name.upper()} events come from that and "
        f"are not counted in eta_{name}, which is of pixels whose light had hardly changed since "
        "their last event" + ("; a leak, which looks the same, is not measured." if name == "on"
                              else "."))
        for name, moves, change, hz in zip(("on", "off"), ("rises", "falls"), per_second, by_drift,
                                           strict=True) if hz]
