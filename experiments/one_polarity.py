"""Thresholds and their intervals where one polarity has no signal, for the other polarity.

    python -m experiments.one_polarity --preset debug
    python -m experiments.one_polarity --preset full --workers 2

Still scenes whose brightness only rises or only falls, by a factor of 1.5 to 5; moving scenes with
OFF switched off by its threshold, or left out of the recording. Scored is the polarity with
signal: the error of its threshold and how often the intervals hold the truth, of threshold and
noise rate. Not in the paper, whose recordings have signal of both.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from evflow import estimate_camera, finish
from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.estimation.pooled import pool_recording
from experiments.shared.cameras import Hidden, Protocol, draw_protocol
from experiments.shared.common import StudyOptions, begin, conclude, estimator, markdown, run_script
from experiments.shared.many import Setup, study
from experiments.shared.protocols import ENOUGH

CASES: dict[str, dict[str, Any]] = {"brighter": {}, "darker": {}, "OFF unreached": {
    "off": "unreached"}, "OFF left out": {"off": "dropped"}}
FADES = (1.5, 5.0)
HEADS = ("case", "recordings", "said to be undetermined", "θ of the other: error", "std",
         "in 68 / 95 %", "η: in 68 / 95 %", "network alone: error of θ", "in 68 / 95 %")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Measure thresholds and intervals where one polarity has no signal."""

    out: Path = Path("out/one_polarity")
    seed: int = 7_000_051
    recordings: int | None = None
    """Recordings per case (default: the preset's)."""


def drawn(rng: np.random.Generator, case: str) -> Protocol:
    """A protocol of the training distribution, changed into the case. Noise does not follow
    brightness: what a fade does to the rate is another question."""
    protocol = draw_protocol(rng)
    factor = float(np.exp(rng.uniform(*np.log(FADES))))
    fade = {"brighter": factor, "darker": 1 / factor}.get(case, 1.0)
    model = dataclasses.replace(protocol.model, eta_intensity=False)
    return dataclasses.replace(protocol, model=model, fade=fade, **CASES[case])


def score(params: Any, hidden: Hidden, protocol: Protocol) -> dict[str, float] | None:
    """Relative error and error in std of the polarity with signal, whether the other is
    said to be undetermined; None where neither has any."""
    seen = int(protocol.fade < 1)
    name, other = (("on", "off"), ("off", "on"))[seen]
    if hidden.signal_events()[seen] < ENOUGH:
        return None
    try:
        found = estimate_camera(hidden.recording, params)
    except EvflowDataError:
        return None
    network, network_std = finish(params, pool_recording(params, hidden.recording)[0])

    def away(guess: Summary, std: Summary, kind: str) -> float:
        true = float(getattr(hidden.nominal, f"{kind}_{name}"))
        error = float(getattr(guess, f"{kind}_{name}")) - true
        return abs(error) / float(getattr(std, f"{kind}_{name}"))

    true = float(getattr(hidden.nominal, f"theta_{name}"))
    return {
        "said": f"theta_{other}" in found.undetermined,
        "error": abs(float(getattr(found.summary, f"theta_{name}")) / true - 1),
        "network error": abs(float(getattr(network, f"theta_{name}")) / true - 1),
        "std": float(getattr(found.summary_std, f"theta_{name}")) / true,
        "theta": away(found.summary, found.summary_std, "theta"),
        "network theta": away(network, network_std, "theta"),
        "eta": away(found.summary, found.summary_std, "eta")}


def averages(rows: list[dict[str, float]]) -> dict[str, float]:
    """Medians of relative errors and stds; shares of the intervals that hold the truth."""
    columns = {k: np.array([r[k] for r in rows]) for k in rows[0]}
    result = {"recordings": len(rows), "said": float(columns["said"].mean())}
    result |= {k: float(np.median(columns[k])) for k in ("error", "network error", "std")}
    for kind in ("theta", "network theta", "eta"):
        result |= {f"{kind} in 68": float((columns[kind] < 1).mean()),
                   f"{kind} in 95": float((columns[kind] < 1.96).mean())}
    return result


def table(results: dict[str, dict[str, float]]) -> str:
    def inside(r: dict[str, float], kind: str) -> str:
        return f"{r[f'{kind} in 68']:.0%} / {r[f'{kind} in 95']:.0%}"

    return markdown(HEADS, (
        (case, f"{r['recordings']}", f"{r['said']:.0%}", f"{r['error']:.1%}", f"{r['std']:.1%}",
         inside(r, "theta"), inside(r, "eta"), f"{r['network error']:.1%}",
         inside(r, "network theta")) for case, r in results.items()))


def main(options: Options) -> dict[str, dict[str, float]]:
    begin(options, "one_polarity")
    estimator(options.weights, "summary")
    count = options.count(options.recordings, debug=3, full=100)
    setup, results = Setup(options.weights, options.seed), {}
    for case in CASES:
        cases = [drawn(np.random.default_rng((options.seed, i)), case) for i in range(count)]
        if rows := study(score, setup, cases, options.workers, case):
            results[case] = averages(rows)
    conclude(options, "one_polarity", results, table(results))
    return results


if __name__ == "__main__":
    run_script(main, Options, __doc__)
