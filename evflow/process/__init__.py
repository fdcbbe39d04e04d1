"""The process: terminal and signals, workers, devices, chunks of work, provenance."""
