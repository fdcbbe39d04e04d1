"""Prior of the photoreceptor's constants: the offset measured from net changes between frames
(net_changes.py), and the spread of the constants over cameras."""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.camera.sensors import LogMap
from evflow.estimation.refine.net_changes import SHARE
from evflow.estimation.refine.receptor_data import MAPS, Sample

Array = np.ndarray

PRIOR = np.array([25.0, 5e-3, 8e-4])  # std of offset (DN), tau and delay (s) before any data
MISLED = 0.05  # share of cameras whose net changes give a wrong offset
BIASED = 3.5  # DN, by which a path finds offsets too large or small, however sharply
DOUBT = 6.0  # log odds for an ideal camera: a priori, and for the volume of the three constants
# A short recording of few pixels shows few motions, and the path's errors differ for each. Of 41
# ideal cameras of 64x64 pixels, recorded for .05 to .2 s, 14 would be found not ideal with DOUBT
# alone, 2 with this term; it costs detections: 78 of 113 cutoffs of 30 to 300 Hz are found instead
# of 90, and 28 of 72 offsets instead of 40.
FEW, FEWER = 3000.0, 5.0  # pixel seconds; log odds per factor e below


@dataclasses.dataclass(frozen=True)
class Prior:
    """offset_dn: measured from net changes; std_dn: what its std would be if the offset were 0;
    infinite where the offset is undetermined."""

    offset_dn: float = 0.0
    std_dn: float = float("inf")

    @staticmethod
    def of(data: Sample, log_map: LogMap = "linlog") -> Prior:
        """The prior of a sample whose pixels have this log map."""
        if data.net_offset is None:
            return Prior()
        net = np.asarray(data.net_offset)[0, MAPS.index(log_map)]
        return Prior(*map(float, net))

    @property
    def offset_std(self) -> float:
        """Std (DN) of the measured offset."""
        return float(np.hypot(self.std_dn, SHARE * self.offset_dn))

    @property
    def centre(self) -> Array:
        """(3,): most probable offset, tau and delay."""
        share = PRIOR[0] ** 2 / (PRIOR[0] ** 2 + self.offset_std**2)
        return np.array([self.offset_dn * share, 0.0, 0.0])

    @property
    def std(self) -> Array:
        """(3,): of offset (DN), tau and delay (s)."""
        return np.array([(PRIOR[0] ** -2 + self.offset_std**-2) ** -0.5, *PRIOR[1:]])

    def minus_log(self, phi: Array) -> float:
        """Minus the log density at phi (3,), up to a constant."""
        away = (phi - self.centre) / self.std
        return 0.5 * float(away @ away)

    def log_odds(self, offset_dn: float) -> float:
        """Log likelihood ratio of the measured offset, for this true offset against none."""
        if not np.isfinite(self.std_dn):
            return 0.0
        with_offset = self._chance(offset_dn, self.offset_std)
        return float(np.log(with_offset / self._chance(0.0, self.std_dn)))

    def evidence(self) -> float:
        """Log likelihood ratio of the measured offset, for an offset of any size against none."""
        if not np.isfinite(self.std_dn):
            return 0.0
        of_any = self._chance(0.0, float(np.hypot(PRIOR[0], self.offset_std)))
        return float(np.log(of_any / self._chance(0.0, self.std_dn)))

    def _chance(self, offset_dn: float, std_dn: float) -> float:
        """Likelihood of the measured offset: normal about this one, or an outlier."""
        return ((1 - MISLED) * _density(self.offset_dn - offset_dn, std_dn)
                + MISLED * _density(self.offset_dn, PRIOR[0]))


def _density(away: float, std: float) -> float:
    return float(np.exp(-0.5 * (away / std) ** 2) / std)


def beyond_bias(gain: float, offset_dn: float) -> float:
    """Log odds by which a path says that there is this offset and not none: the gain of its
    likelihood, and no more than if it knew the offset with an error of BIASED."""
    return min(gain, 0.5 * (offset_dn / BIASED) ** 2)


def small_sample_odds(data: Sample) -> float:
    """Log odds required beside DOUBT, as little was recorded; 0 above FEW pixel seconds."""
    return FEWER * max(float(np.log(FEW / max(float(np.sum(data.watched)), 1.0))), 0.0)
