"""Thresholds from event counts between rests of the light, and noise rates from counts at rest.

dlogI divided by the events is biased high: half an event is missing at the end, and more after the
light reversed, as a pixel after OFF events is up to theta_OFF below its memory. At a rest k, with
a_k and b_k the ON and OFF events until then,

    L_k - L_0 = theta_ON a_k - theta_OFF b_k + r_k - r_0,

where the remainder r_k is uniform in [0, theta_ON) after a rise, in (-theta_OFF, 0] after a fall:
mean half a threshold, variance theta²/12. Each pixel is a linear regression with these means and
variances; r_0 is a third unknown. In most sensors a noise event at a rest resets the memory to the
light, and the pixel starts anew with remainder 0. `storing` decides this from the steps after rests
with events. Where a step is lost, counting begins anew after it, with another unknown r_0. NumPy,
float64: normal equations of each pixel.
"""

from __future__ import annotations

import numpy as np

from evflow.camera import THETA_MIN
from evflow.estimation.bench.leaking import Leaking
from evflow.estimation.pixel_noise import ODD, pixel_rates
from evflow.recordings.faulty_pixels import hot_at_rest

THETA_PRIOR, THETA_PRIOR_STD = 0.3, 0.115  # mean and std of U(.1, .5), without measurements
THETA_TOP = 2.0
PASSES = 4
GOLDEN = 0.6180339887498949
OUTLIERS = 4.0  # half widths of the distribution beyond which pixels say nothing of the mismatch
ERROR_OFF = 0.5  # relative error of the pixels' errors, which are of whole counts and few steps
LEAST_OFF = 50  # OFF events at rest that tell whether noise resets the memory of leaking pixels
BIAS = 0.015  # relative error of the median threshold: 1.4 % low on eight simulated benches


