"""Split a model into a scene folder: chunks at several levels of detail, and a manifest with their errors."""

from __future__ import annotations

import contextlib
import logging
import math
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from hyrfpack.cameras.capture import MIN_COARSE_CAMERAS, MISMATCH_REMEDY, Capture, place_photos
from hyrfpack.cameras.files import camera_to_numbers
from hyrfpack.cameras.view_sampling import resize_camera, sample_views
from hyrfpack.checks import check_type, remove_control_characters
from hyrfpack.config.split import MAX_TITLE_LENGTH, SplitConfig
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfDataError, HyrfError, HyrfFormatError
from hyrfpack.format.container import Container, read_container
from hyrfpack.format.decode import decode_container
from hyrfpack.format.info import describe_file
from hyrfpack.format.part_names import ONE_PART_NAME, list_parts
from hyrfpack.format.parts import decode_parts
from hyrfpack.format.run_folder import find_model, is_run_folder, name_model
from hyrfpack.format.scene_folder import SceneFolder, is_scene
from hyrfpack.format.scene_manifest import (
    MANIFEST_NAME,
    MAX_CHUNKS,
    MAX_MANIFEST_BYTES,
    Chunk,
    ChunkLevel,
    Manifest,
    ScenePart,
    parse_manifest,
)
from hyrfpack.format.scene_model import join_parts
from hyrfpack.format.sections import SECTION_CONTENTS
from hyrfpack.format.shared import open_shared
from hyrfpack.lock import exclusive_folder
from hyrfpack.lod.encode import ChunkEncoder
from hyrfpack.lod.errors import ERROR_RADII, measure_level_errors
from hyrfpack.lod.merge import merge_gaussians
from hyrfpack.lod.partition import partition
from hyrfpack.lod.refit import refit_level
from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.merged import MergedModel, parts_of
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.outputs import Outputs, StrPath
from hyrfpack.outputs.indexed_folder import IndexedFolder
from hyrfpack.progress import Progress, TaskEvent, part_of_progress
from hyrfpack.scene import Camera, Scene, evenly_spaced

_LOG = logging.getLogger(__name__)

SHARED_NAME = "shared.hyrf"
# The next coarser level has fewer Gaussians by this ratio, and is for pictures with as many times fewer pixels.
GAUSSIANS_RATIO_OF_LEVELS = 4
MERGE_VIEWPOINTS = 8
REFIT_VIEWS_BETWEEN_CAMERAS = 3  # for each view at a camera, this many views between it and its neighbours
# Limits for each part and for all parts together, because views take memory and time.
REFIT_CAMERAS_PER_PART, MAX_REFIT_CAMERAS = 12, 48
MEASURED_VIEWS_PER_PART, MAX_MEASURED_VIEWS = 24, 64
_SEED_STEP = 1000  # so that levels are not fitted to the views at which their errors are measured
MAX_BOX_GROWTH_DIAGONAL_RATIO = 1e-5
_MIN_BOX_SIZE = 1e-30
_BOX_MARGIN_SIGMAS = 3.0
_REFIT_PROGRESS_SHARE, _MEASURE_PROGRESS_SHARE = 0.6, 0.3


@dataclass(frozen=True)
class SplitReport:
    """The files that `split_model` has written.

    Attributes:
        folder: path of the folder.
        gaussians: Gaussians of the model, and so of the finest levels.
        chunks: number of chunks.
        bytes: bytes of all files but the manifest.
        bytes_source: bytes of the file that was split.
        bytes_finest: bytes of the shared files and the finest levels.
        level_gaussians, level_bytes: Gaussians and bytes of all chunks at each level, the finest first.
    """

    folder: str
    gaussians: int
    chunks: int
    bytes: int
    bytes_source: int
    bytes_finest: int
    level_gaussians: list[int]
    level_bytes: list[int]

    def to_dict(self) -> dict:
        """Return the report as numbers, strings and lists for JSON."""
        return asdict(self)


