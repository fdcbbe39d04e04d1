"""Decoded images of one camera as one stack of grey frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evflow.errors import EvflowDataError
from evflow.types import luma


def stack_frames(
    images: Sequence[np.ndarray], where: object
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Images (H, W) or (H, W, 3) RGB -> frames (T, H, W), and a note where colour was converted.

    Raises EV015 where the images differ in shape; `where` names their file in the message.
    """
    shapes = sorted({image.shape for image in images})
    if len(shapes) > 1:
        raise EvflowDataError(
            "EV015", f"{where} has frames of shapes {shapes}.", "Use those of one sensor.")
    frames = np.stack(images) if images else np.zeros((0, 0, 0), np.uint8)
    if frames.ndim == 3:
        return frames, ()
    return luma(frames[..., :3]), ("colour frames were converted to Rec. 709 luma",)
