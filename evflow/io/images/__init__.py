"""Images in time: folders, videos and NumPy stacks as frames, and the times that belong to them."""
