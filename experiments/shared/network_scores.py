"""Tables and picture of `experiments.evaluate_network`, with the figures of others beside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evflow.report import plots
from experiments.shared import gains
from experiments.shared.held_out import PRESET

SHOWN = 4  # frames of a sequence in the picture
# E2VID+ by others, conventions of `etnet`: MSE, SSIM, LPIPS; to check a run of its weights by.
E2VID_PLUS = {
    "slider_depth": (.0458, .6008, .2383), "shapes_6dof": (.0910, .7553, .1850),
    "dynamic_6dof": (.1299, .3015, .3423), "boxes_6dof": (.0373, .6248, .2362),
    "calibration": (.0291, .6550, .1829), "office_zigzag": (.0412, .4887, .2576),
    "poster_6dof": (.0698, .4624, .2233)}
FWL_SAID = ("FWL of bilinear votes at the last event of each window; of rotations at the first, as "
            "the gyroscope's flow is; of synthetic cameras rounded to the nearest pixel.")

SYNTHETIC_SAID = (f"Synthetic cameras, whatever --protocol and its like say: SSIM preset {PRESET}, "
                  "means over clips, no histogram equalised or stretched.")


def report(result: dict[str, Any], how: str) -> str:
    """Markdown: how images were scored, real video, real flow, synthetic cameras, the paper's
    figures. result: by the network's name "video", "flow" and "synthetic"."""
    lines = [how]
    video = [(name, where, r) for name, row in result.items() if row.get("video")
             for where, r in (("mean", row["video"]), *row["video"]["sequences"].items())]
    if video:
        kinds = [k for k in ("mse", "ssim", "lpips", "psnr", "log_mse") if k in video[0][2]]
        header = ("weights", "sequence", "frames", *kinds, "E2VID+ by others (etnet)")
        lines += ["", _row(*header), _row(*["---"] * len(header))]
        lines += [_row(name, where, r["frames"], *(_cell(r[k]) for k in kinds),
                       "/".join(f"{v:.4f}" for v in E2VID_PLUS.get(where, ())))
                  for name, where, r in video]
    flow = [(name, where, r) for name, row in result.items()
            for where, r in row.get("flow", {}).items()]
    if flow:
        lines += ["", FWL_SAID, "", _row(
                      "weights", "sequence", "FWL", "FWL of the reference", "events a window"),
                  _row(*["---"] * 5)]
        lines += [_row(name, where, _cell(r["fwl"]), _cell(r.get("fwl_truth")),
                       _cell(r["events_per_window"], 0)) for name, where, r in flow]
    if any(row["synthetic"] for row in result.values()):
        lines += ["", SYNTHETIC_SAID]
    for name, row in result.items():
        if row["synthetic"]:
            kinds = list(next(iter(row["synthetic"].values())))
            lines += ["", _row(name, *kinds), _row(*["---"] * (1 + len(kinds)))]
            lines += [_row(camera, *(_cell(r[k]) for k in kinds))
                      for camera, r in row["synthetic"].items()]
    seen = [task for task in ("video", "flow") if any(task in row for row in result.values())]
    lines += ["", "## The paper"]
    for task in seen:
        lines += ["", *gains.paper(task)]
    return "\n".join(lines)


def _row(*cells: Any) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _cell(value: float | None, digits: int = 4) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def picture(shown: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """Frames above what was made of the events before them."""
    figure = plots.new_figure(2.6 * SHOWN, 4.0 * len(shown))
    axes = figure.subplots(2 * len(shown), SHOWN, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for i, (name, (images, frames)) in enumerate(shown.items()):
        at = np.unique(np.linspace(0, len(frames) - 1, SHOWN).round().astype(int))
        for line, stack, title in ((2 * i, frames, "frames"), (2 * i + 1, images, name)):
            axes[line, 0].set_title(title, loc="left", fontsize=9)
            for axis, k in zip(axes[line], at, strict=False):
                axis.imshow(stack[k], cmap="gray", vmin=0, vmax=1)
    plots.save_figure(figure, path)
