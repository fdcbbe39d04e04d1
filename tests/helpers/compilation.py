"""How the tests compile: quickly and remembered, or as in use.

Compilation is most of the suite's time, and most programs run once on few pixels. They are
compiled in a third of the time: without optimisation, by XLA's older emitters. Where conftest's
`optimised` switches optimisation on, LLVM's first level does, in half the time of the highest.
EVFLOW_TESTS_OPTIMISED=1 lets the whole suite run as users compile; `as_in_use` and `precise` are
for the tests that always do.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from collections.abc import Mapping, MutableMapping
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parents[1]
OPTIMISED = "EVFLOW_TESTS_OPTIMISED"
UNOPTIMISED = "JAX_DISABLE_MOST_OPTIMIZATIONS"
# Also without source locations in the programs, and with the partitioner that compiles faster:
# nearly all programs run on one device.
SETTINGS = {UNOPTIMISED: "1", "JAX_TRACEBACK_IN_LOCATIONS_LIMIT": "0",
            "JAX_USE_SHARDY_PARTITIONER": "0"}
# Other versions of XLA may not know these flags, and end a process that is given an unknown one.
FLAGS_OF = "0.10."
FLAGS = ("--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
         "--xla_backend_optimization_level=1 --xla_llvm_disable_expensive_passes=true")

# Programs, by module, that an estimate runs dozens of times: longer than they take to compile.
OFTEN = {"evflow.estimation.refine.receptor_regression": ("_sums", "_slopes")}


def compile_quickly(environment: MutableMapping[str, str]) -> None:
    """To be called before JAX is imported."""
    if environment.get(OPTIMISED):
        return
    environment.update(SETTINGS)
    flags = environment.get("XLA_FLAGS", "")
    if importlib.metadata.version("jaxlib").startswith(FLAGS_OF) and FLAGS not in flags:
        environment["XLA_FLAGS"] = f"{flags} {FLAGS}".strip()


def quickly(environment: Mapping[str, str]) -> bool:
    """Whether `compile_quickly` has set all that it can."""
    return SETTINGS.items() <= environment.items() and FLAGS in environment.get("XLA_FLAGS", "")


def as_in_use() -> dict[str, str]:
    """The environment for a process that compiles as users do."""
    environment = {k: v for k, v in os.environ.items() if k not in SETTINGS}
    environment["XLA_FLAGS"] = environment.get("XLA_FLAGS", "").replace(FLAGS, "").strip()
    environment["PYTHONPATH"] = os.pathsep.join(map(str, (TESTS.parent, TESTS)))
    return environment


def precise() -> dict[str, Any]:
    """Compiler options for programs whose rounding is what is tested: the older emitters round
    double precision to some 4e-7."""
    return {"xla_cpu_use_fusion_emitters": True} if quickly(os.environ) else {}


def often() -> dict[str, Any]:
    """Compiler options for programs that run longer than they compile."""
    return precise() and precise() | {"xla_backend_optimization_level": 1}


def optimise_often_run() -> None:
    """Compile the programs of OFTEN with optimisation after all."""
    if quickly(os.environ):
        import jax

        for where, names in OFTEN.items():
            module = importlib.import_module(where)
            for name in names:
                plain = getattr(module, name).__wrapped__
                setattr(module, name, jax.jit(plain, compiler_options=often()))


def remember(environment: MutableMapping[str, str]) -> None:
    """Share compiled programs between workers, processes and runs, in the user's cache folder. Does
    nothing if that cannot be written; settings in the environment come first."""
    folder = Path(environment.get("XDG_CACHE_HOME") or "~/.cache") / "evflow" / "jax-tests"
    try:
        folder = folder.expanduser()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # nobody's home
        return
    if os.access(folder, os.W_OK):
        for name, value in (("COMPILATION_CACHE_DIR", str(folder)),
                            ("PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0"),
                            ("PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")):
            environment.setdefault(f"JAX_{name}", value)
