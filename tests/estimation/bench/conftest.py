"""Fixtures of the bench's tests."""

from __future__ import annotations

import pytest

from evflow.estimation.bench import added_light, levels


@pytest.fixture
def known_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Levels without a black level or dark light: an error that all pixels share, and a note, of
    benches whose steps do not tell, would hide what a test looks for."""
    monkeypatch.setattr(added_light, "USUAL_DN", 1e-9)


@pytest.fixture
def even_remainders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the error of small steps among noise, which all pixels share."""
    monkeypatch.setattr(levels, "SIZE_ERROR", 1e-12)
