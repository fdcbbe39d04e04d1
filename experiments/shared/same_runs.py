"""Runs that continue in a folder: of the same setting and files, and with nothing left out."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from evflow.errors import EvflowDataError
from evflow.network.weights import model_card, weights_path
from evflow.training.config import as_dict
from experiments.shared.common import saved, slug, write_result
from experiments.shared.conditions import Condition, digest
from experiments.shared.see_better_settings import Setting

LPIPS_LOSS = "lpips_in_loss"


def same_setting(out: Path, task: str, weights: str, setting: Setting, lpips: bool) -> None:
    """Record the setting of the runs in `out`; EV013 where they were made by another. lpips:
    whether it is installed, which changes what video is trained by in some settings."""
    # What may grow from one command to the next: everything is trained and scored by itself.
    free = ("names", "cameras", "circuits", "seeds")
    shared = {"task": task, "weights": weights, "estimator": digest(weights_path(weights)),
              LPIPS_LOSS: lpips and setting.perceptual and task == "video"}
    wanted = shared | {k: v for k, v in as_dict(setting).items() if k not in free}
    wanted = json.loads(json.dumps(wanted))
    path = out / "setting.json"
    if path.is_file():
        before = {LPIPS_LOSS: wanted[LPIPS_LOSS]} | saved(path, "config")  # older ones: unsaid
        if before != wanted:
            differ = [k for k in wanted if before.get(k) != wanted[k]]
            raise EvflowDataError("EV013", f"{out} holds runs of another setting ({differ}).",
                                  "Choose another --out.")
        return
    write_result(path, {}, wanted)


def same_files(condition: Condition, folder: Path) -> None:
    """EV013 where the run in `folder` was trained for other files than the condition's, or scored
    on another recording. Scores that do not say what they rest on are taken for the same."""
    seen: dict[str, list[bool]] = {
        condition.label: [], **{t.name: [] for t in condition.targets}}
    weights = folder / "weights.safetensors"
    if weights.is_file():
        seen[condition.label].append(model_card(weights).get("made_from") == condition.source)
    for target in condition.targets:
        path = folder / f"{slug(target.name)}.json"
        config = saved(path, "config") if path.is_file() else {}
        for name, key, source in ((condition.label, "made_from", condition.source),
                                  (target.name, "scored_on", target.source)):
            seen[name].append(config.get(key, source) == source)
    if other := [name for name, same in seen.items() if not all(same)]:
        raise EvflowDataError("EV013", f"{folder} rests on another {other[0]}.",
                              "Give it another name, or choose another --out.")


def nothing_lost(out: Path, conditions: Iterable[Condition], seeds: int) -> None:
    """EV013 where the tables in `out` have targets, conditions or seeds that these leave out."""
    path = out / "see_better.json"
    if not path.is_file():
        return
    made = {(t.name, c.label) for c in conditions for t in c.targets}
    targets, lost = {target for target, _ in made}, set()
    for target, rows in saved(path, "result").get("targets", {}).items():
        if target not in targets:
            lost.add(target)
            continue
        lost |= {label for label in rows if (target, label) not in made}
        lost |= {f"seed {seed}" for measures in rows.values() for entry in measures.values()
                 for seed in entry["seeds"] if seed >= seeds}
    if lost:
        raise EvflowDataError(
            "EV013", f"{path} has {', '.join(sorted(lost))}, which this command leaves out.",
            "Give all --names, --targets and other conditions that it has, or another --out.")
