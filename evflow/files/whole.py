"""Check that a written file is complete before it gets its name: errors that a library swallowed
and truncated ends show in sizes and tables of contents. Large data are not read again."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

from evflow.errors import EvflowDataError


def not_whole(path: Path, what: str) -> EvflowDataError:
    """EV019 for a file that differs from what was written."""
    return EvflowDataError("EV019", f"{path} was not written completely: {what}.",
                           "It was not kept. Is the disk failing? Write it again.", where=path)


def need_size(path: Path, size: int) -> None:
    """Raise EV019 unless the file has `size` bytes."""
    if (found := os.path.getsize(path)) != size:
        raise not_whole(path, f"it has {found:,} bytes of {size:,}")


def write_checked(path: Path, data: str | bytes) -> None:
    """Write text (UTF-8, except for undecodable file names in it) or bytes and read them back;
    EV019 if they differ."""
    data = data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data
    path.write_bytes(data)
    if path.read_bytes() != data:
        raise not_whole(path, "its content differs")


def need_members(path: Path, sizes: Mapping[str, int | None]) -> None:
    """Raise EV019 unless a zip holds exactly these files, of these sizes (None: any), without gaps
    between them."""
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            for info in infos:
                archive.open(info).close()  # checks that its own header is there with its name
            begins = [*sorted(info.header_offset for info in infos), archive.start_dir]
    except (zipfile.BadZipFile, EOFError) as e:
        raise not_whole(path, str(e)) from e
    found = {info.filename: info.file_size for info in infos}
    if found != {name: found.get(name, -1) if size is None else size
                 for name, size in sizes.items()}:
        raise not_whole(path, f"it holds {found} of {dict(sizes)}")
    for info in infos:
        end = info.header_offset + len(info.filename.encode()) + info.compress_size
        if end > begins[begins.index(info.header_offset) + 1]:
            raise not_whole(path, f"{info.filename} is cut off")
