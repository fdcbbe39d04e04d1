"""Making a data set: shards, workers, and resuming after any interruption.

A sequence is drafted in a hidden folder, recorded in the shard's manifest, then renamed into place:
a killed process leaves nothing that looks finished. Processes share nothing but the folder, and
each sequence depends only on (config, seed, its number), so any number of shards and workers, on
any scheduler, makes the same bytes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from evflow.dataset import manifest
from evflow.dataset.config import DatasetConfig
from evflow.dataset.generate import make_sequence
from evflow.dataset.manifest import Manifests, Part, Progress, Record
from evflow.dataset.store import Format, write_sequence
from evflow.errors import EvflowDataError
from evflow.files.atomic import put_in_place, written_aside
from evflow.process.workers import worker_pool

DRAFTS = ".drafts-"


def build(
    folder: str | os.PathLike, config: DatasetConfig, seed: int = 0, *,
    shard: tuple[int, int] = (0, 1), workers: int = 1, format: Format = "dsec",
    only_missing: bool = False, made_by: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> list[str]:
    """Make the missing sequences of shard (i, N): every N-th sequence, from the i-th.

    workers: processes on this machine. only_missing: check the shard's files too, and make again
    those that are damaged or in no manifest (otherwise an error). made_by: description of this
    machine for the manifest. progress(done, total). Returns the names of what was made; the same
    call continues after any interruption. No two processes may make one shard at a time.

    Raises EV009 (a damaged file or manifest), EV013 (another set is there), EV019 (the disk is
    full, the folder cannot be written, a worker died), EV020 (shard, workers, seed out of range).
    """
    if not 0 <= shard[0] < shard[1] or workers < 1:
        raise EvflowDataError("EV020", f"shard={shard[0]}/{shard[1]}, workers={workers}.",
                              "Shards are 0/N to N-1/N; workers are 1 or more.")
    if not -2**31 <= seed < 2**32:
        raise EvflowDataError("EV020", f"seed={seed}.", "It must fit 32 bits.")
    folder, which = Path(folder), manifest.identity(config.as_dict(), seed, format)
    found, part = _begin(folder, shard, which, made_by or {}, only_missing)
    wanted = _wanted(found, config.names[shard[0]::shard[1]], format, only_missing, progress)
    numbers = {name: number for number, name in enumerate(config.names)}
    with _drafting(folder, part) as drafts:
        jobs = [Job(name, numbers[name], config, seed, format, drafts) for name in wanted]
        with contextlib.closing(_drafts(jobs, workers)) as made:
            for done, (name, draft, entry) in enumerate(made, 1):
                part.add(name, entry)
                _commit(draft, manifest.place(folder, name, format))
                if progress:
                    progress(done, len(jobs))
    found = manifest.merge(folder, part.name)
    if not any(f for _, f in manifest.faults_of(found, config.names, format, deep=False)):
        _remove_drafts(folder, "*")  # of killed processes
    return wanted


@dataclasses.dataclass(frozen=True)
class Job:
    """A sequence to make."""

    name: str
    number: int
    config: DatasetConfig
    seed: int
    format: Format
    drafts: Path


def _begin(
    folder: Path, shard: tuple[int, int], which: manifest.Identity, made_by: Mapping[str, Any],
    repair: bool,
) -> tuple[Manifests, Part]:
    """The manifests already there, and this shard's own."""
    _checked(folder, which, repair=repair)
    part = Part(folder, shard, which, made_by)
    try:  # again: if two sets are begun at once, one sees the other
        return _checked(folder, which), part
    except EvflowDataError:
        part.withdraw()
        raise


@contextlib.contextmanager
def _drafting(folder: Path, part: Part) -> Iterator[Path]:
    """A hidden empty folder for this shard alone, removed in the end."""
    _remove_drafts(folder, part.name)
    try:
        yield folder / f"{DRAFTS}{part.name}"
    finally:
        _remove_drafts(folder, part.name)


def _remove_drafts(folder: Path, part: str) -> None:
    for drafts in folder.glob(f"{DRAFTS}{part}"):
        shutil.rmtree(drafts, ignore_errors=True)


def _checked(folder: Path, which: manifest.Identity, *, repair: bool = False) -> Manifests:
    """The folder's manifests, which must be of this data set; damaged ones are removed for repair,
    else EV009."""
    found = Manifests.read(folder)
    found.check(which)
    for path, why in found.damaged.items():
        if not repair:
            raise EvflowDataError("EV009", why)
        path.unlink()
    return found


def _wanted(
    found: Manifests, names: tuple[str, ...], format: Format, repair: bool,
    progress: Progress | None,
) -> list[str]:
    """The sequences to make; EV009, EV013 for one that is faulty and not to be repaired."""
    wanted = []
    checked = manifest.faults_of(found, names, format, progress if repair else None, deep=repair)
    for name, fault in checked:
        where = manifest.place(found.folder, name, format)
        if fault and not repair and where.exists():
            code = "EV009" if name in found.claims else "EV013"
            raise EvflowDataError(code, f"{where}: {fault}.", "--only-missing makes it again.")
        if fault:
            wanted.append(name)
    return wanted


def _commit(draft: Path, final: Path) -> None:
    """Rename a draft into place, over any damaged sequence."""
    with written_aside(final, put_in_place, overwrite=True) as temporary:
        if final.is_dir():
            shutil.rmtree(final)
        os.replace(draft, temporary)


Made = tuple[str, Path, Record]


def _draft(job: Job) -> Made:
    sequence = make_sequence(job.config, job.seed, job.number)
    draft = manifest.place(job.drafts, job.name, job.format)
    write_sequence(draft, sequence, job.format)
    return job.name, draft, manifest.record(draft, job.name, sequence)


def _drafts(jobs: list[Job], workers: int) -> Generator[Made]:
    """All drafts, in order."""
    if workers == 1 or len(jobs) < 2:
        yield from map(_draft, jobs)
        return
    try:
        with worker_pool(min(workers, len(jobs))) as pool:
            yield from pool.map(_draft, jobs)
    except BrokenProcessPool as e:
        raise EvflowDataError(
            "EV019", "a worker process died (out of memory?).",
            "The same command continues; fewer --workers need less memory.") from e
