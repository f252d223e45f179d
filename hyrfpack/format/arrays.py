"""Conversion of a HybridModel to one matrix per section, and back."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import torch

from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import sections
from hyrfpack.format.container import Container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.model import BACKGROUND_RADIUS, DIRECTION_FEATURES
from hyrfpack.model.config import ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.hash_grid import FEATURES_PER_LEVEL, HashGridConfig
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.model.residuals import SHAPE_RESIDUALS, count_color_residuals

# Equations of every model of this version, which no setting changes; `docs/reference/format.md` defines the names.
MODEL_RULES = {
    "activations": "sigmoid",
    "background_radius": BACKGROUND_RADIUS,
    "contraction": "l2",
    "decoders": "relu",
    "hash": "instant-ngp",
    "rotation": "identity-offset",
}


def _decoder_parameter_names(field: str) -> tuple[str, ...]:
    """Return the names of a decoder's parameters in file order: weights and biases of each layer."""
    return tuple(f"{field}.{kind}.{layer}" for layer in range(3) for kind in ("weights", "biases"))


# Names of the model parameters in each section, in file order; each parameter is stored row by row.
SECTION_PARAMETERS = {
    sections.POSITIONS: ("gaussians.positions",),
    sections.COLORS: ("gaussians.color_logits",),
    sections.SCALES: ("gaussians.scale_logits",),
    sections.OPACITIES: ("gaussians.opacity_logits",),
    sections.SHAPES: ("gaussians.shape_residuals",),
    sections.HARMONICS: ("gaussians.color_residuals",),
    sections.GEOMETRY_TABLE: ("geometry.grid.table",),
    sections.GEOMETRY_DECODER: _decoder_parameter_names("geometry"),
    sections.RADIANCE_TABLE: ("radiance.grid.table",),
    sections.RADIANCE_DECODER: _decoder_parameter_names("radiance"),
}


def to_arrays(model: HybridModel) -> dict[str, np.ndarray]:
    """Return the model's parameters by section, as float32 matrices.

    The parameters of a decoder form one column, layer after layer.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    state = model.state_dict()
    matrices = {}
    for group, names in SECTION_PARAMETERS.items():
        if names[0] not in state:  # a model without residuals
            continue
        parts = [state[name].cpu().numpy().astype(np.float32) for name in names]
        values = parts[0] if len(parts) == 1 else np.concatenate([part.ravel() for part in parts])[:, None]
        if nonfinite_count := int(np.count_nonzero(~np.isfinite(values))):
            raise HyrfError(
                f"{nonfinite_count} of {values.size} numbers in the model's {sections.SECTION_CONTENTS[group]} are "
                "NaN or infinite",
                fix="train it again from an earlier checkpoint",
            )
        matrices[group] = values
    return matrices


def group_shapes(config: ModelConfig, gaussians: int) -> dict[str, tuple[int, int]]:
    """Return (rows, columns) of each matrix of a model.

    It allocates no arrays, so that a reader can check the sizes that a file declares before it decodes anything.
    """
    shapes = {
        group: (gaussians, width)
        for group, width in zip(sections.LAYERED_SECTIONS, Gaussians.PARAMETER_WIDTHS, strict=True)
    }
    for group, width in residual_widths(config).items():
        shapes[group] = gaussians, width
    shapes |= {group: (grid.rows, FEATURES_PER_LEVEL) for group, grid in grid_configs(config).items()}
    for group, widths in decoder_widths(config).items():
        shapes[group] = (sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(widths)), 1)
    return {group: shapes[group] for group in SECTION_PARAMETERS if group in shapes}


def residual_widths(config: ModelConfig) -> dict[str, int]:
    """Return the columns of the residuals that a model has, by section."""
    degree = config.residual_degree
    if degree is None:
        return {}
    return {sections.SHAPES: SHAPE_RESIDUALS, sections.HARMONICS: count_color_residuals(degree)}


def layered_groups(config: ModelConfig) -> tuple[str, ...]:
    """Return the sections of a model that each layer has."""
    return (*sections.LAYERED_SECTIONS, *residual_widths(config))


def grid_configs(config: ModelConfig) -> dict[str, HashGridConfig]:
    """Return the hash grid configuration of each field, by the section of its table."""
    return {sections.GEOMETRY_TABLE: config.geometry, sections.RADIANCE_TABLE: config.radiance}


def decoder_widths(config: ModelConfig) -> dict[str, tuple[int, int, int, int]]:
    """Return the layer widths (inputs, hidden, hidden, outputs) of each field's decoder, by its section."""
    hidden, direction = (config.hidden, config.hidden), DIRECTION_FEATURES[config.direction_encoding]
    return {
        sections.GEOMETRY_DECODER: (config.geometry.levels * FEATURES_PER_LEVEL, *hidden, 8),
        sections.RADIANCE_DECODER: (config.radiance.levels * FEATURES_PER_LEVEL + direction, *hidden, 3),
    }


