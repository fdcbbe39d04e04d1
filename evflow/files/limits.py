"""How far a file may expand in memory. A damaged or hostile file may claim or hold any amount: a
zip of 1 MB can contain 1 GB of zeros, a PNG of 20 kB an image of a thousand megapixels.

Recordings expand 3- to 20-fold (text, gzip, frames); what exceeds both `RATIO` and `FREE` is
refused before memory is allocated.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from evflow.errors import EvflowDataError

FREE = 256 << 20  # bytes that any file may expand to
RATIO = 64
WHOLE = 1 << 30  # bytes of a file that is read at once; COCO's largest JSON has half of that


def read_whole(path: Path | zipfile.Path, most: int = WHOLE) -> bytes:
    """All bytes of a file; EV009 if they exceed `most`: not the right file, or a sparse one, where
    a few bytes on disk stand for any number of zeros."""
    if isinstance(path, Path) and (size := path.stat().st_size) > most:
        raise EvflowDataError(
            "EV009", f"{path} has {size:,} bytes, which would all have to be read into memory.",
            "Files of this kind are never so large: is it the right one?", where=path)
    return path.read_bytes()


def check_expansion(claimed: int, stored: int, where: object) -> None:
    """Raise EV009 if `stored` bytes cannot plausibly expand to `claimed`; `where` names them."""
    if claimed > FREE + RATIO * stored:
        raise EvflowDataError(
            "EV009", f"{where} claims {claimed:,} bytes from {stored:,} stored ones.",
            "Damaged, or made to fill the memory? Copy or export it again.", where=where)
