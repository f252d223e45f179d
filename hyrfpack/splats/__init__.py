"""Explicit 3D Gaussians as other programs hold them: the data, their harmonics, their files, drawing them."""
