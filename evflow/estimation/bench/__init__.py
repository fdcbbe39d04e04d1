"""A camera on a bench: thresholds from a screen that steps between levels of light."""
