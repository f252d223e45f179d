"""Splats, the explicit 3D Gaussians of other programs: their data, spherical harmonics, file formats and rendering."""
