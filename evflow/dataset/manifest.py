"""Manifests of data sets: contents, hashes, verification.

Every shard writes only its own manifest, manifests/00002-of-00004.json, so no lock is needed. A
sequence is recorded there before it is renamed into place: what is in place is recorded.
manifest.json is their union, rewritten at the end of every run. Two records of one sequence may
differ (made on different machines); the one that fits the files is used.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from evflow.dataset.sequence import EventSequence, sequence_names
from evflow.dataset.store import SUFFIXES, Format
from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_text
from evflow.files.json_text import parse_json
from evflow.files.limits import FREE, read_whole
from evflow.files.regular import need_regular
from evflow.process.provenance import sha256

Record = dict[str, Any]
Identity = dict[str, Any]
Progress = Callable[[int, int], None]

PARTS, MERGED = "manifests", "manifest.json"


def identity(config: Mapping[str, Any], seed: int, format: Format) -> Identity:
    """What identifies a data set, in the form read back from JSON."""
    return json.loads(json.dumps({"config": config, "seed": seed, "format": format}))


def place(folder: Path, name: str, format: str) -> Path:
    """Path of the sequence `name`: an .h5 file or a folder."""
    return folder / f"{name}{SUFFIXES[format]}"  # type: ignore[index]


def record(draft: Path, name: str, sequence: EventSequence) -> Record:
    """The record of a sequence that was written to `draft` and will be moved into place."""
    files = sorted(draft.iterdir()) if draft.is_dir() else [draft]
    inside = {p: f"{name}/{p.name}" if draft.is_dir() else f"{name}{p.suffix}" for p in files}
    on = int(sequence.events.p.sum())
    return {
        "files": {inside[p]: {"bytes": p.stat().st_size, "sha256": sha256(p)} for p in files},
        "events_on": on, "events_off": len(sequence.events) - on,
        "duration_s": float(sequence.frame_times[-1]) * 1e-6, "frames": len(sequence.frames),
        "nominal": sequence.nominal}


class Part:
    """The manifest of one shard, which no other process writes."""

    def __init__(
        self, folder: Path, shard: tuple[int, int], which: Identity, made_by: Mapping[str, Any]
    ) -> None:
        self.name = f"{shard[0]:05d}-of-{shard[1]:05d}"
        self._path = folder / PARTS / f"{self.name}.json"
        known = _read(self._path) if self._path.exists() else {"made_by": [], "sequences": {}}
        makers = known["made_by"]
        self._content = {"dataset": which, "sequences": known["sequences"],
                         "made_by": makers if made_by in makers else [*makers, made_by]}
        self.save()

    def add(self, name: str, entry: Record) -> None:
        self._content["sequences"][name] = entry
        self.save()

    def withdraw(self) -> None:
        """Remove it if nothing has been recorded yet."""
        if not self._content["sequences"]:
            self._path.unlink()

    def save(self) -> None:
        atomic_text(self._path, json.dumps(self._content, sort_keys=True) + "\n", overwrite=True)


@dataclasses.dataclass(frozen=True)
class Manifests:
    """All manifests of a folder: the sets they belong to (one, unless something went wrong), the
    records of each sequence, who made them, and the files that cannot be read."""

    folder: Path
    identities: list[Identity]
    claims: dict[str, list[Record]]
    made_by: list[Any]
    damaged: dict[Path, str]

    @staticmethod
    def read(folder: Path) -> Manifests:
        found = Manifests(folder, [], {}, [], {})
        for path in [*sorted((folder / PARTS).glob("*.json")), folder / MERGED]:
            try:
                content = _read(path)
            except (FileNotFoundError, NotADirectoryError):
                continue
            except EvflowDataError as e:
                found.damaged[path] = str(e)
                continue
            _join(found.identities, [content["dataset"]])
            _join(found.made_by, content["made_by"])
            for name, entry in content["sequences"].items():
                _join(found.claims.setdefault(name, []), [entry])
        return found

    def check(self, which: Identity) -> None:
        """Raise EV013 if the folder holds a set of another configuration, seed or format."""
        for there in self.identities:
            old, new = _flat(there), _flat(which)
            differ = [f"{k}: {old.get(k)} there, {new.get(k)} here"
                      for k in sorted(old.keys() | new.keys()) if old.get(k) != new.get(k)]
            if differ:
                raise EvflowDataError(
                    "EV013", f"{self.folder} holds another data set "
                    f"({'; '.join(differ[:5])}{' ...' if differ[5:] else ''}).",
                    "Continue with the same options, or choose another --out.")

    def merge(self, part: str) -> None:
        """Write manifest.json, the union; `part` identifies this process among those running."""
        names = sorted(self.claims)
        entries = {name: self.truest(name) for name in names}
        total = {"sequences": len(names), **{k: sum(e[k] for e in entries.values())
                 for k in ("events_on", "events_off", "duration_s")}}
        total["bytes"] = sum(f["bytes"] for e in entries.values() for f in e["files"].values())
        content = {"dataset": self.identities[0], "total": total, "made_by": self.made_by,
                   "sequences": entries}
        # Own drafts: two hosts may use the same process id.
        draft = self.folder / PARTS / f".{part}.{MERGED}"
        atomic_text(draft, json.dumps(content, indent=1, sort_keys=True) + "\n", overwrite=True)
        os.replace(draft, self.folder / MERGED)

    def truest(self, name: str) -> Record:
        """The record that fits the files, if there are several."""
        claims = self.claims[name]
        sound = (c for c in claims if len(claims) > 1 and not _fault(self.folder, c, deep=True))
        return next(sound, claims[-1])

    def fault(self, name: str, format: str, *, deep: bool = True) -> str | None:
        """What is wrong with a sequence, or None; compares sizes and, if `deep`, hashes."""
        where = place(self.folder, name, format)
        if not where.exists():
            return f"{where.name} is missing"
        if name not in self.claims:
            return f"{where.name} is in no manifest"
        faults = [_fault(self.folder, claim, deep=deep) for claim in self.claims[name]]
        return None if None in faults else faults[-1]


def merge(folder: Path, part: str) -> Manifests:
    """Write manifest.json with everything that any process has recorded by then.

    Another shard may end meanwhile: whoever writes last looks again, so that no earlier record is
    left out.
    """
    found = Manifests.read(folder)
    while True:
        found.merge(part)
        again = Manifests.read(folder)
        if again.claims == found.claims:
            return again
        found = again


def verify(
    folder: str | os.PathLike, shard: tuple[int, int] = (0, 1), progress: Progress | None = None
) -> dict[str, str]:
    """Read every file of a data set again; {sequence or manifest: what is wrong with it}.

    shard (i, N): only every N-th sequence, from the i-th. progress(done, total).
    Raises EV016 if there is no data set, EV009 if none of its manifests can be read.
    """
    found = Manifests.read(Path(folder))
    faults = {str(p.relative_to(folder)): why for p, why in found.damaged.items()}
    if not found.identities:
        raise EvflowDataError(
            *(("EV009", f"{folder}: {'; '.join(faults.values())}", "Make it again: --only-missing.")
              if faults else ("EV016", f"no data set in {folder} (no {MERGED}).")))
    found.check(found.identities[0])
    which = found.identities[0]
    names = sequence_names(which["config"]["train"], which["config"]["test"])[shard[0]::shard[1]]
    for name, fault in faults_of(found, names, which["format"], progress):
        if fault:
            faults[name] = fault
    return faults


def faults_of(
    found: Manifests, names: Iterable[str], format: str, progress: Progress | None = None,
    *, deep: bool = True,
) -> Iterator[tuple[str, str | None]]:
    """(name, what is wrong or None) of each sequence."""
    names = list(names)
    for done, name in enumerate(names, 1):
        yield name, found.fault(name, format, deep=deep)
        if progress:
            progress(done, len(names))


def _fault(folder: Path, entry: Record, *, deep: bool) -> str | None:
    for name, known in entry["files"].items():
        path = folder / name
        if not path.is_file():
            return f"{name} is missing"
        if (size := path.stat().st_size) != known["bytes"]:
            return f"{name} has {size:,} bytes, not {known['bytes']:,}"
        if deep and sha256(path) != known["sha256"]:
            return f"{name} is damaged (its SHA-256 differs)"
    return None


def _read(path: Path) -> dict[str, Any]:
    """One manifest; EV009 if it is truncated or not a manifest."""
    try:
        content = parse_json(read_whole(need_regular(path), FREE))
        shapes = {"dataset": dict, "sequences": dict, "made_by": list}
        if not all(isinstance(content[k], kind) for k, kind in shapes.items()):
            raise TypeError("not a manifest")
    except (ValueError, TypeError, KeyError) as e:
        raise EvflowDataError(
            "EV009", f"{path} is truncated or not a manifest ({type(e).__name__}: {e}).",
            "--only-missing removes it and makes again what no other manifest records.") from e
    return content


def _join(known: list[Any], new: Iterable[Any]) -> None:
    known += [item for item in new if item not in known]


def _flat(tree: Any, name: str = "") -> dict[str, Any]:
    """{"a": {"b": 1}} -> {"a.b": 1}."""
    if not isinstance(tree, dict):
        return {name: tree}
    return {k: v for key, part in tree.items()
            for k, v in _flat(part, f"{name}.{key}" if name else key).items()}
