"""Depth maps of photos with known poses, by plane sweep."""

from hyrfpack.stereo.depth_maps import InverseDepthMap, Photo, count_agreeing, estimate_depth_maps

__all__ = ["InverseDepthMap", "Photo", "count_agreeing", "estimate_depth_maps"]
