"""What several formats share: streams of words, lines of text, HDF5 tables."""
