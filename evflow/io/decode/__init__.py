"""What several formats share: streams of words, lines of text, tables of HDF5."""
