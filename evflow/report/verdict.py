"""Verdicts from numbers: whether an estimate is good, how close a stream is, what to do.

The bounds are judgements, and are printed with the verdict: a stream is good within a quarter of
the rate, with at least .8 of the correlation that is possible; poor beyond twice the rate or below
half of it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np

from evflow.estimation.result import CameraEstimate
from evflow.report.page import spread
from evflow.report.resimulate import Trial

Grade = Literal["good", "fair", "poor"]
GRADES: tuple[Grade, ...] = ("good", "fair", "poor")

RATE = (1.25, 2.0)  # factor between the rates
SHAPE = (0.8, 0.5)  # count correlation, as a share of what two re-simulations reach
ERROR = (0.10, 0.30)  # std of a threshold, relative
OWN = 0.05  # share of pixels with events of their own below which maps say little
HOT = 0.01  # share of hot pixels that is worth a word
RULE = (f"Good (green): rates within a factor {RATE[0]:g}; counts of the pixels that correlate at "
        f"least {SHAPE[0]:g} times as well as those of two re-simulations; thresholds known to "
        f"{ERROR[0]:.0%}. Poor (red): beyond a factor {RATE[1]:g}, below {SHAPE[1]:g} times, above "
        f"{ERROR[1]:.0%}.")
THRESHOLD = "threshold θ"
PLACES = {
    True: "Events fall on other pixels than recorded: slower motion, or a higher frame rate, makes "
          "the frames in between truer.",
    False: "Events fall on other pixels than the real ones: another scene, a mirrored or shifted "
           "image, or frames too far apart?"}
HEADLINES = {"good": "Good enough to simulate with.", "fair": "Usable, with care.",
             "poor": "Not good enough yet."}


@dataclasses.dataclass(frozen=True)
class Judged:
    """grade of one matter; about: "ON", "OFF", or "" for both; badness: how far from ideal, to
    find the poorer one; seen: a sentence; matter and short: row and entry of the table of
    verdicts; advice: what to do, "" where nothing needs doing."""

    grade: Grade
    about: str
    badness: float
    seen: str
    matter: str = ""
    short: str = ""
    advice: str = ""


def graded(value: float, bounds: tuple[float, float]) -> Grade:
    """Small is good."""
    return GRADES[int(value > bounds[0]) + int(value > bounds[1])]


def worst(judged: list[Judged]) -> Grade:
    """The gravest grade."""
    return max((j.grade for j in judged), key=GRADES.index, default="good")


def overall(judged: list[Judged], *, tested: bool) -> Grade:
    """The worst grade; "fair" at best where the estimate could not be tested."""
    grade = worst(judged)
    return grade if tested or grade != "good" else "fair"


def poorer(judged: list[Judged]) -> str:
    """"ON" or "OFF", whichever is the further from ideal."""
    return max(("ON", "OFF"), key=lambda p: sum(j.badness for j in judged if j.about == p))


def judge_estimate(found: CameraEstimate, trial: Trial | None, held: Trial | None) -> list[Judged]:
    """Everything that bears on whether the camera can be simulated with."""
    judged = [_threshold(found, key) for key in ("on", "off")]
    for test, where in ((trial, "re-simulated"), (held, "held out")):
        if test:
            judged += [j for key in ("on", "off") for j in judge_stream(
                test.numbers, key, where, test.ceiling, _lost(test))]
    return judged + _pixels(found)


def _threshold(found: CameraEstimate, key: str) -> Judged:
    theta, std = (float(getattr(s, f"theta_{key}")) for s in (found.summary, found.summary_std))
    name = key.upper()
    if not known(found, key):
        return Judged("poor", name, 9.0, f"θ {name} is undetermined.", THRESHOLD,
                      "undetermined", "Record moving texture in good light, together with "
                      "frames: without it thresholds cannot be measured.")
    if any(note.code == f"theta_{key}.extrapolated" for note in found.notes):
        return Judged("fair", name, 1.5, f"θ {name} lies outside what the network was trained on.",
                      THRESHOLD, spread(theta, std), "A threshold outside the trained "
                      "range is an extrapolation: are the frames linear in light (--response), "
                      "and dark ones without an offset?")
    if not np.isfinite(std):
        return Judged("fair", name, 1.5, f"These weights do not estimate the error of θ {name}.",
                      THRESHOLD, spread(theta, std), "Measure with weights that estimate errors "
                      "(--weights default) to know how far to trust it.")
    error = std / theta
    grade = graded(error, ERROR)
    return Judged(grade, name, error / ERROR[0], f"θ {name} is known to {error:.0%}.",
                  THRESHOLD, spread(theta, std), "" if grade == "good" else
                  "Record longer, with more motion and texture, to know the thresholds better.")


def known(found: CameraEstimate, key: str) -> bool:
    """Whether the recording determined this polarity's threshold at all."""
    theta, std = (float(getattr(s, f"theta_{key}")) for s in (found.summary, found.summary_std))
    has_error = np.isfinite(std) or any(note.code == "std.none" for note in found.notes)
    return bool(np.isfinite(theta) and has_error and theta > 0
                and f"theta_{key}" not in found.undetermined)


