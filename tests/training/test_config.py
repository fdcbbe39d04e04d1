"""Configurations refuse values that no training could use."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest

from evflow.errors import EvflowDataError
from evflow.training.config import PRESETS


@pytest.mark.parametrize(("part", "name", "value"), [
    ("loss", "flow", math.nan), ("loss", "flow", -1.0), ("loss", "dequantise", -1.0),
    ("loss", "events", "x"), ("loss", "edges", "x"), ("loss", "patches", (0, 4)),
    ("loss", "patches", ()), ("loss", "edge", 0.0), ("nuisances", "hot_pixels", 2.0),
    ("nuisances", "fresh", 3.0), ("nuisances", "hot_hz", (100.0, 5.0)),
    ("nuisances", "odd_factor", (0.0, 0.0)), ("nuisances", "exposures", 0),
    ("nuisances", "frame_noise_dn", math.nan), ("", "warmup", -5), ("", "window_s", (2e4, 1e5)),
    ("", "window_s", (math.nan, 0.1))])
def test_impossible_values_are_named(part: str, name: str, value: Any) -> None:
    whole = PRESETS["debug"]
    with pytest.raises(EvflowDataError, match=f"EV020.*{name}.*must be"):
        dataclasses.replace(getattr(whole, part) if part else whole, **{name: value})
