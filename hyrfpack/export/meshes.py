"""Export of the surface of a model as a triangle mesh, with colours or as a closed shape for physics engines."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.choices import AS_PHOTOGRAPHED, CONSISTENT_EXPOSURE
from hyrfpack.config.export import DEFAULT_COLLISION_FACES, ExportConfig
from hyrfpack.export.kinds import make_selection_mask
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.mesh import Mesh, extract_mesh
from hyrfpack.mesh.files import encode_mesh
from hyrfpack.mesh.solid import make_proxy
from hyrfpack.model.merged import world_positions
from hyrfpack.progress import Progress, TaskEvent, part_of_progress
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
    mesh = _extract_opaque_surface(loaded, config, config.faces, colored=True, progress=progress)
    data = encode_mesh(mesh, kind.ending.rpartition(".")[2], loaded.up)
    written_path = write_atomic(target, data, overwrite=overwrite)
    return ExportReport(
        str(written_path), len(data), vertices=len(mesh.vertices), faces=len(mesh.faces), voxel=mesh.voxel
    )


def write_collision_mesh(
    loaded: Source,
    target: str | os.PathLike[str],
    kind: FileKind,
    config: ExportConfig,
    overwrite: bool,
    progress: Progress,
) -> ExportReport:
    """Extract the surface of a model and write a closed mesh of few triangles, for physics engines.

    Arguments and errors are those of `write_mesh`; `kind` is one of `kinds.COLLISION_FILES`.
    """
    mesh = _extract_opaque_surface(loaded, config, None, colored=False, progress=part_of_progress(progress, 0, 0.8))
    progress(TaskEvent("closing the surface", 0.8))
    count = DEFAULT_COLLISION_FACES if config.faces is None else config.faces
    proxy = make_proxy(mesh.vertices, mesh.faces, mesh.voxel, count)
    closed = replace(mesh, vertices=proxy.vertices, faces=proxy.faces)
    data = encode_mesh(closed, kind.ending.rpartition(".")[2], loaded.up)
    written_path = write_atomic(target, data, overwrite=overwrite)
    return ExportReport(
        str(written_path),
        len(data),
        vertices=len(proxy.vertices),
        faces=len(proxy.faces),
        voxel=mesh.voxel,
        wall=proxy.wall,
        surface_to_mesh=_summarize_distances(proxy.surface_distances),
        mesh_to_surface=_summarize_distances(proxy.proxy_distances),
    )


def _summarize_distances(distances: np.ndarray) -> tuple[float, float]:
    """Return the mean and the 95th percentile of distances."""
    return float(distances.mean()), float(np.quantile(distances, 0.95))


def _extract_opaque_surface(
    loaded: Source, config: ExportConfig, faces: int | None, colored: bool, progress: Progress
) -> Mesh:
    """Extract the surface of the Gaussians that are opaque enough."""
    model = loaded.all_parts
    if config.min_opacity > 0:
        with torch.no_grad():
            opacities = model.decode_geometry().opacities.numpy()
        keep = make_selection_mask(world_positions(model), opacities, None, config.min_opacity)
        model = model.subset(torch.from_numpy(keep).nonzero()[:, 0])
    return extract_mesh(
        model,
        loaded.fit_cameras,
        loaded.center,
        crop=config.crop,
        voxel=config.voxel,
        faces=faces,
        exposure=CONSISTENT_EXPOSURE if config.exposure == CONSISTENT_EXPOSURE else AS_PHOTOGRAPHED,
        colored=colored,
        progress=progress,
    )
