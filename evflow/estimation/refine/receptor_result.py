"""What the search for a photoreceptor (receptor_search.py) found: circuit, optics, thresholds."""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.simulator.photoreceptor import Photoreceptor

# A path that loses contrast also explains less of the events. On simulated recordings with .8 to
# .98 explained, the ratio of the regression's thresholds to the true ones is 1 - LACKING times the
# unexplained share, with an error of KEPT_ERROR: a constant, and a share of the loss.
LACKING, LEAST_KEPT = 1.5, 0.5
KEPT_ERROR = (0.04, 0.8)
# Log theta is found .02 too low by the Gauss-Newton steps where the offset is right, with an error
# of .03 of other causes: measured on 898 simulated cameras for which an offset was found.
STEPPED_LOW, STEPPED_ERROR = 0.02, 0.03

# A low-pass that is the same in any light and a delay act alike on slow changes. A path between
# frames is smoother than the light, and tau came out .2 to .65 ms short on 15 of 18 cameras of 40
# Hz, the delay as much longer: error of either, beside the covariance.
TRADED = 4e-4  # s


@dataclasses.dataclass(frozen=True, eq=False)
class OtherMap:
    """The log map that was not taken: its probability, and ratio (2,) of theta by it to theta."""

    chance: float
    ratio: np.ndarray

    @property
    def theta_error(self) -> np.ndarray:
        """(2,) relative error of theta as it may be the right one: a mixture of two values."""
        return np.sqrt(self.chance) * np.abs(np.log(self.ratio))


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """Result of the search.

    seen: the most probable photoreceptor; theta, ideal_theta: (2,) of the pooled regression, with
    it and with an ideal pixel; covariance: (3, 3) of (offset, tau, delay); theta_error: (2,)
    relative errors of theta due to their uncertainty; explained: shares of the variance that the
    regression explains, with an ideal pixel and as found; chance: probability that the pixel is not
    ideal; few: log odds subtracted for a small sample; size: effective number of independent
    events; smear: (2, 3) for each of SMEARS, gain of log unexplained share when counts are averaged
    over it, and changes of log theta_on and log theta_off; curve: (K, 2) CUTOFFS in Hz, and the
    share explained with each, offset and delay as found; other_map: None where the maps do not
    differ; offset_open: (2,) relative errors of the ideal pixel's theta due to an offset that may
    be there, 0 where it is not ideal; loss_open: of theta due to contrast that may be lost in a
    dead time, 0 where it is taken out (lost_contrast.py)."""

    seen: Photoreceptor
    theta: np.ndarray
    ideal_theta: np.ndarray
    covariance: np.ndarray
    theta_error: np.ndarray
    explained: tuple[float, float]
    chance: float
    few: float
    size: float
    smear: np.ndarray
    curve: np.ndarray
    other_map: OtherMap | None = None
    offset_open: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))
    loss_open: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))

    @property
    def unexplained(self) -> float:
        """Share of the variance that stays unexplained by what is used."""
        return 1.0 - self.explained[int(self.needed)]

    @property
    def std(self) -> np.ndarray:
        """Of offset (DN), tau (s) and delay (s)."""
        traded = 0.0 if self.seen.by_light else TRADED
        return np.hypot(np.sqrt(np.diag(self.covariance)), [0.0, traded, traded])

    @property
    def sensor(self) -> tuple[SensorModel, dict[str, float]]:
        """The measured pixel circuit and its standard deviations; the cutoff is 0 (none) where tau
        is less than two standard deviations by the covariance."""
        tau, error = self.seen.tau_s, float(self.std[1])
        seen = self.needed and tau > 2.0 * np.sqrt(self.covariance[1, 1])
        cutoff = self.seen.cutoff_hz if seen else 0.0
        return (SensorModel(cutoff_hz=cutoff, cutoff_by_light=self.seen.by_light or not cutoff,
                            log_map=self.seen.log_map, noise_resets_memory=True),
                {"cutoff_hz": cutoff * error / tau if seen else float("nan")})

    @property
    def least_cutoff_hz(self) -> float:
        """Lower bound of the cutoff: tau two standard deviations above its value."""
        slow = (self.seen.tau_s if self.needed else 0.0) + 2.0 * float(self.std[1])
        return float(1.0 / (2.0 * np.pi * slow))

    @property
    def optics(self) -> Optics:
        """Offset and delay of the frames, and their standard deviations."""
        offset, delay = (self.seen.offset_dn, self.seen.delay_s) if self.needed else (0.0, 0.0)
        return Optics(offset, delay, float(self.std[0]), float(self.std[2]))

    @property
    def needed(self) -> bool:
        """Whether an ideal pixel is less probable than the photoreceptor found."""
        return self.chance > 0.5

    @property
    def ideal(self) -> Photoreceptor:
        """An ideal one, with the log map found."""
        return Photoreceptor(log_map=self.seen.log_map)

    @property
    def used(self) -> Photoreceptor:
        """The photoreceptor found if it is needed, else the ideal one."""
        return self.seen if self.needed else self.ideal

    def optics_given(self, change: float, error: float) -> Optics:
        """Offset and delay given the refined thresholds: too large an offset makes thresholds too
        low, so it is corrected as they are, by the correlation of the two.

        Args:
            change: of log theta by the fusion, mean of ON and OFF.
            error: relative error of the refined thresholds.

        Returns:
            As `optics`, with another offset, of the same sign and at most twice as large. Its std
            is left as it is.
        """
        optics, due = self.optics, float(self.theta_error.mean())
        gain = optics.offset_dn_std * due / (due**2 + error**2 + STEPPED_ERROR**2)
        most = 2 * optics.offset_dn
        offset = np.clip(optics.offset_dn - gain * (change - STEPPED_LOW),
                         min(most, 0.0), max(most, 0.0))
        return dataclasses.replace(optics, offset_dn=float(offset))

    def thresholds(self) -> tuple[np.ndarray, float]:
        """theta (2,) of the pooled regression, corrected for the contrast that the path loses, and
        its relative error."""
        kept = contrast_kept(self.explained[1])
        return self.theta / kept, float(np.hypot(KEPT_ERROR[0], KEPT_ERROR[1] * (1 - kept)))


def contrast_kept(explained: float) -> float:
    """Share of the contrast that a path keeps which explains this share of the variance."""
    return float(np.clip(1 - LACKING * (1 - explained), LEAST_KEPT, 1.0))
