"""Merged files: several complete `.hyrf` files as sections of one, and a section with their names."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.device import choose_device
from hyrfpack.format.container import Container, Section, read_container, write_container
from hyrfpack.format.decode import decode_container
from hyrfpack.format.info import FileReport, section_sizes
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.part_names import CODEC_PART_FILE, ONE_PART_NAME, open_parts, write_part_names
from hyrfpack.format.scene_folder import SceneFolder, is_scene
from hyrfpack.format.sections import NON_PARAMETER_SECTIONS, PART_NAMES, SECTION_CONTENTS, part_section
from hyrfpack.format.versions import MERGED_MINOR_VERSION
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel


def encode_parts(parts: Sequence[tuple[str, bytes]]) -> bytes:
    """Encode a merged file of named parts, each the bytes of a `.hyrf` file of one model. The first is the scene.

    Raises:
        HyrfFormatError: a part is damaged or is not a file of one model, the parts together exceed the limits of a
            file, or some of them are antialiased and others are not.
        ValueError: a name is not valid, or two are equal.
    """
    sections = [write_part_names([name for name, _ in parts])]
    for number, (_, data) in enumerate(parts):
        sections.append(Section(part_section(number), CODEC_PART_FILE, data, len(data)))
    data = write_container(sections, minor=MERGED_MINOR_VERSION)
    open_parts(read_container(data, SECTION_CONTENTS, "the merged file"), limits_fix="merge fewer models")
    return data


def write_parts(
    parts: Sequence[tuple[str, bytes]], path: str | os.PathLike[str], *, overwrite: bool = True
) -> FileReport:
    """Write a merged file, completely or not at all. Arguments and errors: `encode_parts`.

    The report has the profile of the first part, and the bytes of all parts.
    """
    return write_merged(encode_parts(parts), path, overwrite=overwrite)


def write_merged(data: bytes, path: str | os.PathLike[str], *, overwrite: bool = True) -> FileReport:
    """Write the bytes of a merged file, completely or not at all; see `write_parts`."""
    written = write_atomic(path, data, overwrite=overwrite)
    container = read_container(data, SECTION_CONTENTS)
    parts = [part for _, part in open_parts(container)]
    metadata = [read_metadata(part) for part in parts]
    before = sum(
        size.before for part in parts for size in section_sizes(part) if size.type not in NON_PARAMETER_SECTIONS
    )
    count = sum(facts.gaussians for facts in metadata)
    return FileReport(str(written), metadata[0].profile, count, before, len(data), section_sizes(container))


def load_merged_model(path: str | os.PathLike[str], device: str | torch.device = "cpu") -> MergedModel:
    """Read the models of a merged file or a scene folder, or the one model of any other file as its only part.

    Args:
        path: a `.hyrf` file, the folder of a training run, or a scene folder (all chunks, at the finest level).
        device: device of the parameters, see `hyrfpack.device.choose_device`.

    Raises:
        HyrfFormatError: the file is damaged, incomplete, or of a newer format version.
        HyrfError: the device is not available.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load_merged_model("bonsai.hyrf")
        >>> len(model.parts), len(model) == len(hyrfpack.load_model("bonsai.hyrf"))
        (1, True)
    """
    device = choose_device(device)
    model = load_model_or_parts(path)
    merged = model if isinstance(model, MergedModel) else MergedModel((ONE_PART_NAME,), (model,))
    return merged.to(device)


def load_model_or_parts(path: str | os.PathLike[str]) -> HybridModel | MergedModel:
    """Read the models of a merged file, or the one model of another file, run folder or scene folder, on the CPU.

    Raises:
        HyrfFormatError: the file is damaged, incomplete, or of a newer format version.
    """
    if is_scene(path):
        return SceneFolder(path).load()
    with Container.open(path, SECTION_CONTENTS) as container:
        return decode_parts(container)


def decode_parts(container: Container) -> HybridModel | MergedModel:
    """Decode the models of a merged file, or the one model of another file, on the CPU.

    Raises:
        HyrfFormatError: the file is damaged, inconsistent, or incomplete.
    """
    if PART_NAMES not in container.entries:
        return decode_container(container)
    names, models = zip(*((name, decode_container(part)) for name, part in open_parts(container)), strict=True)
    return MergedModel(names, models)
