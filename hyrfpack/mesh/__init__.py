"""Triangle meshes of models: fusion of rendered depth maps, extraction of the surface, and files."""

from hyrfpack.mesh.extract import Mesh, extract_mesh

__all__ = ["Mesh", "extract_mesh"]
