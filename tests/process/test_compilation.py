"""Compiled programs are kept where the system keeps such things, by commands alone."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from evflow import cli
from evflow.process import compilation

HOME = Path.home()


@pytest.mark.parametrize(("environ", "system", "expected"), [
    ({}, "linux", HOME / ".cache/evflow"),
    ({"XDG_CACHE_HOME": "/fast"}, "linux", Path("/fast/evflow")),
    ({"XDG_CACHE_HOME": "relative"}, "linux", HOME / ".cache/evflow"),
    ({}, "darwin", HOME / "Library/Caches/evflow"),
    ({}, "win32", HOME / "AppData/Local/evflow"),
])
def test_cache_folder(environ, system, expected):
    assert compilation.cache_folder(environ, system) == expected


@pytest.fixture
def config(monkeypatch):
    """What `remember` changes of JAX's configuration."""
    changed = {}
    monkeypatch.setattr(jax.config, "update", changed.__setitem__)
    return changed


def test_remembered_in_the_cache_folder(config, tmp_path):
    folder = compilation.remember({"XDG_CACHE_HOME": str(tmp_path)})
    assert folder == tmp_path / "evflow/programs"
    assert folder.is_dir()
    assert config["jax_compilation_cache_dir"] == str(folder)
    assert config["jax_persistent_cache_min_compile_time_secs"] == 0


@pytest.mark.parametrize("own", [
    {"JAX_COMPILATION_CACHE_DIR": "/mine"}, {"JAX_COMPILATION_CACHE_DIR": ""},
    {"JAX_ENABLE_COMPILATION_CACHE": "0"}])
def test_jax_own_variables_are_obeyed(config, tmp_path, own):
    assert compilation.remember({"XDG_CACHE_HOME": str(tmp_path), **own}) is None
    assert not config
    assert not any(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_no_matter(config, tmp_path):
    (tmp_path / "file").touch()
    assert compilation.remember({"XDG_CACHE_HOME": str(tmp_path / "file")}) is None
    (tmp_path / "evflow/programs").mkdir(parents=True)
    (tmp_path / "evflow/programs").chmod(0o500)
    if not os.access(tmp_path / "evflow/programs", os.W_OK):  # but for root
        assert compilation.remember({"XDG_CACHE_HOME": str(tmp_path)}) is None
    assert not config


@pytest.mark.parametrize(("more", "kept"), [([], True), (["--no-compile-cache"], False)])
def test_commands_that_compile_remember(monkeypatch, more, kept, capsys):
    asked = []
    monkeypatch.setattr(cli, "remember", lambda: asked.append(True))
    assert cli.main(["simulate", "absent.mp4", "-o", "absent.h5", *more]) != 0
    assert bool(asked) == kept


def test_told_when_a_program_is_compiled():
    said = []
    with compilation.announced(said.append):
        jax.jit(lambda x: x * 17.25 + 3)(jnp.ones(3))
    assert said[0]
    assert not said[-1]
    before = len(said)
    jax.jit(lambda x: x * 18.25 + 3)(jnp.ones(3))
    assert len(said) == before
