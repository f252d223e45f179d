"""Encoding of a HybridModel to the bytes of a `.hyrf` file and back; `docs/reference/format.md` specifies each byte."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.capture import quantized_provenance
from hyrfpack.checks import check_type
from hyrfpack.device import choose_device
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import compact, paper, raw
from hyrfpack.format.arrays import MODEL_RULES
from hyrfpack.format.container import Container, Section, raw_bytes_limit, read_container, write_container
from hyrfpack.format.decode import decode_container
from hyrfpack.format.exposure import encode_exposure
from hyrfpack.format.info import FileReport, section_sizes
from hyrfpack.format.input_folder import find_input_folder
from hyrfpack.format.metadata import Metadata, gaussian_limit, read_metadata
from hyrfpack.format.part_names import list_parts
from hyrfpack.format.parts import write_parts
from hyrfpack.format.run_folder import find_model
from hyrfpack.format.scene_folder import SceneFolder, is_scene, refuse_fraction
from hyrfpack.format.sections import NON_PARAMETER_SECTIONS, POSITIONS, SECTION_CONTENTS, group_and_layer
from hyrfpack.format.shared import read_provenance
from hyrfpack.format.versions import lowest_minor_version
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.model.merged import parts_of
from hyrfpack.outputs import Outputs

PROFILES: dict[str, Callable[..., tuple[list[Section], dict]]] = {
    "raw": raw.encode,
    "paper": paper.encode,
    "compact": compact.encode,
}


def encode_model(model: HybridModel, profile: str = "raw", provenance: dict | None = None, **settings: Any) -> bytes:
    """Encode a model as the bytes of a `.hyrf` file. The same model and settings give the same bytes.

    Args:
        model: the model, on any device.
        profile: "raw" (float32, exact), "paper" (see `hyrfpack.format.paper`) or "compact" (`hyrfpack.format.compact`).
        provenance: any JSON object that says where the model comes from. It is stored for readers of the file.
        settings: settings of the profile: for "paper" the fields of `hyrfpack.PaperSettings`, for "compact" the
            `quantized` numbers from `hyrfpack.compress.quantize.quantize`; "raw" has none.

    Raises:
        HyrfError: the profile does not exist, a parameter is NaN, infinite or too large for the profile, or the
            provenance is not JSON or too large.
        TypeError: `model` is not a HybridModel.
    """
    check_type("model", model, HybridModel)
    if profile not in PROFILES:
        raise HyrfError(f"there is no profile '{profile}'", fix=f"use one of: {', '.join(PROFILES)}")
    if profile == "compact" and "quantized" not in settings:
        raise HyrfError(
            "profile 'compact' takes numbers that were quantised beforehand",
            fix="save the model with profile 'raw', and compress that file with `hyrfpack.compress_model`",
        )
    sections, profile_settings = PROFILES[profile](model, **settings)
    layer_counts = [section.raw_length // 12 for section in sections if group_and_layer(section.type)[0] == POSITIONS]
    gaussian_count = sum(layer_counts)
    metadata = Metadata(
        profile,
        gaussian_count,
        model.config.to_dict(),
        MODEL_RULES,
        profile_settings,
        provenance or {},
        layers=layer_counts if len(layer_counts) > 1 else [],
    )
    if model.exposure is not None:
        sections = [encode_exposure(model.exposure), *sections]
    sections = [metadata.to_section(deflate=profile == "compact"), *sections]
    stored_bytes = sum(len(section.data) for section in sections)
    raw_bytes = sum(section.raw_length for section in sections)
    if raw_bytes > raw_bytes_limit(stored_bytes) or gaussian_count > gaussian_limit(stored_bytes):
        raise HyrfError(
            f"{raw_bytes:,} bytes of almost equal numbers would compress to {stored_bytes:,} bytes, a ratio that "
            "readers refuse",
            fix="use profile 'raw' for this model",
        )
    return write_container(sections, minor=lowest_minor_version(sections, metadata.config))


def decode_model(
    data: bytes | memoryview,
    device: str | torch.device = "cpu",
    name: str = "the data",
    fraction: float | None = None,
) -> HybridModel:
    """Decode a model from the bytes of a `.hyrf` file. It is safe on untrusted input.

    The parameters do not require gradients, so that renders carry no autograd graph; `model.requires_grad_()` changes
    that.

    Args:
        data: the bytes of the file.
        device: device of the parameters, see `hyrfpack.device.choose_device`.
        name: name of the file in error messages.
        fraction: read only this fraction of the file, 0 to 1, from its first byte; the rest may be missing. Files of
            profile "compact" are stored in layers, and the complete layers make a coarser model. None reads the whole
            file.

    Raises:
        HyrfFormatError: the bytes are damaged, inconsistent, or of a newer format version.
        HyrfError: the device is not available.
    """
    device = choose_device(device)
    return decode_container(read_container(data, SECTION_CONTENTS, name, fraction)).to(device)


def save_model(
    model: HybridModel,
    path: str | os.PathLike[str],
    profile: str = "raw",
    provenance: dict | None = None,
    *,
    overwrite: bool = True,
    **settings: Any,
) -> FileReport:
    """Write a model to a `.hyrf` file, completely or not at all.

    The other arguments and errors are those of `encode_model`.

    Args:
        overwrite: replace a file at `path`. Without it, a free file name in the same folder is used; `report.file`
            is the path that was written.

    Raises:
        HyrfError: the file cannot be written, or an error of `encode_model`.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load_model("bonsai.hyrf")
        >>> report = hyrfpack.save_model(model, "copy.hyrf", provenance={"note": "by hand"})
        >>> report.profile, report.gaussians == len(model)
        ('raw', True)
    """
    return write_model(encode_model(model, profile, provenance, **settings), path, overwrite=overwrite)


def write_model(data: bytes, path: str | os.PathLike[str], *, overwrite: bool = True) -> FileReport:
    """Write the bytes that `encode_model` returned to a file, completely or not at all.

    `overwrite` is that of `save_model`.

    Raises:
        HyrfError: the file cannot be written.
    """
    written = write_atomic(path, data, overwrite=overwrite)
    container = read_container(data, SECTION_CONTENTS)
    metadata, sizes = read_metadata(container), section_sizes(container)
    before = sum(size.before for size in sizes if size.type not in NON_PARAMETER_SECTIONS)
    return FileReport(str(written), metadata.profile, metadata.gaussians, before, len(data), sizes)


def load_model(
    path: str | os.PathLike[str], device: str | torch.device = "cpu", fraction: float | None = None
) -> HybridModel:
    """Read a model from a `.hyrf` file, from the folder of a training run, or from a scene folder of one model.

    Of a scene folder (`hyrfpack.split_model`), all chunks are read at the finest level; it has no layers, so `fraction`
    must be None. The other arguments and the errors are those of `decode_model`.

    Args:
        path: a `.hyrf` file, the folder of a training run, or a scene folder.

    Raises:
        HyrfFormatError: there is no readable file at `path`, or an error of `decode_model`.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load_model("bonsai.hyrf")
        >>> model.gaussians.positions.shape[1], model.gaussians.positions.requires_grad
        (3, False)
    """
    device = choose_device(device)
    return load_with_provenance(path, fraction)[0].to(device)


def repack(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    profile: str = "raw",
    fraction: float | None = None,
    *,
    overwrite: bool = True,
    **settings: Any,
) -> FileReport:
    """Rewrite a `.hyrf` file, a merged one or a scene folder with profile "raw" or "paper", and copy its provenance.

    Except for profile "raw", the cameras in the provenance are rounded, see `quantized_provenance`. The other
    arguments and the errors are those of `encode_model`, `load_model` and `save_model`.

    Args:
        overwrite: replace a file at `target`. Without it, an existing file is an error. A file that appears during the
            call is kept, and a free file name in the same folder is used, which the report contains.
    """
    source = find_model(source)
    Outputs(source, folders=[find_input_folder(source)], overwrite=overwrite).file(target)
    parts = []
    for name, model, provenance in load_parts(source, fraction):
        stored_provenance = provenance if profile == "raw" else packed_provenance(provenance, model)
        parts.append((name, encode_model(model, profile, stored_provenance, **settings)))
    if len(parts) > 1:
        return write_parts(parts, target, overwrite=overwrite)
    return write_model(parts[0][1], target, overwrite=overwrite)


def packed_provenance(provenance: dict, model: HybridModel) -> dict:
    """Shorten the provenance of a model for a compressed file, see `quantized_provenance`."""
    frame = model.config.frame
    return quantized_provenance(provenance, frame.scale, frame.to_world(model.gaussians.positions.numpy(force=True)))


def load_with_provenance(path: str | os.PathLike[str], fraction: float | None = None) -> tuple[HybridModel, dict]:
    """Read a model and its provenance. The arguments and the errors are those of `load_model`."""
    if is_scene(path):
        if len(parts := load_parts(path, fraction)) > 1:
            raise HyrfFormatError(
                f"{path}: this scene holds {len(parts)} merged models, and one model is needed",
                fix="join its chunks with 'hyrfpack decompress', and take one out with 'hyrfpack edit' and its `part`",
            )
        return parts[0][1:]
    with Container.open(path, SECTION_CONTENTS, fraction) as container:
        return decode_container(container), read_provenance(container)


def load_parts(path: str | os.PathLike[str], fraction: float | None = None) -> list[tuple[str, HybridModel, dict]]:
    """Read name, model and provenance of each part of a merged file or a scene folder, or of the one model of a file.

    The arguments and the errors are those of `load_model`.
    """
    if is_scene(path):
        refuse_fraction(path, fraction)
        scene = SceneFolder(path)
        models, names = parts_of(scene.load()), [part.name for part in scene.manifest.parts]
        return list(zip(names, models, scene.read_provenances(), strict=True))
    with Container.open(path, SECTION_CONTENTS, fraction) as container:
        parts = list_parts(container)
        return [(name, decode_container(part), read_provenance(part)) for name, part in parts]
