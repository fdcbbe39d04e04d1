"""What is likely of a photoreceptor before the path is looked at: what the changes from frame to
frame tell of the offset (net_changes.py), and how far the constants of cameras lie apart."""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.estimation.refine.net_changes import SHARE
from evflow.estimation.refine.receptor_data import Sample

Array = np.ndarray

PRIOR = np.array([25.0, 5e-3, 8e-4])  # std of offset (DN), tau and delay (s) before any data
MISLED = 0.05  # of cameras, whose changes tell a wrong offset
DOUBT = 6.0  # log odds, a priori and for the volume of the three, that a camera is ideal
# A short recording of few pixels shows few motions, and the path errs in its own way about each. Of
# 41 ideal cameras of 64x64 pixels, seen for .05 to .2 s, 14 would be taken for others by DOUBT
# alone, 2 with this; 78 of 113 cutoffs of 30 to 300 Hz are found, not 90, 28 of 72 offsets, not 40.
FEW, FEWER = 3000.0, 5.0  # pixel seconds watched; log odds for a factor e below


@dataclasses.dataclass(frozen=True)
class Prior:
    """offset_dn, std_dn: what the changes tell of the offset, were it nought; an infinite std where
    they tell nothing."""

    offset_dn: float = 0.0
    std_dn: float = float("inf")

    @staticmethod
    def of(data: Sample) -> Prior:
        """That of a sample."""
        return Prior() if data.told is None else Prior(*map(float, np.asarray(data.told)[0]))

    @property
    def told(self) -> float:
        """Std (DN) of the offset that is told."""
        return float(np.hypot(self.std_dn, SHARE * self.offset_dn))

    @property
    def centre(self) -> Array:
        """(3,): offset, tau and delay that are most likely."""
        share = PRIOR[0] ** 2 / (PRIOR[0] ** 2 + self.told**2)
        return np.array([self.offset_dn * share, 0.0, 0.0])

    @property
    def std(self) -> Array:
        """(3,): of offset (DN), tau and delay (s)."""
        return np.array([(PRIOR[0] ** -2 + self.told**-2) ** -0.5, *PRIOR[1:]])

    def unlikely(self, phi: Array) -> float:
        """Minus the logarithm, but for a constant."""
        away = (phi - self.centre) / self.std
        return 0.5 * float(away @ away)

    def likelier(self, offset_dn: float) -> float:
        """Log odds of what the changes tell, of this offset against none."""
        if not np.isfinite(self.std_dn):
            return 0.0
        return float(np.log(self._chance(offset_dn, self.told) / self._chance(0.0, self.std_dn)))

    def evidence(self) -> float:
        """Log odds of what the changes tell, of an offset of any size against none."""
        if not np.isfinite(self.std_dn):
            return 0.0
        of_any = self._chance(0.0, float(np.hypot(PRIOR[0], self.told)))
        return float(np.log(of_any / self._chance(0.0, self.std_dn)))

    def _chance(self, offset_dn: float, std_dn: float) -> float:
        """How likely what is told is, of that offset and with that std, or by mistake."""
        return ((1 - MISLED) * _density(self.offset_dn - offset_dn, std_dn)
                + MISLED * _density(self.offset_dn, PRIOR[0]))


def _density(away: float, std: float) -> float:
    return float(np.exp(-0.5 * (away / std) ** 2) / std)


def few(data: Sample) -> float:
    """Log odds that it takes beside DOUBT; none where enough was watched."""
    return FEWER * max(float(np.log(FEW / max(float(np.sum(data.watched)), 1.0))), 0.0)
