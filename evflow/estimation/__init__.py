"""From recordings to cameras: the estimation pipeline, static scenes, and cameras on a bench."""
