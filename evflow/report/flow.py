"""Optical flow as colour: hue is the direction, saturation the speed."""

from __future__ import annotations

import cv2
import numpy as np

from evflow.types import Events

WHEEL = 6  # the colour wheel takes this fraction of the shorter side
REST = 1.0  # white, where nothing moves
GROUND = 0.13  # dark, where there are no events: on white, slow motion would be invisible


def flow_colours(flow: np.ndarray, full_px: float) -> np.ndarray:
    """RGB (H, W, 3) on 0..1 from flow (2, H, W) = (x, y): red to the right, then clockwise orange
    and green down, cyan to the left, violet up; white at rest, full colour from full_px on."""
    x, y = np.asarray(flow, np.float32)
    hue = np.degrees(np.arctan2(y, x)) % 360.0
    saturation = np.minimum(np.hypot(x, y) / np.float32(full_px), 1.0)
    hsv = np.stack([hue, saturation, np.full_like(hue, REST)], -1)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def flow_image(flow: np.ndarray, events: Events, full_px: float) -> np.ndarray:
    """The colours at pixels with events, dark elsewhere, with a wheel in the upper right corner;
    (H, W, 3) on 0..1."""
    active = events.count_map().sum(0) > 0
    image = np.where(active[..., None], flow_colours(flow, full_px), GROUND)
    side = max(9, min(active.shape) // WHEEL)
    if min(active.shape) >= side:
        image[:side, -side:] = wheel(side)
    return image


def wheel(side: int) -> np.ndarray:
    """The colours of all directions as a disc, (side, side, 3)."""
    reach = np.linspace(-1.0, 1.0, side, dtype=np.float32)
    flow = np.stack(np.meshgrid(reach, reach))
    inside = np.hypot(*flow) <= 1.0
    return np.where(inside[..., None], flow_colours(flow, 1.0), GROUND)
