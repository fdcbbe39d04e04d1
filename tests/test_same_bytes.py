"""The same keys give the same bytes: hashes of a simulation, an estimate, a training step and a
data set. Rounding differs between processors, numbers of cores and versions of XLA, so hashes are
kept for each; on another machine the test skips and says how to add it:

    python tests/test_same_bytes.py

They are compared for programs compiled quickly, as in the other tests, and, marked slow, for
programs compiled as users compile them.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from helpers.compilation import as_in_use, compile_quickly, optimise_often_run, quickly
from helpers.networks import hidden, small_config

import evflow as ef
from evflow.dataset.config import PRESETS
from evflow.dataset.generate import make_sequence
from evflow.process.chunks import cores_per_device
from evflow.scenes import make_bank
from evflow.training.step import init_state, make_run_step, optimiser

STORED = Path(__file__).parent / "data" / "same_bytes.json"
PACKAGES = ("jax", "jaxlib", "numpy", "opencv-python-headless")
QUICKLY = ", compiled quickly"
# What XLA's code depends on; the last two tell processors apart that have the same of the others.
FLAGS = ("avx2", "fma", "avx512f", "avx512_bf16", "amx_tile", "sse4a", "avx_vnni")


def machine() -> str:
    """What the rounding depends on."""
    info = Path("/proc/cpuinfo")
    flags = set(re.findall(r"\w+", info.read_text())) if info.exists() else set()
    versions = [f"{name} {importlib.metadata.version(name)}" for name in PACKAGES]
    cores = f"cores {cores_per_device()}"
    return ", ".join([platform.machine(), *(f for f in FLAGS if f in flags), cores, *versions])


def digest(arrays: Iterable[Any]) -> str:
    found = hashlib.sha256()
    for array in map(np.asarray, arrays):
        found.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:16]


def simulated() -> str:
    walk = np.random.default_rng(0).normal(0, 6, (24, 20, 28)).cumsum(0)
    frames = np.clip(128 + walk, 0, 255).astype(np.uint8)
    sensor = ef.SensorModel(cutoff_hz=200.0, refractory_s=5e-4, leak_hz=0.1, leak_jitter=0.1,
                            shot_hz=1.0, noise_resets_memory=True)
    camera = ef.Camera.sample(jax.random.key(1), (20, 28))
    events = ef.simulate(
        jax.random.key(0), frames, 5_000 * np.arange(24), camera, model=sensor)
    return digest([events.x, events.y, events.t, events.p])


def estimated() -> str:
    found = ef.estimate_camera(hidden(3)[0])
    maps = found.camera, found.std, found.summary, found.summary_std, found.valid, found.n_events
    return digest(jax.tree.leaves(maps))


def trained() -> str:
    config = small_config(steps=2, warmup=1)
    tx = optimiser(config)
    bank = make_bank(jax.random.key(0), 4, photos=False, size=64, cutout_size=32)
    # Committed, as in training/test_step.py, whose program this is.
    state = jax.device_put(init_state(config, tx, bank, "default"), jax.devices()[0])
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)  # a minute less of compilation
    try:
        state, metrics = jax.jit(make_run_step(config, tx))(state, bank)
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
    return digest(jax.tree.leaves((state.params, state.average, metrics)))


def made() -> str:
    sequence = make_sequence(PRESETS["debug"], 0, 0)
    events = sequence.events
    return digest([events.x, events.y, events.t, events.p, sequence.frames,
                   *(sequence.truth[name] for name in sorted(sequence.truth))])


MADE: dict[str, Callable[[], str]] = {
    "simulate": simulated, "estimate_camera": estimated, "train step": trained,
    "make_sequence": made}


def hashes(environment: dict[str, str], *names: str) -> dict[str, str]:
    """What a process of that environment makes."""
    done = subprocess.run([sys.executable, __file__, "--print", *names], env=environment,
                          check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def stored(name: str, kind: str) -> str:
    """The hash of `name` on this machine, or the test is skipped. kind: "" or QUICKLY."""
    known = json.loads(STORED.read_text()).get(machine() + kind, {})
    if name not in known:
        pytest.skip(f"no hash for {machine()}{kind}: python {Path(__file__).name} adds it")
    return known[name]


@pytest.mark.skipif(not quickly(os.environ), reason="the whole run compiles as in use")
@pytest.mark.parametrize("name", MADE)
def test_the_same_keys_give_the_same_bytes(name: str) -> None:
    assert MADE[name]() == stored(name, QUICKLY)


@pytest.mark.slow
@pytest.mark.parametrize("name", MADE)
def test_programs_compiled_as_in_use_give_the_same_bytes(name: str) -> None:
    expected = stored(name, "")
    assert hashes(as_in_use(), name) == {name: expected}


if __name__ == "__main__":
    if sys.argv[1:2] == ["--print"]:
        optimise_often_run()
        print(json.dumps({name: MADE[name]() for name in sys.argv[2:]}))
    else:
        quick = as_in_use()
        compile_quickly(quick)
        known = json.loads(STORED.read_text()) if STORED.exists() else {}
        known |= {machine(): hashes(as_in_use(), *MADE), machine() + QUICKLY: hashes(quick, *MADE)}
        STORED.write_text(json.dumps(known, indent=1) + "\n")
