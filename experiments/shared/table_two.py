"""Table II of the paper, and the lights of its bench."""

from __future__ import annotations

import numpy as np

SCP = (101, 121, 141, 161, 181, 201)
# Threshold, its spread, events. The count of SCP 141, OFF is printed as 8,564,635; its
# neighbours times their thresholds say that one digit is too many.
TABLE_TWO = {
    "on": np.array([(0.119, 0.082, 2850599), (0.159, 0.089, 1675849), (0.210, 0.096, 1172399),
                    (0.269, 0.103, 890028), (0.342, 0.113, 729427), (0.433, 0.140, 558242)]),
    "off": np.array([(0.203, 0.121, 1751785), (0.249, 0.107, 1110802), (0.302, 0.103, 856463.5),
                     (0.358, 0.105, 713966), (0.420, 0.105, 637139), (0.479, 0.109, 545253)])}
MIDDLE = 3  # SCP 161, the row that ratios refer to
LUX = np.arange(500, 4001, 500)
LEVELS = LUX * (255 / 4000)
