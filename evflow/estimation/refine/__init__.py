"""Refinement by simulation: the recording's own video, simulated with the estimated camera.

    recording --> stretches, read one after the other    stretches.py
    events --> signals between them                      between_events.py
    these, where much happens                            busy.py
    these + frames --> exposure and clock of the frames  frame_timing.py
    frames --optical flow--> path (fine log frames)      path.py
    path + recorded events --> Chunk                     chunk.py
    recorded events, simulated events --> Trace          trace.py
    Trace + path --> Moments, additive                   moments.py
    recorded against simulated Moments --> the summary   fit.py
    what remains, and the search below --> its correction and std   fusion.py
    the same of one polarity alone --> its threshold     alone.py
    recorded events on the path --> each pixel's theta   pixels.py
    recorded events on the path --> photoreceptor, offset of the frames   photoreceptor.py
    the same, pixels with a dead time --> contrast lost in it   lost_contrast.py
    recorded events of quiet pixels --> noise rates      noise.py
    events, random points --> rates of noise beside signal   points.py, signal.py

The network sees single windows. The refinement simulates the whole recording with the estimated
camera and moves the estimate until simulated and recorded events agree. A pixel is compared only
after its first event, when its memory is known: nothing depends on what preceded the recording.
"""

from evflow.estimation.refine.alone import high_threshold_explains, refine_alone
from evflow.estimation.refine.chunk import (
    Chunk,
    make_chunk,
    refinement_chunks,
    simulated_part,
)
from evflow.estimation.refine.denoise import frame_noise
from evflow.estimation.refine.fit import Refined, refine_summary
from evflow.estimation.refine.fusion import fused
from evflow.estimation.refine.lost_contrast import Lost
from evflow.estimation.refine.photoreceptor import find_photoreceptor, receptor_sample
from evflow.estimation.refine.pixels import PixelEvidence, pixel_posterior
from evflow.estimation.refine.receptor_result import Found
from evflow.estimation.refine.stretches import Stretch, cut, plan_runs

__all__ = [
    "Chunk",
    "Found",
    "Lost",
    "PixelEvidence",
    "Refined",
    "Stretch",
    "cut",
    "find_photoreceptor",
    "frame_noise",
    "fused",
    "high_threshold_explains",
    "make_chunk",
    "pixel_posterior",
    "plan_runs",
    "receptor_sample",
    "refine_alone",
    "refine_summary",
    "refinement_chunks",
    "simulated_part",
]
