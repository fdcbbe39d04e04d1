"""Where results come from: the commit of a source tree, or the version; hashes."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

import pytest

import evflow
from evflow.process import provenance


def git(tree: Path, *arguments: str) -> str:
    return subprocess.run(
        ["git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments], cwd=tree, text=True,
        check=True, capture_output=True).stdout.strip()


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A source tree of one commit."""
    for name in ("pyproject.toml", "code.py"):
        (tmp_path / name).write_text("a = 1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "One")
    return tmp_path


def test_a_source_tree_is_known_by_its_commit(tree: Path) -> None:
    head = git(tree, "rev-parse", "HEAD")
    assert provenance.commit(tree) == head
    (tree / "result.json").write_text("{}")  # what git does not know is no change of the source
    assert provenance.commit(tree) == head
    (tree / "code.py").write_text("a = 2\n")
    assert provenance.commit(tree) == f"{head}+dirty"


def test_a_package_inside_anothers_tree_has_no_commit(tree: Path) -> None:
    (tree / "venv").mkdir()
    assert provenance.commit(tree / "venv") == ""
    (tree / "pyproject.toml").unlink()  # a git tree that is no source tree
    assert provenance.commit(tree) == ""


def test_without_git_there_is_no_commit(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert provenance.commit(tree) == ""


def test_without_a_source_tree_the_version_tells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evflow, "__file__", str(tmp_path / "evflow/__init__.py"))
    provenance.source.cache_clear()
    try:
        assert provenance.source() == evflow.__version__
    finally:
        provenance.source.cache_clear()


def test_all_is_told_in_one_line() -> None:
    known, line = provenance.provenance(), provenance.one_line()
    assert known.keys() == {"evflow", "source", "versions", "machine"}
    assert {"python", "jax", "numpy", "scikit-image"} <= known["versions"].keys()
    for said in (known["source"], *known["versions"].values(), known["machine"]["device"]):
        assert said in line
    assert "\n" not in line


def test_hashes_are_of_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"one")
    assert provenance.sha256(tmp_path / "a") == hashlib.sha256(b"one").hexdigest()
    before = provenance.sha256(tmp_path)
    (tmp_path / "a").rename(tmp_path / "b")
    assert provenance.sha256(tmp_path) != before
