"""Light: what frames in DN say of it, and the log that a pixel answers to."""
