"""Depth maps of photos with known poses, by plane sweep."""

from hyrfpack.stereo.depth_maps import DepthMap, Photo, count_agreeing, estimate_depth_maps

__all__ = ["DepthMap", "Photo", "count_agreeing", "estimate_depth_maps"]
