"""Recordings of which one polarity tells nothing: is the other's threshold, with its interval?

    python -m experiments.one_polarity --preset debug
    python -m experiments.one_polarity --preset full --workers 2

Still scenes whose brightness only rises or only falls, by a factor of 1.5 to 5; moving scenes with
OFF switched off by its threshold, or left out of the recording. Scored is the polarity that tells
something: the error of its threshold and how often the intervals hold the truth, of threshold and
noise rate. Not in the paper, whose recordings tell both.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evflow import estimate_camera, finish
from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.estimation.pipeline import pool_recording
from experiments.shared.cameras import Hidden, Protocol, draw_protocol
from experiments.shared.common import begin, run_script, write_result, write_text
from experiments.shared.many import Setup, scores
from experiments.shared.protocols import ENOUGH

CASES: dict[str, dict[str, Any]] = {
    "brighter": {}, "darker": {}, "OFF unreached": {"off": "unreached"},
    "OFF left out": {"off": "dropped"}}
FADES = (1.5, 5.0)


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure thresholds and intervals where one polarity tells nothing."""

    weights: str = "default"
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/one_polarity")
    seed: int = 7_000_003
    recordings: int | None = None
    """Recordings per case (default: the preset's)."""
    workers: int = 1


def drawn(rng: np.random.Generator, case: str) -> Protocol:
    """A protocol of the training distribution, changed into the case. Noise does not follow
    brightness: what a fade does to the rate is another question."""
    protocol = draw_protocol(rng)
    factor = float(np.exp(rng.uniform(*np.log(FADES))))
    fade = {"brighter": factor, "darker": 1 / factor}.get(case, 1.0)
    model = dataclasses.replace(protocol.model, eta_intensity=False)
    return dataclasses.replace(protocol, model=model, fade=fade, **CASES[case])


def score(params: Any, hidden: Hidden, protocol: Protocol) -> dict[str, float] | None:
    """Relative error and error in std of the polarity that tells something, whether the other is
    said to be undetermined; None where neither tells anything."""
    told = int(protocol.fade < 1)
    name, other = (("on", "off"), ("off", "on"))[told]
    if hidden.signal_events()[told] < ENOUGH:
        return None
    try:
        found = estimate_camera(hidden.recording, params)
    except EvflowDataError:
        return None
    stats, _ = pool_recording(params, hidden.recording)
    network, network_std = finish(params, stats)

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
    lines = ["| case | recordings | said to be undetermined | θ of the other: error | std | "
             "in 68 / 95 % | η: in 68 / 95 % | network alone: error of θ | in 68 / 95 % |",
             "|" + "---|" * 9]
    for case, r in results.items():
        lines.append(
            f"| {case} | {r['recordings']} | {r['said']:.0%} | {r['error']:.1%} | {r['std']:.1%} | "
            f"{r['theta in 68']:.0%} / {r['theta in 95']:.0%} | "
            f"{r['eta in 68']:.0%} / {r['eta in 95']:.0%} | {r['network error']:.1%} | "
            f"{r['network theta in 68']:.0%} / {r['network theta in 95']:.0%} |")
    return "\n".join(lines)


def main(options: Options) -> dict[str, dict[str, float]]:
    begin(options, "one_polarity")
    count = options.recordings or {"debug": 3, "full": 100}[options.preset]
    setup = Setup(options.weights, options.seed)
    results = {}
    for case in CASES:
        jobs = [(i, drawn(np.random.default_rng((options.seed, i)), case)) for i in range(count)]
        rows = [r for r in scores(score, setup, jobs, options.workers, case) if r is not None]
        if rows:
            results[case] = averages(rows)
    text = table(results)
    print(text)
    write_result(options.out / "one_polarity.json", results, dataclasses.asdict(options))
    write_text(options.out / "one_polarity.md", text)
    return results


if __name__ == "__main__":
    run_script(main, Options, __doc__)
