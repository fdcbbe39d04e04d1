"""From recordings to cameras: the whole pipeline, static scenes, and a camera on a bench."""
