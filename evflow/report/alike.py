"""Verdict on two event streams: whether they are alike, and what to do where they are not."""

from __future__ import annotations

import dataclasses
from typing import Any

from evflow.report.verdict import RATE, SHAPE, Judged, graded, judge_stream, sentences, worst

SWAPPED = -0.2  # correlation of net events below which the polarity of one is inverted
APART = (0.25, 0.6)  # Wasserstein distance of intervals, in decades
FEWEST = 100  # events of a stream below which "alike" is not said
COVERED = 0.05  # share of either stream's time, the same
RULE_STREAMS = (f"Good (green): rates within a factor {RATE[0]:g}, r of at least {SHAPE[0]:g}, "
                f"times less than {APART[0]:g} decades apart. Poor (red): beyond a factor "
                f"{RATE[1]:g}, r below {SHAPE[1]:g}, more than {APART[1]:g} decades apart. At "
                f"best fair: fewer than {FEWEST} events of one, or less than {COVERED:.0%} of "
                "the time of one.")
TIMES = {"intervals": ("Intervals between a pixel's events", "of a pixel"),
         "neighbours": ("Delays after a neighbour's event", "after a neighbour")}
ALIKE = {"good": "Alike.", "fair": "Alike in part.", "poor": "Not alike."}


def judge_streams(numbers: dict[str, Any]) -> list[Judged]:
    """Whether a synthetic stream of any origin passes for the real one."""
    judged = _enough(numbers) + [
        j for key in ("on", "off") for j in judge_stream(numbers, key, "synthetic")]
    if (net := numbers["net_r"]) is not None and net < SWAPPED:
        swapped = Judged(
            "poor", "", 9.0, "ON and OFF are swapped in one of them: net events of small areas "
            f"and times anti-correlate (r = {net:.2f}).",
            advice="Write one of them again with ON and OFF swapped (evflow convert IN OUT "
            "--polarity invert), and compare that.")
        # What else differs may follow from it: other advice would be about the wrong polarity.
        return [swapped, *(dataclasses.replace(j, advice="") for j in judged + _times(numbers))]
    return judged + _times(numbers)


def _enough(numbers: dict[str, Any]) -> list[Judged]:
    """Whether what is compared can say that the streams are alike."""
    fewest = min(numbers["events"].values())
    short = [(who, share) for who, share in (("shorter", numbers["covered"]),
                                             ("longer", numbers["covered_of_longer"]))
             if share is not None and share < COVERED]
    if fewest >= FEWEST and not short:
        return []
    by_time = short and (short[0][0] == "shorter" or fewest >= FEWEST)
    seen = (f"Only {short[0][1]:.1%} of the {short[0][0]} stream's time is compared" if by_time else
            f"One of them has {f'only {fewest}' if fewest else 'no'} event{'s' * (fewest != 1)} "
            "in this time")
    return [Judged("fair", "", 1.0, f"{seen}: too little to call them alike.", advice=
                   "Compare more of both: is one cut short, or on another clock?")]


def _times(numbers: dict[str, Any]) -> list[Judged]:
    """How events follow each other, and how many are isolated."""
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
    alone = numbers["neighbours"]["alone"]
    real, made = alone["real"], alone["synthetic"]
    if real is None or made is None:  # no events to say it of
        return judged
    gap = abs(real - made)
    # A thinner stream has fewer neighbours, without any noise.
    advice = ("Judge them again once the rates agree." if _rates_off(numbers) else
              f"{'Raise' if real > made else 'Lower'} the noise rates of the simulation, if any.")
    judged.append(Judged(
        graded(gap, (0.1, 0.3)), "", gap / 0.1, "Isolated events, of noise or sparse signal: "
        f"{real:.0%} recorded, {made:.0%} synthetic.", advice=advice if gap > 0.1 else ""))
    return judged


def _rates_off(numbers: dict[str, Any]) -> list[float]:
    """Ratios of the rates, synthetic to real, of the polarities in which they differ."""
    ratios = [numbers["rate_hz"]["ratio"][side] for side in ("on", "off")]
    return [ratio for ratio in ratios if ratio and max(ratio, 1.0 / ratio) > RATE[0]]


def _timing(numbers: dict[str, Any], kinds: list[str]) -> str:
    """One sentence on all the times that differ: what follows from the rates needs no advice of its
    own."""
    medians = {kind: numbers[kind]["median_s"] for kind in kinds}
    slower = {median["synthetic"] > median["real"] for median in medians.values()}
    how = ("otherwise" if len(slower) > 1 else "more slowly" if True in slower else "more quickly")
    seen = ", ".join(
        f"{TIMES[kind][1]} {1e3 * median['synthetic']:.2f} against {1e3 * median['real']:.2f} ms"
        for kind, median in medians.items())
    off = _rates_off(numbers)
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
