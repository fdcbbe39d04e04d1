"""The GPU's benchmark, on a CPU: what it says of differences, errors and time; and that a CPU
agrees with itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

pytest.importorskip("tyro")

from benchmarks import accelerator, parity
from benchmarks.__main__ import Options, main
from benchmarks.harness import Case, Setting, Workload
from benchmarks.parity import CHECKS, Check, differences
from evflow.errors import EvflowDataError

QUICK = Setting(quick=True)
CPU = jax.devices("cpu")[0]


def said(*_: Any, **__: Any) -> None:
    pass


def never() -> bool:
    return False


def _computed(_: jax.Device, __: Setting) -> parity.Results:
    return {"y": np.array([1.0, -2.0]), "error": np.array([0.0, 1e-5])}


def _broken(*_: Any) -> Any:
    raise ValueError("no such thing")


SOUND = Check("sound", _computed, {"y": 1e-4}, {"error": 1e-4})
BROKEN = Check("broken", _broken, {"y": 1e-4}, {"error": 1e-4})


@pytest.mark.parametrize(("y", "error", "values", "failed"), [
    ([1.0, -2.0002], [0.0, 5e-5], [1e-4, 5e-5], [False, False]),
    ([1.0, -2.0006], [0.0, 2e-4], [3e-4, 2e-4], [True, True]),
    ([np.nan, -2.0], [0.0, np.inf], [None, None], [True, True])])
def test_differences_are_held_to_their_bounds(
    y: list[float], error: list[float], values: list[float | None], failed: list[bool]
) -> None:
    wide = Check("sound", _computed, {"y": 1.01e-4}, {"error": 1e-4})
    device = {"y": np.array(y), "error": np.array(error)}
    found = differences(wide, device, _computed(CPU, QUICK))
    assert [d.quantity for d in found] == ["y", "error"]
    assert [d.failed for d in found] == failed
    for d, value in zip(found, values, strict=True):
        assert d.value == (None if value is None else pytest.approx(value, rel=1e-3))
        assert bool(d.note) == (value is None)


def test_a_check_that_breaks_fails_and_costs_no_other() -> None:
    found = accelerator.checked((BROKEN, SOUND), CPU, QUICK, never, said)
    assert [d.failed for d in found] == [True, True, False, False]
    assert found[0].note == "ValueError: no such thing"


def test_what_has_no_time_left_is_skipped_and_says_so() -> None:
    def late() -> bool:
        return True

    found = accelerator.checked((SOUND,), CPU, QUICK, late, said)
    records = accelerator.timed(accelerator.CASES, QUICK, late, said)
    assert not any(d.failed for d in found)
    assert {d.note for d in found} == {"no time left"}
    assert {r.skipped for r in records} == {"skipped: no time left"}
    assert not any(r.failed for r in records)


@pytest.mark.parametrize("check", [SOUND, BROKEN])
def test_all_is_written_and_a_failure_is_the_exit_code(
    check: Check, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Case("voxels", "task", "evflow", lambda _: Workload(lambda: 1, lambda _: {"GB": 1.0}))
    monkeypatch.setattr(parity, "CHECKS", (check,))
    monkeypatch.setattr(accelerator, "CASES", (*accelerator.CASES[:2], work))
    out = tmp_path / "gpu.json"
    assert accelerator.main(CPU, QUICK, out) == (check is BROKEN)
    written = json.loads(out.read_text())
    assert written["run"]["backend"] == "cpu"
    assert [d["quantity"] for d in written["parity"]] == ["y", "error"]
    sgemm, copy, mine = written["speed"]
    assert sgemm["of_limit"] == {"sgemm": 1.0}
    assert mine["of_limit"] == {"copy": pytest.approx(mine["rates"]["GB"] / copy["rates"]["GB"])}


def test_no_gpu_and_options_of_cpus_are_refused(tmp_path: Path) -> None:
    for options in (Options(device="gpu", only=("train",)), Options(device="gpu", devices=2)):
        with pytest.raises(EvflowDataError, match=r"EV020.*--only or --devices"):
            main(options)
    if not any(d.platform == "gpu" for d in jax.devices()):
        with pytest.raises(EvflowDataError, match=r"EV020.*no gpu here.*cuda13"):
            main(Options(device="gpu", out=tmp_path / "gpu.json"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_a_cpu_computes_what_it_computes(check: Check) -> None:
    found = differences(check, *(check.compute(CPU, QUICK) for _ in range(2)))
    assert not any(d.failed for d in found)
    assert {d.quantity for d in found} == check.bounds.keys() | check.own.keys()
    assert all(d.value == 0 for d in found if d.quantity in check.bounds)
