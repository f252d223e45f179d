"""Depth maps of photos with known poses, by plane sweep."""

from hyrfpack.stereo.depth_maps import InverseDepthMap, StereoPhoto, count_agreeing_sources, estimate_depth_maps

__all__ = ["InverseDepthMap", "StereoPhoto", "count_agreeing_sources", "estimate_depth_maps"]
