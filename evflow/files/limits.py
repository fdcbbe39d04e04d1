"""How far a file may expand in memory. A damaged or hostile one claims, or packs, without bound:
a zip of 1 MB may hold 1 GB of zeros, a PNG of 20 kB a picture of a thousand megapixels.

Recordings expand 3- to 20-fold (text, gzip, frames); what expands beyond `RATIO` and also beyond
`FREE` is refused before memory is taken.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from evflow.errors import EvflowDataError

FREE = 256 << 20  # bytes that any file may take
RATIO = 64
WHOLE = 1 << 30  # bytes of a file that is read at once; the largest JSON of COCO has half of it


def read_whole(path: Path | zipfile.Path, most: int = WHOLE) -> bytes:
    """All bytes of a file; EV009 where they are more than `most`: another file, or a sparse one,
    of which a few bytes stand for any number of zeros."""
    if isinstance(path, Path) and (size := path.stat().st_size) > most:
        raise EvflowDataError(
            "EV009", f"{path} has {size:,} bytes, and would have to be read whole.",
            "No file of its kind is so large: is it the right one?", where=path)
    return path.read_bytes()


def check_expansion(claimed: int, stored: int, where: object) -> None:
    """EV009 where `claimed` bytes are to come from `stored` bytes; `where` names them."""
    if claimed > FREE + RATIO * stored:
        raise EvflowDataError(
            "EV009", f"{where} claims {claimed:,} bytes, stored in {stored:,}.",
            "Damaged, or made to fill the memory? Copy or export it again.", where=where)
