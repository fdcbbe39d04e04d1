"""Verdicts from numbers: whether an estimate is good, whether two streams agree, what to do.

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
SWAPPED = -0.2  # correlation of net events below which the polarity of one is inverted
APART = (0.25, 0.6)  # Wasserstein distance of intervals, in decades
OWN = 0.05  # share of pixels with events of their own below which maps say little
HOT = 0.01  # share of hot pixels that is worth a word
RULE = (f"Good (green): rates within a factor {RATE[0]:g}; counts of the pixels that correlate at "
        f"least {SHAPE[0]:g} times as well as those of two re-simulations; thresholds known to "
        f"{ERROR[0]:.0%}. Poor (red): beyond a factor {RATE[1]:g}, below {SHAPE[1]:g} times, above "
        f"{ERROR[1]:.0%}.")
RULE_STREAMS = (f"Good (green): rates within a factor {RATE[0]:g}, r of at least {SHAPE[0]:g}, "
                f"times less than {APART[0]:g} decades apart. Poor (red): beyond a factor "
                f"{RATE[1]:g}, r below {SHAPE[1]:g}, more than {APART[1]:g} decades apart.")
THRESHOLD = "threshold θ"
TIMES = {"intervals": ("Intervals between a pixel's events", "of a pixel"),
         "neighbours": ("Delays after a neighbour's event", "after a neighbour")}
PLACES = {
    True: "Events fall on other pixels than recorded: slower motion, or a higher frame rate, makes "
          "the frames in between truer.",
    False: "Events fall on other pixels than the real ones: another scene, a mirrored or shifted "
           "image, or frames too far apart?"}
HEADLINES = {"good": "Good enough to simulate with.", "fair": "Usable, with care.",
             "poor": "Not good enough yet."}
ALIKE = {"good": "Alike.", "fair": "Alike in part.", "poor": "Not alike."}


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


def _rate_advice(ratio: float, whose: str, *, tested: bool, lost: bool) -> str:
    """whose: "ON ", "OFF ", or "" for both; tested: the stream is of an estimate on its own
    recording; lost: the motion between its frames was."""
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


def judge_streams(numbers: dict[str, Any]) -> list[Judged]:
    """Whether a synthetic stream of any origin passes for the real one."""
    judged = [j for key in ("on", "off")
              for j in judge_stream(numbers, key, "synthetic")]
    if (net := numbers["net_r"]) is not None and net < SWAPPED:
        swapped = Judged(
            "poor", "", 9.0, "ON and OFF are swapped in one of them: net events of small areas "
            f"and times anti-correlate (r = {net:.2f}).",
            advice="Read one of them with --polarity invert, and compare again.")
        # What else differs may follow from it: other advice would be about the wrong polarity.
        return [swapped, *(dataclasses.replace(j, advice="") for j in judged + _times(numbers))]
    return judged + _times(numbers)


def _times(numbers: dict[str, Any]) -> list[Judged]:
    """How events follow each other, and how many come without company."""
    judged = []
    slow = [kind for kind in TIMES if graded(numbers[kind]["wasserstein_decades"] or 0.0, APART)
            != "good"]
    for kind, (what, _) in TIMES.items():
        apart = numbers[kind]["wasserstein_decades"]
        if apart is not None:
            judged.append(Judged(
                graded(apart, APART), "", apart / APART[0], f"{what} differ by {apart:.2f} decades "
                f"(KS {numbers[kind]['ks']:.2f}).",
                advice=_timing(numbers, slow) if kind in slow else ""))
    real, made = (numbers["neighbours"]["alone"][s] or 0.0 for s in ("real", "synthetic"))
    gap = abs(real - made)
    judged.append(Judged(
        graded(gap, (0.1, 0.3)), "", gap / 0.1, f"Events without company, mostly noise: {real:.0%} "
        f"recorded, {made:.0%} synthetic.", advice="" if gap <= 0.1 else
        f"{'Raise' if real > made else 'Lower'} the noise rates of the simulation."))
    return judged


def _timing(numbers: dict[str, Any], kinds: list[str]) -> str:
    """One sentence on all the times that differ: what follows from the rates needs no advice of its
    own."""
    medians = {kind: numbers[kind]["median_s"] for kind in kinds}
    slower = {median["synthetic"] > median["real"] for median in medians.values()}
    how = ("otherwise" if len(slower) > 1 else "more slowly" if True in slower else "more quickly")
    seen = ", ".join(
        f"{TIMES[kind][1]} {1e3 * median['synthetic']:.2f} against {1e3 * median['real']:.2f} ms"
        for kind, median in medians.items())
    ratios = [numbers["rate_hz"]["ratio"][side] for side in ("on", "off")]
    off = [ratio for ratio in ratios if ratio and max(ratio, 1.0 / ratio) > RATE[0]]
    fewer = {ratio < 1 for ratio in off}
    if len(fewer) > 1:
        return (f"Synthetic events follow each other {how} (medians: {seen}): judge times again "
                "once the rates of ON and OFF agree.")
    if off and slower == fewer:
        return (f"Synthetic events follow each other {how} (medians: {seen}), as there are too "
                f"{'few' if off[0] < 1 else 'many'}: judge times again once the rates agree.")
    return (f"Synthetic events follow each other {how} (medians: {seen}): look at the refractory "
            "period, the cutoff and the frame rate of the simulation.")


def describe_streams(numbers: dict[str, Any]) -> str:
    """A comparison in words: the verdict, what was seen, what to do; a sentence a line."""
    judged = judge_streams(numbers)
    return "\n".join([ALIKE[worst(judged)], how_compared(numbers), *sentences(judged)])


def sentences(judged: list[Judged]) -> list[str]:
    """What was seen, and what to do."""
    return [*(j.seen if j.seen[0] in "θη" else j.seen[0].upper() + j.seen[1:] for j in judged),
            *advice(judged)]


def how_compared(numbers: dict[str, Any]) -> str:
    """Over which time, on which clock, from how many events."""
    real, made = numbers["events"]["real"], numbers["events"]["synthetic"]
    words = (f"{real:,} real and {made:,} synthetic events in the {numbers['duration_s']:.3f} s "
             "that both cover.")
    if (detail := numbers["space_time_r"]) is not None:
        words += (" In cubes of 3x3 pixels and 2 ms their net events correlate with "
                  f"r = {detail:.2f}.")
    if numbers["aligned_at"] == "clock":
        return words
    return words + (" They share no time by their clocks: both were laid at their beginnings "
                    f"(synthetic moved by {numbers['shift_us'] / 1e6:+.6f} s).")


def advice(judged: list[Judged]) -> list[str]:
    """What to do, the gravest first, each once."""
    order = sorted(judged, key=lambda j: -GRADES.index(j.grade))
    return list(dict.fromkeys(j.advice for j in order if j.advice))
