from __future__ import annotations

import pytest
from helpers.networks import hidden

from evflow import Recording


@pytest.fixture(scope="package")
def sound() -> Recording:
    """A lively scene seen for half a second; frames every 40 ms."""
    return hidden(14, 440)[0]
