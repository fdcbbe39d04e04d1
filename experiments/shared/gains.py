"""Paired gains of `experiments.see_better`: differences between conditions with their intervals,
and their share of the oracle's gain; tables and picture, beside the paper's figures.

A difference is that of two networks of the same seed, averaged over clips; its 95 % interval is
Student's over seeds. The bootstrap resamples clips, or seeds and clips for the share.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from evflow.report import plots
from experiments.shared.conditions import DEFAULT, E2V, ORACLE, OURS, RAW, WIDE
from experiments.shared.held_out import FLOW, RISING, VIDEO
from experiments.shared.images import mean_ci

Rows = dict[str, dict[str, dict[int, np.ndarray]]]  # label, measure, seed -> (N,) clips
Result = dict[str, dict[str, dict[str, Any]]]  # label, measure -> figures
Means = dict[str, dict[str, float]]  # label, measure

RESAMPLES = 2000
SHOWN = 10  # clips in the picture of examples
REFERENCES = (DEFAULT, WIDE)
TITLES = {"ssim": "SSIM", "log_mse": "log-MSE", "mse": "MSE", "psnr": "PSNR [dB]",
          "lpips": "LPIPS", "aee": "AEE [px]", "fwl": "FWL", "fwl_truth": "FWL, true flow",
          "outlier_percent": "> 3 px [%]"}
CONSTANT = ("fwl_truth",)  # the same for every condition
# Tables V (MSE / SSIM / LPIPS), VI (FWL) on IJRR, MVSEC, EVIMO2v2, by the condition here that is
# most like it. Tables VII and IX (MSE / SSIM / LPIPS / FWL), IJRR.
TABLE_V = {
    E2V: ("Original E2V", (".117/.633/.425", ".103/.429/.583", ".010/.907/.114")),
    "s2r": ("GE (S2R)", (".057/.697/.264", ".110/.505/.538", ".011/.909/.111")),
    "eventgan": ("GE (EGAN)", (".069/.613/.325", ".109/.495/.550", ".010/.907/.115")),
    "lgan": ("GE (LGAN)", (".071/.656/.311", ".114/.491/.521", ".012/.908/.119")),
    OURS: ("GE (Ours)", (".052/.704/.266", ".085/.510/.455", ".008/.918/.105"))}
TABLE_VI = {
    RAW: ("RE", ("1.32", "1.12", "1.02")), "s2r": ("GE (S2R)", ("1.45", "1.30", "1.66")),
    "lgan": ("GE (LGAN)", ("1.49", "1.34", "1.81")),
    "eventgan": ("GE (EGAN)", ("1.43", "1.32", "1.71")),
    OURS: ("GE (Ours)", ("1.66", "1.36", "1.93"))}
ABLATIONS = {
    "8 steps": ("VII", ".093/.630/.394/1.611"), "12 steps": ("VII", ".078/.676/.323/1.626"),
    "16 steps": ("VII", ".052/.703/.266/1.663"), "20 steps": ("VII", ".075/.680/.312/1.612"),
    "24 steps": ("VII", ".079/.672/.328/1.633"), "L_P": ("IX", ".079/.665/.340/1.590"),
    "L_P + L_F + L_F'": ("IX", ".074/.674/.326/1.599"), "L_P + L_E": ("IX", ".071/.688/.305/1.610"),
    "L_P + L_F + L_F' + L_E": ("IX", ".074/.684/.313/1.620"),
    "the same, weights adapted": ("IX", ".052/.703/.266/1.663")}


def compared(rows: Rows) -> Result:
    """Every condition's means, its paired differences to default and wide, and its share of the
    oracle's gain over default where that gain is significant. Compared are the measures that both
    have: LPIPS may have been installed between two trainings."""
    result: Result = {}
    for label, measures in rows.items():
        result[label] = {}
        for name, seeds in measures.items():
            means = np.array([np.nanmean(v) for v in seeds.values()])
            entry: dict[str, Any] = {
                "mean": float(means.mean()), "seeds": list(seeds), "values": means.tolist()}
            for other in REFERENCES:
                if other != label and name in rows.get(other, {}) and name not in CONSTANT:
                    entry[f"to {other}"] = difference(seeds, rows[other][name])
            result[label][name] = entry
    for name, label in ((n, k) for k, v in result.items() for n in v):
        gain = result.get(ORACLE, {}).get(name, {}).get(f"to {DEFAULT}")
        if gain and label not in (DEFAULT, ORACLE) and better(name, gain):
            result[label][name]["share"] = share(*(
                rows[k][name] for k in (label, ORACLE, DEFAULT)))
    return result


def paired(one: dict[int, np.ndarray], *others: dict[int, np.ndarray]) -> list[np.ndarray]:
    """Each as (seeds, clips), for the seeds that all have."""
    seeds = sorted(set(one).intersection(*others))
    return [np.array([scores[s] for s in seeds]) for scores in (one, *others)]


def difference(one: dict[int, np.ndarray], other: dict[int, np.ndarray]) -> dict[str, Any] | None:
    """mean and ci: of the paired differences over seeds; clips: percentiles 2.5 and 97.5 of the
    bootstrap over clips. ci is None of a single seed; None without a pair."""
    a, b = paired(one, other)
    if not len(a):
        return None
    apart = a - b
    mean, ci = mean_ci(np.nanmean(apart, 1))
    by_clip = np.nanmean(apart, 0)
    picks = np.random.default_rng(0).integers(0, len(by_clip), (RESAMPLES, len(by_clip)))
    low, high = np.nanpercentile(np.nanmean(by_clip[picks], 1), (2.5, 97.5))
    return {"mean": mean, "ci": ci if len(a) > 1 else None, "seeds": len(a),
            "clips": [float(low), float(high)]}


def better(name: str, change: dict[str, Any]) -> bool:
    """Whether the interval of a difference lies on the better side of 0."""
    sign = 1.0 if name in RISING else -1.0
    return change["ci"] is not None and sign * change["mean"] > change["ci"]


def share(
    one: dict[int, np.ndarray], oracle: dict[int, np.ndarray], default: dict[int, np.ndarray]
) -> dict[str, Any] | None:
    """Part of the oracle's gain over default, with percentiles 2.5 and 97.5 of the bootstrap over
    seeds and clips."""
    a, best, base = paired(one, oracle, default)
    if not len(a):
        return None
    gain, most = np.nan_to_num(a - base), np.nan_to_num(best - base)
    rng = np.random.default_rng(1)
    totals = []
    for _ in range(RESAMPLES):
        pick = np.ix_(rng.integers(0, len(a), len(a)), rng.integers(0, a.shape[1], a.shape[1]))
        totals.append((gain[pick].mean(), most[pick].mean()))
    # A resample in which the oracle gains nothing has no share.
    ratios = [g / m for g, m in totals if m]
    low, high = np.percentile(ratios, (2.5, 97.5))
    return {"mean": float(gain.mean() / most.mean()), "interval": [float(low), float(high)]}


def report(
    result: dict[str, Result], task: str, cameras: Means, left: int,
    untrained: dict[str, Means] | None = None,
) -> str:
    """Markdown: a table for every target, below it what needs no network, the cameras trained on,
    the paper's tables."""
    lines = [f"{left} trainings are missing.", ""] if left else []
    for target, rows in result.items():
        lines += [f"## {target}", "", *_measures(rows, task), ""]
        if untrained:
            lines += [*_untrained(untrained[target]), ""]
    lines += ["## Cameras trained on (medians)", "", *_cameras(cameras), "", "## The paper", "",
              *paper(task, {label for rows in result.values() for label in rows})]
    return "\n".join(lines)


