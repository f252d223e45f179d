"""Export of the surface of a model as a triangle mesh."""

from __future__ import annotations

import os

import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.choices import AS_PHOTOGRAPHED, CONSISTENT_EXPOSURE
from hyrfpack.config.export import ExportConfig
from hyrfpack.export.kinds import selection_mask
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.mesh import extract_mesh
from hyrfpack.mesh.files import encode_mesh
from hyrfpack.progress import Progress
from hyrfpack.splats.table import FileKind


def write_mesh(
    loaded: Source,
    target: str | os.PathLike[str],
    kind: FileKind,
    config: ExportConfig,
    overwrite: bool,
    progress: Progress,
) -> ExportReport:
    """Extract the surface of a model and write it as a mesh.

    Args:
        loaded: the model with its cameras.
        target: the file to write.
        kind: one of `kinds.MESH_FILES`.
        config: `crop`, `min_opacity`, `exposure`, `voxel` and `faces` are used.
        overwrite: replace an existing file.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: no surface is in view, the voxels are too small, a package is missing, or the file cannot be written.
    """
    model = loaded.model
    if config.min_opacity > 0:
        with torch.no_grad():
            opacities = model.decode_geometry().opacities.numpy()
        positions = model.config.frame.to_world(model.gaussians.positions.detach().numpy())
        keep = selection_mask(positions, opacities, None, config.min_opacity)
        model = model.subset(torch.from_numpy(keep).nonzero()[:, 0])
    mesh = extract_mesh(
        model,
        loaded.fit_cameras,
        loaded.center,
        crop=config.crop,
        voxel=config.voxel,
        faces=config.faces,
        exposure=CONSISTENT_EXPOSURE if config.exposure == CONSISTENT_EXPOSURE else AS_PHOTOGRAPHED,
        progress=progress,
    )
    data = encode_mesh(mesh, kind.ending.rpartition(".")[2], loaded.up)
    written = write_atomic(target, data, overwrite=overwrite)
    return ExportReport(str(written), len(data), vertices=len(mesh.vertices), faces=len(mesh.faces), voxel=mesh.voxel)