def _lost(test: Trial) -> bool:
    """Whether the motion between its frames was lost somewhere."""
    return any(note.code == "frames.flow" for note in test.notes)


def judge_stream(
    numbers: dict[str, Any], key: str, where: str,
    ceiling: dict[str, float | None] | None = None, lost: bool = False,
) -> list[Judged]:
    """One polarity of a synthetic stream: how many events, and in which pixels. ceiling: r of two
    re-simulations, which r is held against; without it, 1; lost: the motion between the frames
    was."""
    name, matter = key.upper(), f"rate {where} / recorded"
    ratio = numbers["rate_hz"]["ratio"][key]
    if not any(numbers["rate_hz"][side][key] for side in ("real", "synthetic")):
        return []  # a polarity that neither has
    if not ratio:
        who = "recorded" if ratio is None else "synthetic"
        return [Judged("poor", name, 9.0, f"No {who} {name} events ({where}).", matter, "none",
                       "Was a polarity lost in a conversion? See evflow check.")]
    factor = max(ratio, 1 / ratio)
    grade = graded(factor, RATE)
    judged = [Judged(
        grade, name, float(np.log(factor) / np.log(RATE[0])),
        f"{name} has {ratio:.2f} times the recorded rate ({where}).", matter, f"{ratio:.2f} ×",
        "" if grade == "good" else _rate_advice(
            ratio, _whose(numbers, name), tested=ceiling is not None, lost=lost))]
    r, best = numbers["counts"]["r"][key], ceiling[key] if ceiling else 1.0
    if r is not None and best is not None and best > 0:
        lost = 1 - r / best
        grade = graded(lost, (1 - SHAPE[0], 1 - SHAPE[1]))
        of = f" of {best:.2f}" if ceiling else ""
        judged.append(Judged(
            grade, name, lost / (1 - SHAPE[0]), f"{name} counts of the pixels correlate with r = "
            f"{r:.2f}{of} ({where}).", f"r of the pixels' counts, {where}", f"{r:.2f}{of}",
            "" if grade == "good" else PLACES[ceiling is not None]))
    return judged


def _whose(numbers: dict[str, Any], name: str) -> str:
    """"" where both polarities have too many events, or both too few; else `name` and a space."""
    ratios = numbers["rate_hz"]["ratio"]
    alike = (min(ratios[key] or 1.0 for key in ("on", "off")) > RATE[0]
             or max(ratios[key] or 1.0 for key in ("on", "off")) < 1 / RATE[0])
    return "" if alike else f"{name} "


def _rate_advice(
    ratio: float, whose: str, *, tested: bool, lost: bool
) -> str:
    """whose: "ON ", "OFF ", or "" for both; tested: the stream is of an estimate on its own
    recording; lost: as of `judge_stream`."""
    seen = f"Too {'many' if ratio > 1 else 'few'}"
    if tested and lost:
        return (f"{seen} {whose}events are simulated, and between some frames the motion is lost "
                "(see the event rate over time): slower motion, or a higher frame rate, comes "
                "first.")
    if tested:
        return (f"{seen} {whose}events are simulated: look for motion too fast for the frames, "
                "frames with a gamma, flickering light, or clocks that are not aligned (evflow "
                "check).")
    return (f"{seen} synthetic {whose}events. If the {whose}thresholds of the simulation were "
            f"chosen, {'raise' if ratio > 1 else 'lower'} them, or measure them (evflow estimate). "
            "If they were measured on this recording, its report says what is wrong.")


def _pixels(found: CameraEstimate) -> list[Judged]:
    judged = []
    own, hot = float(found.valid.mean()), float(found.hot.mean())
    if found.windows and own < OWN:
        judged.append(Judged(
            "fair", "", 1.0, f"Only {own:.1%} of the pixels have events of their own.", advice=
            "For maps rather than the camera's medians, let motion cover the whole sensor."))
    if hot > HOT:
        judged.append(Judged(
            "fair", "", 1.0, f"{hot:.1%} of the pixels are hot.", advice=
            "Mask the hot pixels, or record brighter and cooler."))
    return judged


def sentences(judged: list[Judged]) -> list[str]:
    """What was seen, and what to do."""
    return [*(j.seen if j.seen[0] in "θη" else j.seen[0].upper() + j.seen[1:] for j in judged),
            *advice(judged)]


def advice(judged: list[Judged]) -> list[str]:
    """What to do, the gravest first, each once."""
    order = sorted(judged, key=lambda j: -GRADES.index(j.grade))
    return list(dict.fromkeys(j.advice for j in order if j.advice))