def _measures(rows: Result, task: str) -> list[str]:
    lines = ["| measure | condition (seeds) | mean | to default, 95 % over seeds | over clips | "
             "to wide, 95 % over seeds | share of the oracle's gain |", "|" + "---|" * 7]
    for name in VIDEO if task == "video" else FLOW:
        for label, measures in rows.items():
            if name not in measures:
                continue
            entry = measures[name]
            cells = [TITLES[name], f"{label} ({len(entry['seeds'])})", f"{entry['mean']:.4f}"]
            to_default, to_wide = (entry.get(f"to {other}") for other in REFERENCES)
            cells.append(_interval(name, to_default))
            cells.append("{:+.4f} to {:+.4f}".format(*to_default["clips"]) if to_default else "")
            cells.append(_interval(name, to_wide))
            part = entry.get("share")
            cells.append("{:.0%} ({:.0%} to {:.0%})".format(part["mean"], *part["interval"])
                         if part else "")
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def _untrained(rows: Means) -> list[str]:
    names = list(next(iter(rows.values())))
    return [f"| without a network | {' | '.join(TITLES[n] for n in names)} |",
            "|" + "---|" * (1 + len(names)),
            *(f"| {label} | {' | '.join(f'{row[n]:.4f}' for n in names)} |"
              for label, row in rows.items())]


