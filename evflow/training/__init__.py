"""Training: configurations, batches made on the device, losses, the one step, checkpoints."""
