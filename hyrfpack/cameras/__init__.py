"""Where pictures are taken from: captures, viewpoints, paths, and cameras in JSON."""
