"""The simulator: frames and a camera in; events, voxels or counts out.

constants.py the circuit as a pytree · pixel.py one interval of one pixel (second_order.py:
with a photoreceptor of second order) · noise.py Poisson noise and leak · sensor.py all pixels,
vmapped · to events: frames.py what comes in, active.py the pixels that may fire, pack.py sorted
lists, circuits.py block by block, events.py the stream · to voxels: bins.py, grids.py, voxels.py ·
to counts: counts.py · voltmeter.py a Brownian pixel · interpolate.py frames in between
(motion.py optical flow, between.py the pictures along its paths).
"""

from evflow.simulator.counts import simulate_counts
from evflow.simulator.events import simulate, simulate_stream
from evflow.simulator.voxels import simulate_voxels

__all__ = ["simulate", "simulate_counts", "simulate_stream", "simulate_voxels"]
