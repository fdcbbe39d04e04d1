"""Image sequences: folders, videos and NumPy stacks as frames, and their times."""
