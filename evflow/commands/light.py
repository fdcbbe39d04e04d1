"""The light that recordings of a bench were taken in: whether the options fit together."""

from __future__ import annotations

import math
from collections.abc import Sequence

from evflow.errors import EvflowDataError


def check_light(lux: Sequence[float], count: int, protocol: str) -> None:
    """Raise EV020 if --lux, or the second of `count` recordings, does not fit the protocol."""
    if (count > 1 and protocol != "static") or (lux and protocol == "motion"):
        raise EvflowDataError(
            "EV020", f"{'--lux' if count == 1 else f'{count} recordings'} with --protocol "
            f"{protocol}.", "Noise against illuminance needs --protocol static and one --lux per "
            "recording"
            f"{', or --protocol step with a single recording' if count == 1 else ''}.")
    if not all(0 < v < math.inf for v in lux):
        raise EvflowDataError("EV020", f"--lux {' '.join(f'{v:g}' for v in lux)}.",
                              "Give numbers > 0.")
    if protocol == "static" and (count > 1 or lux) and len(lux) != count:
        raise EvflowDataError(
            "EV020", f"{len(lux)} values of --lux for {count} recording{'s' * (count > 1)}.",
            "Give one for each, in the same order: evflow estimate A B --protocol static --lux 5 "
            "200.")
