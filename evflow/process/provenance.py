"""Where a result comes from: versions, source, machine, and hashes of files."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "scikit-image", "opencv-python-headless",
            "h5py", "matplotlib")


def provenance() -> dict[str, Any]:
    """Saved with every result: evflow's version and source (`source`), the versions of Python and
    of the installed PACKAGES, and the machine."""
    import jax

    import evflow

    installed = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    machine = {"platform": platform.platform(), "cpus": os.cpu_count(),
               "device": jax.devices()[0].device_kind}
    return {"evflow": evflow.__version__, "source": source(), "versions": installed,
            "machine": machine}


def one_line() -> str:
    """The provenance in one line, for people."""
    known = provenance()
    parts = {"evflow": known["evflow"], "source": known["source"], **known["versions"],
             "device": known["machine"]["device"], "platform": known["machine"]["platform"]}
    return ", ".join(f"{name} {value}" for name, value in parts.items())


@functools.cache
def source() -> str:
    """The git commit of the source tree that evflow runs from, with "+dirty" if tracked files were
    changed; the version if there is no such tree."""
    import evflow

    return commit(Path(evflow.__file__).resolve().parents[1]) or evflow.__version__


def commit(tree: Path) -> str:
    """The git commit of `tree`, with "+dirty" if files were changed; "" if the folder is not the
    top of a git tree (an installed package may lie within another repository)."""
    if not (tree / ".git").exists() or not (tree / "pyproject.toml").is_file():
        return ""
    try:
        asked = [subprocess.run(["git", *arguments], cwd=tree, text=True, capture_output=True,
                                check=True, timeout=60).stdout.strip()
                 for arguments in (("rev-parse", "HEAD"),
                                   ("status", "--porcelain", "--untracked-files=no"))]
    except (OSError, subprocess.SubprocessError):  # no git, or git refuses to look here
        return ""
    return asked[0] + ("+dirty" if asked[1] else "")


def sha256(path: str | os.PathLike) -> str:
    """SHA-256 of a file; for a folder, of its files' names and hashes in order."""
    path = Path(path)
    if not path.is_dir():
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    whole = hashlib.sha256()
    for part in sorted(p for p in path.rglob("*") if p.is_file()):
        whole.update(f"{part.relative_to(path).as_posix()}\0{sha256(part)}\n".encode())
    return whole.hexdigest()