def _interval(name: str, change: dict[str, Any] | None) -> str:
    """Bold where it lies on the better side of 0."""
    if not change:
        return ""
    if change["ci"] is None:
        return f"{change['mean']:+.4f}"
    text = f"{change['mean']:+.4f} ± {change['ci']:.4f}"
    return f"**{text}**" if better(name, change) else text


def _cameras(cameras: Means) -> list[str]:
    names = ("theta_on", "theta_off", "eta_on", "eta_off", "sigma_on", "sigma_off")
    lines = ["| condition | θ ON | θ OFF | η ON [Hz] | η OFF [Hz] | spread ON | OFF |",
             "|" + "---|" * 7]
    return lines + [f"| {label} | {' | '.join(f'{row[n]:.3f}' for n in names)} |"
                    for label, row in cameras.items()]


def paper(task: str, labels: Collection[str] = ()) -> list[str]:
    """What the paper reports, on real recordings: other scenes, other cameras, to be compared by
    order and size of the gains alone. labels: of the conditions here, named beside the paper's."""
    table, what = (TABLE_V, "MSE/SSIM/LPIPS") if task == "video" else (TABLE_VI, "FWL")
    number = "V" if task == "video" else "VI"
    rows: list[tuple[str, ...]] = [("paper", "IJRR", "MVSEC", "EVIMO2v2")]
    rows += [(name, *cells) for name, cells in table.values()]
    if labels:
        here = ("here", *(label if label in labels else "" for label in table))
        rows = [(label, *row) for label, row in zip(here, rows, strict=True)]
    head, *body = (f"| {' | '.join(row)} |" for row in rows)
    lines = [f"Table {number}, {what}:", "", head, "|" + "---|" * len(rows[0]), *body]
    ours = {label: row for label, row in ABLATIONS.items() if label in labels}
    if ours:
        lines += ["", "| here | table | MSE/SSIM/LPIPS/FWL, IJRR |", "|" + "---|" * 3]
        lines += [f"| {label} | {t} | {cells} |" for label, (t, cells) in ours.items()]
    return lines


def picture(result: dict[str, Result], path: Path) -> None:
    """Paired differences to default with their intervals; a row for every target, a panel for
    every measure; the dashed line is the oracle's. Without measures no file is written."""
    measures = [n for n in (*VIDEO, *FLOW) if n not in CONSTANT and any(
        n in m for rows in result.values() for m in rows.values())]
    if not measures:
        return
    figure = plots.new_figure(3.4 * len(measures), 1.2 + 2.2 * len(result))
    axes = figure.subplots(len(result), len(measures), squeeze=False)
    for line, (target, rows) in zip(axes, result.items(), strict=True):
        labels = [k for k in rows if k != DEFAULT][::-1]
        for axis, name in zip(line, measures, strict=True):
            for y, label in enumerate(labels):
                change = rows[label].get(name, {}).get(f"to {DEFAULT}")
                if change:
                    axis.errorbar(change["mean"], y, xerr=change["ci"] or 0.0, fmt="o",
                                  color=plots.ON_COLOUR if label == OURS else plots.OFF_COLOUR)
                    if label == ORACLE:
                        axis.axvline(change["mean"], color="0.6", ls="--", lw=0.8)
            axis.axvline(0.0, color="0.2", lw=0.8)
            axis.set_yticks(range(len(labels)), labels if axis is line[0] else [])
            axis.set_ylim(-0.6, len(labels) - 0.4)
            axis.set_xlabel(f"{TITLES[name]} ({'+' if name in RISING else '-'} is better)")
            axis.locator_params(axis="x", nbins=3)
            axis.grid(alpha=0.3)
        line[0].set_title(target)
    plots.save_figure(figure, path)


def examples(images: dict[str, np.ndarray], path: Path) -> None:
    """Images (N, H, W) by condition, a row each, of the first clips; of nothing no file."""
    if not images:
        return
    columns = min(SHOWN, len(next(iter(images.values()))))
    figure = plots.new_figure(1.4 * columns + 0.5, 1.4 * len(images))
    axes = figure.subplots(len(images), columns, squeeze=False)
    for line, (label, stack) in zip(axes, images.items(), strict=True):
        line[0].set_ylabel(textwrap.fill(label, 14))
        for axis, image in zip(line, stack, strict=False):
            axis.imshow(image, cmap="gray", vmin=0, vmax=1)
            axis.set_xticks([])
            axis.set_yticks([])
    plots.save_figure(figure, path)
