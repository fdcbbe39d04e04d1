"""How far a file may expand in memory. A damaged or hostile one claims, or packs, without bound:
a zip of 1 MB may hold 1 GB of zeros, a PNG of 20 kB a picture of a thousand megapixels.

Recordings expand 3- to 20-fold (text, gzip, frames); what expands beyond `RATIO` and also beyond
`FREE` is refused before memory is taken.
"""

from __future__ import annotations

from evflow.errors import EvflowDataError

FREE = 256 << 20  # bytes that any file may take
RATIO = 64


def check_expansion(claimed: int, stored: int, where: object) -> None:
    """EV009 where `claimed` bytes are to come from `stored` bytes; `where` names them."""
    if claimed > FREE + RATIO * stored:
        raise EvflowDataError(
            "EV009", f"{where} claims {claimed:,} bytes, stored in {stored:,}.",
            "Damaged, or made to fill the memory? Copy or export it again.", where=where)