def ratio(
    levels: np.ndarray, n: np.ndarray, strays: np.ndarray, fresh: bool, rests: np.ndarray,
    lost: np.ndarray, lit: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """theta = dlogI / events (2, H, W) over the steps of each direction, and the std of one event.
    Arguments as of `regression`."""
    change = np.where(lost | ~lit[1:] | ~lit[:-1], 0.0, np.diff(levels, axis=0))
    sums = [((s * change > 0) * s * change).sum(0) for s in (1.0, -1.0)]
    counts = [((s * change > 0) * n[:, i]).sum(0) for i, s in enumerate((1.0, -1.0))]
    theta = np.stack([d / np.where(c > 0, c, np.nan) for d, c in zip(sums, counts, strict=True)])
    return theta, theta / np.maximum(np.stack(counts), 1.0)


def regression(
    levels: np.ndarray, n: np.ndarray, strays: np.ndarray, fresh: bool, rests: np.ndarray,
    lost: np.ndarray, lit: np.ndarray, leak: tuple[Leaking, np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Thresholds by iterated weighted least squares for (theta_ON, theta_OFF, r_0).

    Args:
        levels: (K+1, H, W) log intensity at the rests.
        n: (K, 2, H, W) events of the steps, minus the noise.
        strays: (K, 2) expected noise events of each step.
        fresh: whether r_0 is 0.
        rests: (K+1, 2, H, W) events at the rests.
        lost: (K, H, W) bool, steps whose events are not known.
        lit: (K+1, H, W) bool, rests whose level is known.
        leak: of the pixels, (K+1,) seconds of the rests, and (K+1, H, W) seconds since a pixel's
            last event at their end; None without.

    Returns:
        theta and its std, (2, H, W).
    """
    noisy = rests.max(1) > 0
    theta, std = _regression(levels, n, strays, fresh, np.zeros_like(noisy), lost, lit)
    up = np.median(np.diff(levels, axis=0), (1, 2)) > 0
    medians = np.median(theta, (1, 2))
    if leak is None:
        stores = storing(n, up, noisy, medians, lost) > 0.5
        if not stores:
            return theta, std
        n = n.copy()
    else:
        leaking, seconds, since = leak
        kept, counted = (n - np.stack([v, np.zeros(v.shape)], 1) for v in (
            leaking.brought_forward(seconds[:-1], since[:-1], rests[:-1], stores=stores)
            for stores in (True, False)))
        # An event of the leak itself always sets the memory: OFF noise tells whether others do.
        by_leak = lost | (rests[:-1, 0] > 0)
        stores = bool(rests[:, 1].sum() < LEAST_OFF) or storing(
            kept, up, rests[:, 1] > 0, medians, by_leak) > 0.5
        n = kept if stores else counted
    if stores:
        # A noise event amid a step discards half a threshold of change on average.
        n += (0.5 * strays.sum(1)[:, None] * np.stack([up, ~up], 1))[..., None, None]
    return _regression(levels, n, strays, fresh, noisy & stores, lost, lit)


def storing(
    n: np.ndarray, up: np.ndarray, noisy: np.ndarray, theta: np.ndarray, lost: np.ndarray
) -> float:
    """About 1 where noise at a rest resets the memory to the light, about 0 where it does not.

    Compares the events of a step between pixels with and without noise at the rest before. If noise
    resets the memory, pixels with noise send half an event less than the others after a step in the
    same direction, and theta_other / (2 theta) events more after one in the opposite direction.
    n: (K, 2, H, W); up: (K,); noisy: (K+1, H, W); theta: (2,); lost: (K, H, W), left out."""
    excess, expected, weight = [], [], []
    for k in range(1, len(n)):
        side = 0 if up[k] else 1
        anew, others = noisy[k] & ~lost[k], ~noisy[k] & ~lost[k]
        if not anew.any() or not others.any():
            continue
        sent = n[k, side]
        excess.append(sent[anew].mean() - sent[others].mean())
        expected.append(-0.5 if up[k - 1] == up[k] else 0.5 * theta[1 - side] / theta[side])
        weight.append(1.0 / (1.0 / anew.sum() + 1.0 / others.sum()))
    w, x, y = map(np.array, (weight, expected, excess))
    return float((w * x) @ y / ((w * x) @ x)) if len(w) else 0.0


def unrecorded(up: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(K,) bool: the steps of a polarity that the whole recording lacks, whose events no one knows.
    up: (K,); counts: (K, 2, H, W)."""
    on, off = (not counts[:, i].any() for i in range(2))
    return np.where(up, on, off)


def return_error(up: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(2,) relative error of the thresholds of a polarity alone: after each step of the one that is
    not recorded the memory returns from up to a threshold of that, which is the prior's."""
    if not unrecorded(up, counts).any():
        return np.zeros(2)
    sent = np.maximum(counts.sum((0, 2, 3)), 1.0) / counts[0, 0].size
    turned = np.diff(up, prepend=up[0])
    returns = np.array([(turned & up).sum(), (turned & ~up).sum()])
    error = 0.5 * THETA_PRIOR_STD * returns / sent / THETA_PRIOR
    return np.where(counts.any((0, 2, 3)), error, 0.0)


def _regression(
    levels: np.ndarray, n: np.ndarray, strays: np.ndarray, fresh: bool, stored: np.ndarray,
    lost: np.ndarray, lit: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """`regression` for given rests at which the memory was reset, stored: (K+1, H, W) bool."""
    lost = _without_begin(lost | _beside(stored & ~lit), lit)
    stored = stored & lit
    number = np.arange(len(n))[:, None, None]
    last = np.maximum.accumulate(np.where(stored[:-1], number, -1), 0)  # rest, of each step
    # The part of the recording that a step belongs to, and the rest that the part begins with.
    begin = np.maximum.accumulate(np.where(lost, number + 1, 0), 0)
    part = np.cumsum(lost & ~np.roll(lost, -1, 0), 0)
    known, base = last >= begin, np.minimum(np.maximum(last, begin), number)

    def since(total: np.ndarray) -> np.ndarray:
        return total[1:] - np.take_along_axis(total, base, 0)

    rise = since(levels)
    up = np.diff(levels, axis=0) > 0
    before = np.zeros((1, *n.shape[1:]))
    a, b = (since(sums) for sums in np.moveaxis(np.cumsum(np.concatenate([before, n]), 0), 1, 0))
    starts = [np.where(part == i, known - 1.0, 0.0) for i in range(int(part.max()) + 1)]
    design = np.stack([a + 0.5 * up, -(b + 0.5 * ~up), *starts], -1)  # (K, H, W, 2 + parts)
    design = np.where((lost | ~lit[1:])[..., None], 0.0, design)
    after = [(up & (part == i) & lost).any(0) for i in range(1, len(starts))]
    sent = np.cumsum(np.concatenate([np.zeros((1, 2)), strays]), 0)
    extra = sent[1:, :, None, None] - np.moveaxis(sent[base], -1, 1)  # noise: variance, in events
    theta = np.stack([np.full(a.shape[1:], THETA_PRIOR)] * 2)
    covariance = np.zeros((*a.shape[1:], design.shape[-1], design.shape[-1]))
    for _ in range(PASSES):
        each = theta**2
        remainder = np.where(up, each[0], each[1]) / 12.0
        weight = 1.0 / (remainder + np.einsum("kphw,phw->khw", extra, each))
        normal = np.einsum("khwi,khw,khwj->hwij", design, weight, design)
        right = np.einsum("khwi,khw,khw->hwi", design, weight, rise)
        # r_0 is 0 in a fresh memory, else uniform in (-theta_OFF, theta_ON), or, after a lost step,
        # in the half that its direction leaves.
        low, high = (0.0, 0.0) if fresh else (-theta[1], theta[0])
        for i, risen in enumerate([None, *after], 2):
            if risen is not None:
                low, high = np.where(risen, 0.0, -theta[1]), np.where(risen, theta[0], 0.0)
            spread = np.maximum((high - low) ** 2 / 12.0, 1e-9)
            normal[..., i, i] += 1.0 / spread
            right[..., i] += 0.5 * (low + high) / spread
        # A negligible prior, for polarities without steps.
        normal[..., [0, 1], [0, 1]] += 1e-6
        right[..., :2] += 1e-6 * THETA_PRIOR
        covariance = np.linalg.inv(normal)
        found = np.einsum("hwij,hwj->hwi", covariance, right)
        theta = np.clip(np.moveaxis(found[..., :2], -1, 0), THETA_MIN, THETA_TOP)
    pulled = design * weight[..., None]
    scatter = normal - np.einsum("khwi,khw,khwj->hwij", pulled, 1.0 / weight - remainder, pulled)
    anew = np.concatenate([stored[:1], stored[1:] | lost])
    scatter += _walked(pulled, np.einsum("kp,phw->khw", strays, each), anew)
    covariance = covariance @ scatter @ covariance
    std = np.sqrt(np.stack([covariance[..., 0, 0], covariance[..., 1, 1]]))
    return theta, std


def _beside(rests: np.ndarray) -> np.ndarray:
    """(K, H, W) bool: steps to or from rests (K+1, H, W)."""
    return np.asarray(rests[1:] | rests[:-1])


def _without_begin(lost: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """(K, H, W) bool: lost steps, and steps before the first rest whose level is known, from the
    beginning or from a lost step on. Events of a step to or from a later unknown level count."""
    found = lost.copy()
    for k in range(len(lost)):
        found[k] |= ~lit[k] & (found[k - 1] if k else True)
    return found


def _walked(pulled: np.ndarray, variance: np.ndarray, stored: np.ndarray) -> np.ndarray:
    """(H, W, D, D) scatter due to noise events, whose error persists over all later rests until the
    memory is reset. pulled: (K, H, W, D) weighted design; variance: (K, H, W) of each step; stored:
    (K+1, H, W) bool, rests with a reset, or after a lost step."""
    scatter, after = np.zeros((*pulled.shape[1:], pulled.shape[-1])), np.zeros(pulled.shape[1:])
    for k in reversed(range(len(pulled))):
        after = pulled[k] + np.where(stored[k + 1][..., None], 0.0, after)
        scatter += variance[k][..., None, None] * after[..., None] * after[..., None, :]
    return scatter


def camera_wide(
    theta: np.ndarray, error: np.ndarray
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Median and its std; mismatch (spread beyond the pixels' own errors) and its std."""
    if not len(theta):
        return (THETA_PRIOR, THETA_PRIOR_STD), (0.0, 0.0)
    # Counts are small integers, which quantises the thresholds. Each is spread evenly over its
    # error (multiples of the golden ratio fill (0, 1) evenly) for a continuous median.
    phase = np.arange(len(theta)) * GOLDEN % 1.0 - 0.5
    low, median, high = np.quantile(theta + np.sqrt(12.0) * error * phase, (0.1587, 0.5, 0.8413))
    wide = 0.5 * (high - low)
    near = np.abs(theta - median) <= OUTLIERS * wide
    all_, alone = theta[near].var(), (error[near] ** 2).mean()
    square = max(all_ - alone, 0.0)
    square_error = np.hypot(all_ * np.sqrt(2.0 / len(theta)), 2.0 * ERROR_OFF * alone)
    spread = np.sqrt(square)
    spread_error = square_error / (2.0 * max(spread, np.sqrt(0.5 * square_error), 1e-12))
    own = np.hypot(1.25 * wide / np.sqrt(len(theta)), BIAS * median)
    return (float(median), float(own)), (float(spread), float(spread_error))


def camera_rate(
    counts: np.ndarray, seconds: np.ndarray, dead: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean rates (2,) in Hz of counts (2, H, W) in seconds (2,), without hot and dead pixels, and
    (H, W) bool, those that are not hot."""
    kept = ~hot_at_rest(counts.sum(0))
    used = kept & ~dead
    return counts[:, used].mean(1) / seconds if seconds.min() > 0 else np.zeros(2), kept


def pixel_and_camera_rates(
    counts: np.ndarray, seconds: np.ndarray, dead: np.ndarray, unsure_hz: float = 0.0
) -> tuple[np.ndarray, tuple[np.ndarray, list[tuple[float, float]]]]:
    """Noise rates by `pixel_rates`, a hot pixel's its own count, a dead one's the camera's.

    Args:
        counts: (2, H, W) events at rest.
        seconds: (2,) counting time of either polarity.
        dead: (H, W) bool.
        unsure_hz: error of the ON rate beside that of the counts.

    Returns:
        Rates (2, H, W) in Hz; their std, and per polarity the mean rate over pixels that are
        neither hot nor dead and its std.
    """
    hz, kept = camera_rate(counts, seconds, dead)
    if seconds.min() <= 0:
        flat = np.zeros(counts.shape)
        return flat, (flat, [(0.0, 0.0)] * 2)
    used = kept & ~dead
    mean = np.maximum(hz, 1e-12)
    variance = np.array([c[used].var() for c in counts]) / seconds**2
    variance = np.maximum(variance - mean / seconds, 1e-4 * mean**2)
    pixels = max(int(used.sum()), 1)
    error = np.sqrt((mean / seconds + variance) / pixels + 1.0 / (seconds * pixels) ** 2
                    + np.array([unsure_hz, 0.0]) ** 2)
    eta, std = np.stack([
        pixel_rates(c, np.where(dead, 0.0, s), m, ~kept, error=e / m, odd=ODD)
        for c, s, m, e in zip(*map(list, (counts, seconds, mean, error)), strict=True)], 1)
    return eta, (std, [(float(m), float(e)) for m, e in zip(hz, error, strict=True)])
