"""Cameras to render from: captures, viewpoints, paths, sampled views, and cameras in JSON."""
