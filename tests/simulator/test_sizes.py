"""Programs are few at first, and as many as pay."""

from __future__ import annotations

import pytest

from evflow.simulator.sizes import ACTIVE, PATIENCE, Sizes, sizes


@pytest.mark.parametrize("pixels", [1, 4096, 4097, 90_000])
def test_one_program_serves_until_its_padding_has_cost_another(pixels: int) -> None:
    found = Sizes(pixels)
    largest = found.of(min(pixels, ACTIVE[-1]))
    assert largest == found.of(1) >= min(pixels, ACTIVE[-1])
    for count in (1, 5000, 20_000):
        if count > pixels:
            continue
        fits = min(size for size in ACTIVE if size >= count)
        padded = [found.of(count) for _ in range(2 + PATIENCE // 4096)]
        assert padded[-1] == fits
        assert set(padded) == {fits, largest}
        assert sum(size - fits for size in padded) <= PATIENCE  # not more than it costs
        largest = max(found.ready)
    assert len(found.ready) == len(set(found.ready)) <= len(ACTIVE)


def test_the_first_size_has_room_for_twice_the_pixels_and_larger_ones_come_when_needed() -> None:
    found = Sizes(90_000)
    assert [found.of(count) for count in (3_000, 8_000, 9_000, 3_000)] == [8192, 8192, 20480, 8192]
    assert [Sizes(5_000).of(3_000), Sizes(90_000).of(20_480)] == [8192, 20480]


def test_each_program_has_its_own_sizes() -> None:
    assert sizes(90_000, "one") is sizes(90_000, "one")
    assert sizes(90_000, "one") is not sizes(90_000, "another")