def split_model(
    source: StrPath,
    target: StrPath,
    config: SplitConfig | None = None,
    *,
    data: Scene | None = None,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> SplitReport:
    """Split a model into a scene folder: chunks of nearby Gaussians, each at several levels of detail.

    The finest level of all chunks is the model: positions and fields are kept exactly, logits exactly or with steps
    finer than those of the file. Coarser levels are merged, fitted to renders of the model, and their errors in
    pictures are measured, at and between the cameras of `data` or of the file. Each part of a merged file has chunks of
    its own, but pictures show all parts.

    Args:
        source: a `.hyrf` file or the folder of a run.
        target: folder to write; created if it is missing.
        config: the settings; None for the defaults.
        data: photos of the scene, whose training cameras are used. A compressed file keeps few cameras, so errors of
            its levels fit views near the photos less well.
        overwrite: replace a scene in the folder. If False, existing files are an error.
        context: progress.

    Raises:
        HyrfError: the file cannot be read or holds no Gaussian, or the folder cannot be written or would be too large.
        HyrfDataError: the photos do not belong to the model, or to the first one of a merged file.
        TypeError: `config` is not a SplitConfig, or `data` is not a Scene.

    Example:
        >>> import hyrfpack
        >>> config = hyrfpack.SplitConfig(chunk_gaussians=64, levels=2, refit_steps=2)
        >>> report = hyrfpack.split_model("bonsai.hyrf", "bonsai-scene", config)
        >>> len(hyrfpack.load_model("bonsai-scene")) == report.gaussians, len(report.level_bytes)
        (True, 2)
    """
    config = SplitConfig() if config is None else config
    check_type("config", config, SplitConfig)
    if data is not None:
        check_type("data", data, Scene)
    if is_scene(source):
        raise HyrfError(
            f"{source}: this is a scene of several files already", fix="split the model from which it was made"
        )
    path, target = find_model(source), Path(target)
    if is_run_folder(target):
        raise HyrfError(
            f"{target}: this folder holds a training run, which would be read in place of the scene",
            fix="name another folder",
        )
    shared_names = _name_shared_files(path)
    # A chunk of the scene that would be replaced is no source: the old files are removed.
    planned = [MANIFEST_NAME, *shared_names, *_list_old_files(target)]
    Outputs(*_list_inputs(path), scene=data, overwrite=True).folder(target, planned)
    facts = describe_file(path)
    data = place_photos(facts, data)
    if mismatch := Capture(facts, data).mismatch:
        raise HyrfDataError(mismatch, fix=MISMATCH_REMEDY)
    outputs = Outputs(*_list_inputs(path), scene=data, overwrite=overwrite)
    with exclusive_folder(target), context.open_progress("split") as progress:
        outputs.folder(target, [MANIFEST_NAME, *shared_names])
        files, manifest = _encode_scene(path, shared_names, name_model(source), config, data, progress)
        outputs.folder(target, files)
        _check_manifest(manifest, target / MANIFEST_NAME)
        _write_folder(target, files, manifest, overwrite)
    levels = list(zip(*(chunk.levels for chunk in manifest.chunks), strict=True))
    level_bytes = [sum(item.bytes for item in level) for level in levels]
    return SplitReport(
        str(target),
        manifest.gaussians,
        len(manifest.chunks),
        manifest.total_bytes,
        path.stat().st_size,
        manifest.shared_bytes + level_bytes[0],
        [sum(item.gaussians for item in level) for level in levels],
        level_bytes,
    )


@dataclass(frozen=True)
class _Part:
    """A part of the scene that is split.

    Attributes:
        name: name of the part.
        encoder: the encoder of the part's chunks.
        geometry: geometry of the part's Gaussians.
        groups: indices of the Gaussians of each chunk, in the order of the chunk's file.
        finest: bytes of each chunk at the finest level.
    """

    name: str
    encoder: ChunkEncoder
    geometry: Geometry
    groups: list[np.ndarray]
    finest: list[bytes]

    @classmethod
    def divide(cls, name: str, encoder: ChunkEncoder, chunk_gaussians: int) -> _Part:
        """Divide the Gaussians of a part into chunks, and encode the finest level of each."""
        model = encoder.model
        cube = model.cube_coords(model.gaussians.positions.detach().double()).numpy()
        encoded = [encoder.encode_subset(group) for group in partition(cube, chunk_gaussians) if len(group)]
        groups = [order for _, order in encoded]
        return cls(name, encoder, model.decode_geometry(), groups, [data for data, _ in encoded])

    @property
    def model(self) -> HybridModel:
        """Return the model of all Gaussians of the part."""
        return self.encoder.model


def _list_inputs(path: Path) -> list[str]:
    """Return the paths of a file and of the other file that its sections refer to, if it is a chunk of a scene."""
    with Container.open(path, SECTION_CONTENTS) as container:
        return [str(path), open_shared(container).name]


def _name_shared_files(path: Path) -> list[str]:
    """Return the name of the shared file of each part of a file."""
    with Container.open(path, SECTION_CONTENTS) as container:
        count = len(list_parts(container))
    return [SHARED_NAME] if count == 1 else [f"shared-{number:02d}.hyrf" for number in range(count)]


def _encode_scene(
    path: Path, shared_names: Sequence[str], name: str, config: SplitConfig, photos: Scene | None, progress: Progress
) -> tuple[dict[str, bytes], Manifest]:
    """Return the files of the folder by name, without the manifest, and the manifest."""
    progress(TaskEvent("reading the model", 0.0))
    facts = describe_file(path)
    model, parts = _read_parts(path, shared_names, config.chunk_gaussians)
    cameras = [view.camera for view in photos.train] if photos and photos.train else _list_cameras(facts)
    part_numbers = [number for number, part in enumerate(parts) for _ in part.groups]
    refitting = part_of_progress(progress, 0.0, _REFIT_PROGRESS_SHARE)
    encoded, models = _encode_levels(parts, part_numbers, model, cameras, config, refitting)
    boxes = [box for part in parts for box in _measure_boxes(part)]
    spheres = [(chunk.center, chunk.radius) for chunk in (Chunk(low, high, ()) for low, high in boxes)]
    measuring = part_of_progress(progress, _REFIT_PROGRESS_SHARE, _REFIT_PROGRESS_SHARE + _MEASURE_PROGRESS_SHARE)
    count = min(MEASURED_VIEWS_PER_PART * len(parts), MAX_MEASURED_VIEWS)
    views = sample_views(cameras, count, config.seed + 1)[1] if config.levels > 1 else []
    errors = measure_level_errors(
        models, spheres, views, [part.model for part in parts], part_numbers, config.seed, measuring
    )
    files = {part.encoder.shared_name: part.encoder.shared_bytes for part in parts}
    chunks = []
    for number, (low, high) in enumerate(boxes):
        levels = []
        for level, chunks_of_level in enumerate(encoded):
            data = chunks_of_level[number]
            file = f"chunk-{number:04d}-{level}.hyrf"
            files[file] = data
            stated = tuple(float(f"{error:.4g}") for error in errors[level, number])
            levels.append(ChunkLevel(file, len(data), _checksum(data), len(models[level][number]), stated))
        chunks.append(Chunk(low, high, tuple(levels), part_numbers[number]))
    return files, _make_manifest(parts, chunks, Capture(facts, photos), name, config)


def _encode_levels(
    parts: Sequence[_Part],
    part_numbers: Sequence[int],
    finest: HybridModel | MergedModel,
    cameras: Sequence[Camera],
    config: SplitConfig,
    progress: Progress,
) -> tuple[list[list[bytes]], list[list[HybridModel]]]:
    """Encode all chunks at all levels. The arguments are those of `_make_level`.

    Returns:
        For each level, the finest first: the bytes of each chunk, and its model as readers will decode it.
    """
    encoded = [[data for part in parts for data in part.finest]]
    models = [[part.model.subset(torch.from_numpy(group)) for part in parts for group in part.groups]]
    encoders = [parts[number].encoder for number in part_numbers]
    coarse_count = config.levels - 1
    for level in range(1, config.levels):
        share = part_of_progress(progress, (level - 1) / coarse_count, level / coarse_count)
        coarse = _make_level(parts, part_numbers, finest, cameras, level, config, share)
        encoded.append([encoder.encode_gaussians(chunk) for encoder, chunk in zip(encoders, coarse, strict=True)])
        models.append([_decode(data, encoder) for data, encoder in zip(encoded[-1], encoders, strict=True)])
    return encoded, models


def _read_parts(
    path: Path, shared_names: Sequence[str], chunk_gaussians: int
) -> tuple[HybridModel | MergedModel, list[_Part]]:
    """Read a file; return its model and its parts, each divided into chunks. A single model is the only part.

    Raises:
        HyrfError: the file cannot be read or holds no Gaussian, or mixes models that are antialiased and others.
    """
    with Container.open(path, SECTION_CONTENTS) as container:
        decoded = decode_parts(container)
        if not len(decoded):
            raise HyrfError(f"{path}: there is no Gaussian in it, so there is nothing to split", fix="train it again")
        models, parts = parts_of(decoded), []
        for number, (name, part) in enumerate(list_parts(container)):
            encoder = ChunkEncoder(part, models[number], shared_names[number])
            parts.append(_Part.divide(name, encoder, chunk_gaussians))
    return decoded, parts


def _list_cameras(facts: dict) -> list[Camera]:
    """Return the cameras of all parts of a file, without repetitions; an orbit around the scene if none are known."""
    captures = [capture for capture in map(Capture, facts.get("parts", [facts])) if not capture.is_synthetic]
    if not captures:
        return Capture(facts).cameras
    cameras = [camera for capture in captures for camera in capture.cameras]
    return list({tuple(camera_to_numbers(camera)): camera for camera in cameras}.values())


def _make_level(
    parts: Sequence[_Part],
    part_numbers: Sequence[int],
    finest: HybridModel | MergedModel,
    cameras: Sequence[Camera],
    level: int,
    config: SplitConfig,
    progress: Progress,
) -> list[HybridModel]:
    """Merge the Gaussians of each chunk to a coarse level, fit them, and return the model of each chunk.

    Args:
        parts: parts of the scene.
        part_numbers: number of the part of each chunk.
        finest: the model of the finest level of all parts.
        cameras: cameras of the scene.
        level: number of the level, at least 1.
        config: settings of the split.
        progress: called with `TaskEvent`s.
    """
    world_viewpoints = [camera.position for camera in sample_views(cameras, MERGE_VIEWPOINTS, config.seed)[0]]
    merged = []
    for part in parts:
        model, frame = part.model, part.model.config.frame
        viewpoints = [
            tensor_like(frame.to_local(viewpoint).tolist(), model.gaussians.positions) for viewpoint in world_viewpoints
        ]
        for group in part.groups:
            index = torch.from_numpy(group)
            count = max(1, len(group) // GAUSSIANS_RATIO_OF_LEVELS**level)
            gaussians = merge_gaussians(model.subset(index), part.geometry[index], viewpoints, count)
            merged.append(model.with_gaussians(gaussians))
    joined = join_parts([part.name for part in parts], [part.model for part in parts], merged, part_numbers)
    resolution_ratio = GAUSSIANS_RATIO_OF_LEVELS ** (-level / 2)
    count = min(REFIT_CAMERAS_PER_PART * len(parts), MAX_REFIT_CAMERAS)
    views = [resize_camera(camera, resolution_ratio) for camera in _refit_views(cameras, count, config.seed)]
    refit_level(joined, finest, views, config.refit_steps * len(parts), config.seed, progress)
    fitted = []
    for number, model in enumerate(parts_of(joined)):
        counts = [len(chunk) for chunk, part in zip(merged, part_numbers, strict=True) if part == number]
        fitted += [model.subset(index) for index in torch.arange(len(model)).split(counts)]
    return fitted


def _refit_views(cameras: Sequence[Camera], count: int, seed: int) -> list[Camera]:
    """Return views at `count` cameras, and for each of them several between it and its neighbours."""
    at, between = sample_views(cameras, count, seed)
    more = [
        sample_views(cameras, count, seed + _SEED_STEP * number)[1] for number in range(1, REFIT_VIEWS_BETWEEN_CAMERAS)
    ]
    return [*at, *between, *(view for views in more for view in views)]


def _decode(data: bytes, encoder: ChunkEncoder) -> HybridModel:
    """Return the model of a chunk as readers will decode it."""
    container = read_container(data, SECTION_CONTENTS)
    container.open_file = lambda name: read_container(encoder.shared_bytes, SECTION_CONTENTS, name)
    return decode_container(container, encoder.model)


def _measure_boxes(part: _Part) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
    """Return the corners of the box of each chunk of a part in world units, three standard deviations included."""
    frame = part.model.config.frame
    means = frame.to_world(part.model.gaussians.positions.numpy())
    radii = _BOX_MARGIN_SIGMAS * frame.scale * part.geometry.scales.amax(dim=1).double().numpy()
    boxes = []
    for group in part.groups:
        low = (means[group] - radii[group, None]).min(axis=0)
        high = (means[group] + radii[group, None]).max(axis=0)
        boxes.append(_round_outwards(low, high))
    return boxes


def _round_outwards(low: np.ndarray, high: np.ndarray) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Round the corners of a box outwards to few decimal places.

    Each side grows by at most MAX_BOX_GROWTH_DIAGONAL_RATIO of the diagonal. The number of decimal places depends on
    the diagonal and not on the coordinates, which may be large map coordinates.
    """
    size = float(np.linalg.norm(high - low))
    decimals = math.ceil(-math.log10(MAX_BOX_GROWTH_DIAGONAL_RATIO * max(size, _MIN_BOX_SIZE)))

    def round_down(value: float) -> float:
        rounded = round(value, decimals)
        return rounded if rounded <= value else min(round(rounded - 10.0**-decimals, decimals), value)

    lows, highs = map(round_down, low.tolist()), map(round_down, (-high).tolist())
    (a, b, c), (d, e, f) = lows, highs
    return (a, b, c), (-d, -e, -f)


def _checksum(data: bytes) -> str:
    """Return the checksum of a file as a manifest states it: CRC-32 as eight hexadecimal digits."""
    return f"{zlib.crc32(data):08x}"


def _make_manifest(
    parts: Sequence[_Part], chunks: list[Chunk], capture: Capture, name: str, config: SplitConfig
) -> Manifest:
    """Return the manifest of a scene folder: its files, and the cameras and the viewpoint that readers need first."""
    values = parts[0].model.config.to_dict()
    encoders = [part.encoder for part in parts]
    shared = [(encoder.shared_name, len(encoder.shared_bytes), _checksum(encoder.shared_bytes)) for encoder in encoders]
    names = [part.name for part in parts] if len(parts) > 1 else [ONE_PART_NAME]
    cameras = [] if capture.is_synthetic else evenly_spaced(capture.cameras, MIN_COARSE_CAMERAS)
    return Manifest(
        gaussians=sum(len(part.model) for part in parts),
        parts=tuple(ScenePart(*file, name) for file, name in zip(shared, names, strict=True)),
        chunks=tuple(chunks),
        error_radii=ERROR_RADII,
        frame=values["frame"],
        background=values["background"],
        solid=tuple(values["solid"]),
        viewpoint=capture.viewpoint.to_json(rounded=True),
        cameras=tuple(tuple(camera_to_numbers(camera)) for camera in cameras),
        title=remove_control_characters(name)[:MAX_TITLE_LENGTH] if config.title is None else config.title,
        licence=config.licence,
    )


def _check_manifest(manifest: Manifest, path: Path) -> None:
    """Raise HyrfError unless readers will accept the manifest; its size and its number of chunks are limited."""
    data = manifest.to_json()
    try:
        parse_manifest(data, str(path))
    except HyrfFormatError as error:
        if len(data) <= MAX_MANIFEST_BYTES and len(manifest.chunks) <= MAX_CHUNKS:
            raise HyrfError(error.problem, fix="train the model again") from error
        raise HyrfError(
            error.problem, fix="split into fewer chunks with a larger `chunk_gaussians`, or into fewer `levels`"
        ) from error


def _write_folder(folder: Path, files: dict[str, bytes], manifest: Manifest, overwrite: bool) -> None:
    """Replace the files of a folder, the manifest last; files of an old scene that the new one lacks are removed."""
    old = _list_old_files(folder) if overwrite else []
    with IndexedFolder(folder, MANIFEST_NAME, overwrite) as output:
        for name, data in files.items():
            output.write(name, data)
        output.write(MANIFEST_NAME, manifest.to_json())
    for name in set(old) - set(files):
        with contextlib.suppress(OSError):
            (folder / name).unlink()


def _list_old_files(folder: Path) -> list[str]:
    """Return the names of the files of the scene that a folder holds; none if it holds no valid one."""
    try:
        return [item.file for item in SceneFolder(folder).manifest.files]
    except HyrfFormatError:
        return []
