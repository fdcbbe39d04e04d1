"""Small errors that the quick suite must notice, one at a time in a copy of the tree.

    python -m tests.mutations [--only NAME]

Each is applied and its tests run; the exit code is 0 if they pass without it and fail with it.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
COPIED = ("evflow", "tests", "experiments", "benchmarks", "docs", "pyproject.toml", "README.md")
PASSED, FAILED = 0, 1  # exit codes of pytest; others are of runs that broke


@dataclasses.dataclass(frozen=True)
class Mutation:
    """file: in evflow/; old: its text, which stands there once; tests: arguments of pytest."""

    name: str
    file: str
    old: str
    new: str
    tests: str


PIXEL, SPIKES, NOISE = "simulator/pixel.py", "simulator/spikes.py", "simulator/noise.py"
OBJECTIVE, STEP = "training/objective.py", "training/step.py"
FLOW, VOXEL, SIMULATE = "tests/network/test_flow.py", "tests/test_voxel.py", "tests/simulator/"
MUTATIONS = (
    Mutation("own instruments", "estimation/refine/frame_timing.py",
             "changes(run.around, over, delay_us).mean(1)", "changes(run.own, over, delay_us)",
             "tests/estimation/refine/test_frame_timing.py -k residuals"),
    Mutation("no arcs", "estimation/refine/between_events.py", "ARC = 3.7 ", "ARC = 0.0 ",
             "tests/estimation/refine/test_frame_timing.py -k length"),
    Mutation("log-det", "network/flow/stack.py",
             "return h, log_det + jnp.sum(s)\n", "return h, 0.99 * (log_det + jnp.sum(s))\n",
             f"{FLOW} -k jacobian"),
    Mutation("inverse", "network/flow/stack.py", "asinh.inverse(h)", "asinh.inverse(0.999 * h)",
             f"{FLOW} -k undoes"),
    Mutation("low-pass", PIXEL, "return lp + eps * (log_i - lp)",
             "return lp + 0.95 * eps * (log_i - lp)", f"{SIMULATE}test_simulate.py -k low_pass"),
    Mutation("refractory ignored", SPIKES, "    spikes = delayed(spikes, ready, dead)\n", "",
             f"{SIMULATE}test_simulate.py -k refractory"),
    Mutation("kept in a reset", SPIKES, "return rise * jnp.maximum(1.0 - at - dead, 0.0)",
             "return rise * jnp.maximum(1.0 - at, 0.0)",
             f"{SIMULATE}test_dead_contrast.py -k reset_to_reset"),
    Mutation("leak's sign", PIXEL, "left = base - due", "left = base + due",
             f"{SIMULATE}test_noise.py -k leak"),
    Mutation("eta", NOISE, "on, off = camera.eta_on, camera.eta_off\n",
             "on, off = 1.03 * camera.eta_on, 1.03 * camera.eta_off\n",
             f"{SIMULATE}test_noise.py -k eta_is_the_rate"),
    Mutation("Eq. 12", "camera/prior.py", "of.clip(4.0 / (90.0", "of.clip(4.2 / (90.0",
             "tests/camera/test_camera.py -k equation_12"),
    Mutation("theta's clamp", "camera/camera.py", "return jnp.maximum(draw, THETA_MIN)",
             "return draw", "tests/camera/test_camera.py"),
    Mutation("bins of Eq. 2", "voxel.py",
             "position = (inside.t - t0_us) * ((bins - 1) / window_us)",
             "position = (inside.t - t0_us) * (bins / window_us)", f"{VOXEL} -k equation_2"),
    Mutation("polarity", "voxel.py", "* 2 + ~inside.p)", "* 2 + inside.p)",
             f"{VOXEL} -k on_channels"),
    Mutation("beta of Eq. 6", "training/losses.py", "beta: float = 2.0", "beta: float = 1.0",
             "tests/training/test_losses.py -k condition"),
    Mutation("event loss", OBJECTIVE, "    for name, part in parts.items():\n        scale",
             "    for name, part in parts.items():\n        if name == 'event':\n"
             "            continue\n        scale", "tests/training/test_losses.py -k total"),
    Mutation("event loss without gradient", OBJECTIVE, "_event_loss(generated, block, config))",
             "_event_loss(jax.lax.stop_gradient(generated), block, config))",
             "tests/training/test_step.py -k teaches"),
    Mutation("one data key", STEP, "return jax.random.fold_in(kind, state.step)",
             "return jax.random.fold_in(kind, 0 if use == 'data' else state.step)",
             "tests/training/test_step.py -k random_numbers"),
    Mutation("optimiser lost on resume", "training/checkpoint.py",
             "                return state\n",
             "                return type(state)(state.step, state.params, state.average, "
             "like.opt_state, state.key)\n", "tests/training/test_step.py -k resume"),
    Mutation("std of the summary", "network/pooling.py", "return mean, jnp.sqrt(variance)",
             "return mean, 1.5 * jnp.sqrt(variance)", "tests/network/test_pooling.py"),
    Mutation("std without data", "network/pooling.py",
             "jnp.exp(2.0 * per_data) * scale +", "jnp.exp(2.0 * per_data) +",
             "tests/network/test_pooling.py"),
)


def run(tree: Path, tests: str) -> int:
    """pytest's exit code."""
    command, _, words = tests.partition(" -k ")
    select = ["-k", words] if words else []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tree, tree / "tests")))}
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider",
         command, *select], cwd=tree, env=environment, capture_output=True).returncode


def judged(tree: Path, mutation: Mutation, sound: dict[str, int]) -> str:
    """"caught", or what went wrong. sound: exit codes without any mutation, by tests."""
    path = tree / "evflow" / mutation.file
    text = path.read_text()
    if text.count(mutation.old) != 1:
        return f"its text stands {text.count(mutation.old)} times in {mutation.file}"
    if mutation.tests not in sound:
        sound[mutation.tests] = run(tree, mutation.tests)
    if sound[mutation.tests] != PASSED:
        return "its tests fail without it"
    path.write_text(text.replace(mutation.old, mutation.new))
    code = run(tree, mutation.tests)
    path.write_text(text)
    return {FAILED: "caught", PASSED: "SURVIVED"}.get(code, f"its tests broke ({code})")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=[m.name for m in MUTATIONS])
    only = parser.parse_args().only
    sound: dict[str, int] = {}
    verdicts = []
    with tempfile.TemporaryDirectory() as folder:
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, Path(folder) / name,
                                ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, Path(folder) / name)
        for mutation in MUTATIONS:
            if only in (None, mutation.name):
                verdicts.append(judged(Path(folder), mutation, sound))
                print(f"{mutation.name:30} {verdicts[-1]}", flush=True)
    return 0 if set(verdicts) == {"caught"} else 1


if __name__ == "__main__":
    sys.exit(main())
