"""The package as a whole: public names, documentation, imports that run downward."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import inspect
import pickle
import re
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import evflow
from evflow.errors import CODES, naming

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


def sections(doc: str) -> dict[str, str]:
    """The parts of a docstring in Google style by their titles; "" before the first."""
    parts = re.split(r"^(\w+):$", doc, flags=re.M)
    return {"": parts[0], **dict(zip(parts[1::2], parts[2::2], strict=True))}


def public_functions() -> Iterator[tuple[str, Callable]]:
    """Public functions, and the public methods of public classes, by name."""
    for name in evflow.__all__:
        found = getattr(evflow, name)
        if inspect.isfunction(found):
            yield name, found
        elif inspect.isclass(found):
            for method, _ in inspect.getmembers(found, callable):
                if not method.startswith("_") and method in vars(found):
                    yield f"{name}.{method}", getattr(found, method)


@pytest.mark.parametrize(("name", "function"), [*public_functions()])
def test_what_functions_take_give_and_refuse_is_documented(name: str, function: Callable) -> None:
    parts = sections(inspect.getdoc(function) or "")
    assert parts[""].strip()
    taken = [("**" if p.kind is p.VAR_KEYWORD else "") + p.name
             for p in inspect.signature(function).parameters.values() if p.name != "self"]
    documented = re.findall(r"^    (\**\w+): \S", parts.get("Args", ""), re.M)
    assert documented == taken
    gives = inspect.signature(function).return_annotation not in ("None", None)
    if taken or "." not in name:  # the one line of a method without arguments tells what it gives
        assert ("Returns" in parts) == gives
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    raised = {c.args[0].value for c in ast.walk(tree)
              if isinstance(c, ast.Call) and getattr(c.func, "id", "") == "EvflowDataError"
              and isinstance(c.args[0], ast.Constant)}
    named = set(re.findall(r"EV\d{3}", parts.get("Raises", "")))
    assert raised <= named <= set(CODES)
    if "Raises" in parts:
        assert parts["Raises"].strip().startswith("EvflowDataError: ")


def test_attributes_of_public_classes_are_documented() -> None:
    for name in evflow.__all__:
        found = getattr(evflow, name)
        if dataclasses.is_dataclass(found):
            named = re.findall(r"^    (\w+): \S", sections(inspect.getdoc(found) or "").get(
                "Attributes", ""), re.M)
            assert named == [field.name for field in dataclasses.fields(found)], name


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


@pytest.mark.parametrize(("where", "seen"), [(None, "b/c.txt: it is odd."), ("c", "it is odd.")])
def test_a_file_is_named_where_none_is(where: str | None, seen: str) -> None:
    with pytest.raises(evflow.EvflowDataError) as caught, naming("b"), naming(Path("b/c.txt")):
        raise evflow.EvflowDataError("EV009", "it is odd.", "Mend it.", where=where)
    assert (caught.value.seen, caught.value.where) == (seen, where or "b/c.txt")


def test_errors_pass_from_process_to_process() -> None:
    made = evflow.EvflowDataError("EV004", "seen.", "Fix it.", where=Path("a.h5"))
    error = pickle.loads(pickle.dumps(made))
    assert (error.code, error.seen, error.fix, error.where) == ("EV004", "seen.", "Fix it.", "a.h5")
    assert str(error) == "EV004 timestamps not sorted: seen. Fix it."
