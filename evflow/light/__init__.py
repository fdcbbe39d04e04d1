"""Light: from frames in DN to linear light and to the log intensity a pixel responds to."""
