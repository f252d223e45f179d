"""The report of an export."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ExportReport:
    """The result of an export. PSNR is in dB, as a mean over views.

    Attributes:
        file: path of the written file or folder.
        bytes: size on disk; of a folder, the total size of the written files.
        gaussians: number of Gaussians in the file, or at the finest level, including the background's; 0 for a file of
            cameras.
        native: whether the file holds the model itself, so that nothing was lost and nothing is measured.
        background: number of Gaussians that represent the background.
        degree: degree of the spherical harmonics in the file.
        chosen_by: scores by which the degree was chosen: for each degree, the PSNR of the baked model's pictures
            against the model's own at validation cameras. Empty if the degree was given.
        views: number of views at which the loss was measured; 0 if it was not measured.
        views_fitted: whether colours were fitted at these views, too, because the file keeps few cameras. Their PSNR is
            higher than that of other views.
        psnr_baked: PSNR of the baked model's pictures against the model's own, before numbers are rounded to the file's
            precision; None if it was not measured.
        psnr: PSNR of the file's pictures, as read back from its bytes, against the model's own.
        photos_model, photos_file: PSNR of the model's and of the file's pictures against held-out photos, if given.
        exposure: exposure of the splats in the file, "local" or "consistent"; None for a model without an exposure map.
            The model's pictures for `psnr_baked`, `psnr` and `photos_model` have the same exposure.
        psnr_by_exposure: PSNR of baked splats with local and with consistent exposure, before rounding, against the
            model's pictures as photographed. Empty without an exposure map, or if it was not measured.
        photos_by_exposure: PSNR of the same splats against held-out photos, if given.
        chunks: number of chunks in a folder with levels of detail.
        level_gaussians: their Gaussians at each level, the finest first, without the background's.
        cameras: number of cameras in a file of points or of cameras.
        vertices, faces: number of vertices and of triangles of a mesh.
        voxel: side of the voxels in which a mesh was fused, world units; None for other files.
        wall: thickness of the walls of a closed mesh for physics engines, world units; None for other files.
        surface_to_mesh, mesh_to_surface: distances from the surface of the model to such a mesh, and from the mesh to
            the surface: mean and 95th percentile, world units. Half of the mesh is the back of walls.
    """

    file: str
    bytes: int
    gaussians: int = 0
    native: bool = False
    background: int = 0
    degree: int = 0
    chosen_by: dict[int, float] = field(default_factory=dict)
    views: int = 0
    views_fitted: bool = False
    psnr_baked: float | None = None
    psnr: float | None = None
    photos_model: float | None = None
    photos_file: float | None = None
    exposure: str | None = None
    psnr_by_exposure: dict[str, float] = field(default_factory=dict)
    photos_by_exposure: dict[str, float] = field(default_factory=dict)
    chunks: int = 0
    level_gaussians: list[int] = field(default_factory=list)
    cameras: int = 0
    vertices: int = 0
    faces: int = 0
    voxel: float | None = None
    wall: float | None = None
    surface_to_mesh: tuple[float, float] | None = None
    mesh_to_surface: tuple[float, float] | None = None
