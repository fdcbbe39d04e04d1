"""Frames and a camera in, events or voxels out.

pixel.py one pixel's step · noise.py Poisson noise and leak · scan.py pixels vmapped, frames
scanned · events.py sorted event lists on the host · voxels.py voxel grids on the device ·
interpolate.py slow videos to fast ones.
"""

from evflow.simulator.events import simulate, simulate_stream
from evflow.simulator.voxels import simulate_voxels

__all__ = ["simulate", "simulate_stream", "simulate_voxels"]
