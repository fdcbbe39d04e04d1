"""The blur of an exposure: taken out where things move, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.videos import code_of

from evflow.simulator.between import Interval, intervals
from evflow.simulator.exposure import unblurred
from evflow.simulator.interpolate import upsample

SIZE, DT = 96, 40_000
INNER = np.s_[20:-20, 20:-20]  # what enters at the border cannot be known


def texture(shift: float, seed: int = 3) -> np.ndarray:
    """A random texture (wavelengths 9 to 40 px) moved by a fraction of a pixel, exactly."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIZE, :SIZE]
    total = np.zeros((SIZE, SIZE))
    for _ in range(24):
        angle, wave, phase = rng.uniform(0, np.pi), rng.uniform(9, 40), rng.uniform(0, 2 * np.pi)
        along = np.cos(angle) * (x - shift) + np.sin(angle) * y
        total += np.sin(2 * np.pi * along / wave + phase)
    return (127.5 + 12 * total).clip(0, 255).astype(np.float32)


def exposed(speed: float, exposure_us: int, number: int) -> np.ndarray:
    """Frame `number` of the texture at `speed` px a frame: the mean over the exposure around it."""
    during = number + np.linspace(-0.5, 0.5, 41) * exposure_us / DT
    return np.mean([texture(speed * t) for t in during], 0, dtype=np.float32)


def pairs_of(speed: float, exposure_us: int, count: int = 4) -> list[tuple[np.ndarray, int]]:
    return [(exposed(speed, exposure_us, k), DT * k) for k in range(count)]


@pytest.mark.parametrize(("speed", "exposure_us"), [(6.0, 20_000), (-8.0, 20_000), (6.0, 35_000)])
def test_what_moves_gets_its_contrast_back(speed: float, exposure_us: int) -> None:
    """At the frames and between them, also of the first and the last frame, of which one side
    alone is seen: to less than a third of the error."""
    pairs = pairs_of(speed, exposure_us)
    blurred, sharp = list(intervals(pairs)), list(unblurred(intervals(pairs), exposure_us))
    assert len(sharp) == len(blurred)

    def error(found: list[Interval], number: int, at: float) -> float:
        picture = found[number].a.dn if at == 0 else next(found[number].at([at]))
        return float(np.abs(picture - texture(speed * (number + at)))[INNER].mean())

    for number, at in ((0, 0.0), (1, 0.0), (2, 0.0), (0, 0.5), (1, 0.5), (2, 0.5)):
        assert error(sharp, number, at) < 0.3 * error(blurred, number, at), (number, at)
    for one, other in zip(sharp[1:], sharp, strict=False):
        assert one.a is other.b  # no jump where intervals meet
    end = sharp[-1].b.dn - texture(speed * (len(pairs) - 1))
    before = pairs[-1][0] - texture(speed * (len(pairs) - 1))
    assert np.abs(end)[INNER].mean() < 0.3 * np.abs(before)[INNER].mean()


def test_rest_and_short_exposures_stay_as_they_are() -> None:
    still = [(texture(0.0), DT * k) for k in range(3)]
    for pairs, exposure_us in ((still, 20_000), (pairs_of(6.0, 0), 0), (pairs_of(6.0, 0), 2_000)):
        found = unblurred(intervals(pairs), exposure_us)
        for new, old in zip(found, intervals(pairs), strict=True):
            np.testing.assert_array_equal(new.a.dn, old.a.dn)
            np.testing.assert_array_equal(new.b.dn, old.b.dn)


def test_nothing_is_taken_out_across_a_cut() -> None:
    """The last frame of a shot is sharpened by its own shot alone."""
    pairs = pairs_of(6.0, 20_000, 3)
    shots = [*pairs, *((texture(6.0 * k, seed=5), DT * k) for k in range(3, 6))]
    cut = list(unblurred(intervals(shots, jerk=False), 20_000))
    alone = list(unblurred(intervals(pairs, jerk=False), 20_000))
    assert cut[2].motion.lost
    np.testing.assert_array_equal(cut[2].a.dn, alone[1].b.dn)


def test_upsample_starts_and_ends_with_the_sharp_frames() -> None:
    pairs = pairs_of(6.0, 20_000)
    made = list(upsample(pairs, exposure_us=20_000))
    sharp = list(unblurred(intervals(pairs), 20_000))
    np.testing.assert_array_equal(made[0][0], sharp[0].a.dn)
    np.testing.assert_array_equal(made[-1][0], sharp[-1].b.dn)
    assert [made[0][1], made[-1][1]] == [0, 3 * DT]
    assert max(frame.max() for frame, _ in made) <= 255.0
    assert len(made) == len(list(upsample(pairs)))


def test_a_single_frame_and_none_pass() -> None:
    assert len(list(upsample(pairs_of(6.0, 0, 1), exposure_us=20_000))) == 1
    assert list(upsample([], exposure_us=20_000)) == []


def test_a_negative_exposure_is_refused() -> None:
    assert code_of(lambda: list(upsample([], exposure_us=-1))) == "EV020"
