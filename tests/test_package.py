"""The package as a whole: public names, documentation, imports that run downward."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import pickle
from pathlib import Path

import pytest

import evflow

ROOT = Path(evflow.__file__).parent
# From the bottom up; a module may import from its own floor or below.
FLOORS = (
    ("errors",),
    ("notes",),
    ("files", "process"),
    ("checks",),
    ("types", "light"),
    ("voxel", "camera"),
    ("io", "simulator"),
    ("scenes",),
    ("network",),
    ("recordings", "dataset", "metrics"),
    ("training",),
    ("estimation",),
    ("baselines", "downstream"),
    ("report",),
    ("commands",),
    ("cli",),
    ("__main__",),
)


def floor(module: str) -> int:
    room = module.removeprefix("evflow").lstrip(".").split(".")[0]
    return next((i for i, rooms in enumerate(FLOORS) if room in rooms), -1)


@pytest.mark.parametrize("name", evflow.__all__)
def test_public_names_exist_and_are_documented(name: str) -> None:
    found = getattr(evflow, name)
    assert inspect.getdoc(found)
    # A module of that name would take its place as soon as anything imports it.
    assert importlib.util.find_spec(f"evflow.{name}") is None


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_run_downward(path: Path) -> None:
    module = ".".join(("evflow", *path.relative_to(ROOT).with_suffix("").parts))
    if module == "evflow.__init__":
        return
    here = floor(module)
    assert here >= 0, f"{module} has no floor"
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("evflow"):
            names = ([f"evflow.{a.name}" for a in node.names] if node.module == "evflow"
                     else [node.module])
        for name in names:
            if name != "evflow.__version__":
                assert floor(name) <= here, f"{module} imports {name}, which is above it"


def test_the_library_does_not_know_its_scripts() -> None:
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                assert node.module.split(".")[0] not in ("experiments", "benchmarks"), path


def test_errors_pass_from_process_to_process() -> None:
    error = pickle.loads(pickle.dumps(evflow.EvflowDataError("EV004", "seen.", "Fix it.")))
    assert (error.code, error.seen, error.fix) == ("EV004", "seen.", "Fix it.")
    assert str(error) == "EV004 timestamps not sorted: seen. Fix it."
