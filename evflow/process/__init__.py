"""The process that the work runs in: its signals, and whether others are alive."""
