"""What the frames of a recording show beside what its pixels saw."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Optics:
    """offset_dn: light in DN that pixels see beside what frames show (dark light, less the frames'
    black level); delay_s: seconds by which events come after what the frames' times say; the
    standard deviations of both, NaN where they were not measured."""

    offset_dn: float = 0.0
    delay_s: float = 0.0
    offset_dn_std: float = float("nan")
    delay_s_std: float = float("nan")
