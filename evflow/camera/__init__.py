"""The camera as values: maps per pixel, what all pixels share, the prior, and known sensors.

    camera.py    Camera (theta and eta per pixel), Summary (what a whole camera shares)
    prior.py     the distribution that cameras are drawn from
    sensors.py   SensorModel, the pixel circuit, and sensors by name
    perturb.py   hot and dead pixels, measured noise
    exports/     a camera as settings of other simulators
"""

from evflow.camera.camera import PARAMETERS, THETA_MIN, Camera, Summary
from evflow.camera.prior import CameraPrior, noise_of_threshold, sample_nominal, sample_pixels

__all__ = [
    "PARAMETERS", "THETA_MIN", "Camera", "CameraPrior", "Summary", "noise_of_threshold",
    "sample_nominal", "sample_pixels",
]
