"""What the search for a photoreceptor says of the thresholds and their error, for the fusion.

Exposure, noise, an undetected offset and a slow photoreceptor add errors. They show in disagreement
between the regression on the path and the stepped thresholds, and above all in a low share of
variance that the path explains.
"""

from __future__ import annotations

import numpy as np

from evflow.estimation.refine.receptor_result import Found, contrast_kept

Array = np.ndarray

OF_BOTH = (
    "needed", "odds", "unexplained", "log_unexplained", "explained_more", "poor", "poor_unneeded",
    "smear_10", "smear_20", "frame_noise", "offset", "offset_unneeded", "offset_std", "tau",
    "tau_unneeded", "tau_std", "delay", "even", "size", "blur")
OF_ONE = ("regression", "found_regression", "ideal_regression", "theta_10", "theta_20", "open",
          "open_unneeded", "missed")
NAMES = (*OF_BOTH, *(f"{name}_{side}" for side in ("on", "off") for name in OF_ONE))
NEEDED = NAMES.index("needed")
MOST_ODDS, MOST_AWAY = 10.0, 1.0  # log odds; log ratio of thresholds
LENIENT = 3.0  # log odds added to the search's for a camera that is not ideal
POOR = 0.3  # share of variance left unexplained by the path, above which an offset is often missed


def path_signs(found: Found | None, noise_dn: float, blur_s: float, theta: Array) -> Array:
    """The search's result beside the stepped thresholds.

    Args:
        found: the search for the photoreceptor; None if there was none.
        noise_dn: std of the frames' noise, DN.
        blur_s: exposure of the frames whose blur was taken out of the path; 0 if it is unknown.
        theta: (2,) thresholds ON and OFF after the Gauss-Newton steps.

    Returns:
        (len(NAMES),) float64 in the order of NAMES; zeros without a search. `missed` is the
        threshold's change under a photoreceptor that was not detected, times its probability.
    """
    if found is None:
        return np.zeros(len(NAMES))
    needed = float(found.needed)
    unneeded, (ideal, seen) = 1.0 - needed, found.explained
    left = 1.0 - (seen if found.needed else ideal)
    chance = np.clip(found.chance, 1e-9, 1 - 1e-9)
    log_odds = np.log(chance / (1 - chance)) + found.few
    offset_std, tau_std, _ = found.std
    both = [
        needed, np.clip(log_odds, -MOST_ODDS, MOST_ODDS) / MOST_ODDS, left, np.log(left + 1e-3),
        np.log((1 - ideal + 1e-3) / (1 - seen + 1e-3)), float(left > POOR),
        unneeded * float(left > POOR), *found.smear[:, 0], noise_dn / 3.0,
        needed * found.seen.offset_dn / 20.0, unneeded * found.seen.offset_dn / 20.0,
        np.log(offset_std), needed * found.seen.tau_s * 1e3, unneeded * found.seen.tau_s * 1e3,
        np.log(tau_std * 1e3), found.seen.delay_s * 1e3, float(not found.seen.by_light),
        np.log(found.size), blur_s * 1e2]
    missed = unneeded / (1.0 + np.exp(-log_odds - LENIENT))
    change = np.log(found.theta / found.ideal_theta)
    used, explained = (found.theta, seen) if found.needed else (found.ideal_theta, ideal)

    def away(other: Array) -> Array:
        return np.clip(np.log(other / theta), -MOST_AWAY, MOST_AWAY)

    ones = np.stack([
        away(used / contrast_kept(explained)), away(found.theta), away(found.ideal_theta),
        *found.smear[:, 1:], np.log(needed * found.theta_error + 0.01),
        np.log(unneeded * found.theta_error + 0.01), missed * np.clip(change, -1.0, 1.0)], 1)
    return np.concatenate([both, ones.ravel()])
