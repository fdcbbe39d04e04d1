"""Recordings: windows between frames, gaps, glitches, faulty pixels, and `check`.

NumPy only: judging a recording never imports JAX.
"""

from evflow.recordings.windows import WindowPlan, condensed, iter_windows, plan_windows

__all__ = ["WindowPlan", "condensed", "iter_windows", "plan_windows"]