def to_model(config: ModelConfig, arrays: dict[str, np.ndarray]) -> HybridModel:
    """Build a model from matrices: the inverse of `to_arrays`. Shapes must be those of `group_shapes`.

    The model keeps the arrays of all sections but the decoders, and must be their only owner.
    """
    gaussians = to_gaussians(arrays)
    with torch.device("meta"):  # has shapes but no storage, so that no random initial values are computed
        model = HybridModel(config, gaussians)
    # The parameters of a decoder are views of one array, so each gets a copy of its own.
    views = {name for group in sections.DECODER_SECTIONS for name in SECTION_PARAMETERS[group]}
    parameters = iter_parameters(arrays, model)
    model.load_state_dict({name: value.clone() if name in views else value for name, value in parameters}, assign=True)
    return model


def to_gaussians(arrays: dict[str, np.ndarray]) -> Gaussians:
    """Build Gaussians from the matrices of the layered sections."""
    groups = (*sections.LAYERED_SECTIONS, *(group for group in sections.RESIDUAL_SECTIONS if group in arrays))
    names = (SECTION_PARAMETERS[group][0].removeprefix("gaussians.") for group in groups)
    return Gaussians(**{name: torch.from_numpy(arrays[group]) for name, group in zip(names, groups, strict=True)})


def iter_parameters(arrays: dict[str, np.ndarray], model: HybridModel) -> Iterator[tuple[str, torch.Tensor]]:
    """Yield (name, tensor) of the model parameters in the given sections, in their shapes, on the CPU."""
    shapes = {name: value.shape for name, value in model.state_dict().items()}
    for group, values in arrays.items():
        parts = torch.from_numpy(values).flatten().split([shapes[name].numel() for name in SECTION_PARAMETERS[group]])
        yield from (
            (name, part.view(shapes[name])) for name, part in zip(SECTION_PARAMETERS[group], parts, strict=True)
        )


def check_rules(rules: dict) -> None:
    """Raise HyrfFormatError unless `rules` are exactly the `MODEL_RULES` of this version."""
    for name in sorted({*rules, *MODEL_RULES}):
        if name not in MODEL_RULES or rules.get(name) != MODEL_RULES[name]:
            raise HyrfFormatError(
                f"rule {name!r:.40} is {rules.get(name)!r:.40} and this hyrfpack knows only {MODEL_RULES.get(name)!r}",
                fix="update hyrfpack",
            )


def read_config(container: Container) -> ModelConfig:
    """Read the configuration of a file's model, after a check of its rules.

    Raises:
        HyrfFormatError: the metadata is damaged, or asks for another model than this version knows; it names the file.
    """
    metadata = read_metadata(container)
    try:
        check_rules(metadata.rules)
        return parse_config(metadata.config)
    except HyrfFormatError as error:
        raise error.with_text(f"{container.name}: {error.problem}") from error


def parse_config(values: dict) -> ModelConfig:
    """Build a ModelConfig from metadata whose types have been checked.

    Raises:
        HyrfFormatError: a field is unknown or out of range.
    """
    try:
        return ModelConfig.from_dict(values)
    except (TypeError, ValueError, KeyError) as error:
        raise HyrfFormatError(
            f"the model's configuration is not valid ({error!s:.200})",
            fix="write the file again",
        ) from error
