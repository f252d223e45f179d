"""Crop the models of blocks to their cells and write them as one file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hyrfpack.blocks.exposure import align_log_gains
from hyrfpack.blocks.plan import BlockPlan
from hyrfpack.cameras.capture import scene_provenance
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.format.codec import encode_model, load_with_provenance
from hyrfpack.format.info import FileReport
from hyrfpack.format.parts import write_parts
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import world_positions
from hyrfpack.scene import Scene
from hyrfpack.train.exposure_map import fit_exposure_map


@dataclass(frozen=True)
class MergedBlocks:
    """The file of all blocks.

    Attributes:
        file: what was written.
        kept: number of Gaussians of each block in the file, in the order of the plan.
    """

    file: FileReport
    kept: list[int]


def merge_blocks(
    scene: Scene,
    plan: BlockPlan,
    models: Sequence[Path],
    log_gains: Sequence[Mapping[str, np.ndarray]],
    target: Path,
    *,
    overwrite: bool,
) -> MergedBlocks:
    """Write the Gaussians that each block has in its own cells as the parts of one merged file.

    The models of blocks are read one after the other. Their colours are brought to one exposure, and all parts get the
    same exposure map. The background of the file is that of the block with the most photos that has one.

    Args:
        scene: the whole scene.
        plan: its blocks.
        models: the file of each block.
        log_gains: the log gains (3,) of each block's photos, by name; empty if it has learnt none.
        target: the file to write.
        overwrite: replace a file at `target`. Without it, a free name beside it is used.

    Raises:
        HyrfTrainingError: no block has a Gaussian in its own cells.
        HyrfError: a model cannot be read, or the file cannot be written.
    """
    offsets, photo_gains = align_log_gains(log_gains)
    viewpoint = scene_provenance(scene)["viewpoint"]
    parts: list[tuple[bool, str, bytes]] = []
    kept = []
    for block, path, offset in zip(plan.blocks, models, offsets, strict=True):
        model, provenance = load_with_provenance(path)
        keep = plan.core_mask(block, world_positions(model))
        kept.append(int(keep.sum()))
        if not keep.any():
            continue
        part = model.subset(torch.from_numpy(np.flatnonzero(keep)))
        _set_exposure(part, offset, scene, photo_gains)
        data = encode_model(part, "raw", {**provenance, "viewpoint": viewpoint})
        parts.append((model.config.background, f"block {block.name}", data))
    if not parts:
        raise HyrfTrainingError(
            f"{target}: no block has a Gaussian in its own cells", fix="train with a larger budget, or without `blocks`"
        )
    parts.sort(key=lambda part: not part[0])  # The first part is the one whose background is drawn.
    return MergedBlocks(write_parts([part[1:] for part in parts], target, overwrite=overwrite), kept)


def _set_exposure(model: HybridModel, offset: np.ndarray, scene: Scene, photo_gains: Mapping[str, np.ndarray]) -> None:
    """Raise the log odds of all colours of a model by `offset` (3,), and give it the exposure map of all photos."""
    if not photo_gains:
        return
    model.radiance.biases[-1].data += torch.from_numpy(offset).float()
    views = [view for view in scene.train if view.name in photo_gains]
    poses = [model.config.frame.local_pose(view.camera) for view in views]
    model.exposure = fit_exposure_map(poses, np.array([photo_gains[view.name] for view in views])).map
