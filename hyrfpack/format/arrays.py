"""A HybridModel as a handful of matrices, and back."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import torch

from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import sections
from hyrfpack.model import BACKGROUND_RADIUS, DIRECTION_FEATURES
from hyrfpack.model.config import ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.hash_grid import FEATURES, HashGridConfig
from hyrfpack.model.hybrid import HybridModel

# What every model of this version computes and no setting of it says; `docs/format.md` has the equations.
RULES = {
    "activations": "sigmoid",
    "background_radius": BACKGROUND_RADIUS,
    "contraction": "l2",
    "decoders": "relu",
    "hash": "instant-ngp",
    "rotation": "identity-offset",
}


def _decoder(field: str) -> tuple[str, ...]:
    return tuple(f"{field}.{kind}.{layer}" for layer in range(3) for kind in ("weights", "biases"))


# The parameters in each group, laid one after another, each row by row.
GROUPS = {
    sections.POSITIONS: ("gaussians.positions",),
    sections.COLORS: ("gaussians.color_logits",),
    sections.SCALES: ("gaussians.scale_logits",),
    sections.OPACITIES: ("gaussians.opacity_logits",),
    sections.GEOMETRY_TABLE: ("geometry.grid.table",),
    sections.GEOMETRY_DECODER: _decoder("geometry"),
    sections.RADIANCE_TABLE: ("radiance.grid.table",),
    sections.RADIANCE_DECODER: _decoder("radiance"),
}


def to_arrays(model: HybridModel) -> dict[str, np.ndarray]:
    """The model's parameters by group, as float32 matrices; a decoder's are one column, layer after layer.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    state = model.state_dict()
    matrices = {}
    for group, names in GROUPS.items():
        parts = [state[name].cpu().numpy().astype(np.float32) for name in names]
        values = parts[0] if len(parts) == 1 else np.concatenate([part.ravel() for part in parts])[:, None]
        if wrong := int(np.count_nonzero(~np.isfinite(values))):
            raise HyrfError(
                f"{wrong} of {values.size} numbers in the model's {sections.SECTIONS[group]} are NaN or infinite; "
                "train it again from an earlier checkpoint"
            )
        matrices[group] = values
    return matrices


def group_shapes(config: ModelConfig, gaussians: int) -> dict[str, tuple[int, int]]:
    """(rows, columns) of each matrix of a model. Allocates nothing: what a file claims can be checked first."""
    shapes = {group: (gaussians, width) for group, width in zip(sections.LAYERED, Gaussians.WIDTHS, strict=True)}
    shapes |= {group: (grid.rows, FEATURES) for group, grid in grids(config).items()}
    for group, widths in decoder_widths(config).items():
        shapes[group] = (sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(widths)), 1)
    return {group: shapes[group] for group in GROUPS}


def grids(config: ModelConfig) -> dict[str, HashGridConfig]:
    """The hash grid of each field, by the section of its table."""
    return {sections.GEOMETRY_TABLE: config.geometry, sections.RADIANCE_TABLE: config.radiance}


def decoder_widths(config: ModelConfig) -> dict[str, tuple[int, int, int, int]]:
    """Inputs, hidden, hidden and outputs of each field's decoder, by its section."""
    hidden, direction = (config.hidden, config.hidden), DIRECTION_FEATURES[config.direction_encoding]
    return {
        sections.GEOMETRY_DECODER: (config.geometry.levels * FEATURES, *hidden, 8),
        sections.RADIANCE_DECODER: (config.radiance.levels * FEATURES + direction, *hidden, 3),
    }


def to_model(config: ModelConfig, arrays: dict[str, np.ndarray]) -> HybridModel:
    """The inverse of `to_arrays`; shapes must be those of `group_shapes`."""
    gaussians = Gaussians(*(torch.from_numpy(arrays[group]) for group in sections.LAYERED))
    with torch.device("meta"):  # shapes alone: nothing is drawn or allocated that would be thrown away
        model = HybridModel(config, gaussians)
    model.load_state_dict({name: value.clone() for name, value in by_parameter(arrays, model)}, assign=True)
    return model


def by_parameter(arrays: dict[str, np.ndarray], model: HybridModel) -> Iterator[tuple[str, torch.Tensor]]:
    """Numbers of some groups by the names of the model's parameters and in their shapes, on the CPU."""
    shapes = {name: value.shape for name, value in model.state_dict().items()}
    for group, values in arrays.items():
        parts = torch.from_numpy(values).flatten().split([shapes[name].numel() for name in GROUPS[group]])
        yield from ((name, part.view(shapes[name])) for name, part in zip(GROUPS[group], parts, strict=True))


def check_rules(rules: dict) -> None:
    """Raise HyrfFormatError unless this version computes by exactly these rules."""
    for name in sorted({*rules, *RULES}):
        if name not in RULES or rules.get(name) != RULES[name]:
            raise HyrfFormatError(
                f"rule {name!r:.40} is {rules.get(name)!r:.40} and this hyrfpack knows only {RULES.get(name)!r}; "
                "update hyrfpack"
            )


def parse_config(values: dict) -> ModelConfig:
    """The ModelConfig of checked metadata. Raises HyrfFormatError when a field is unknown or out of range."""
    try:
        return ModelConfig.from_dict(values)
    except (TypeError, ValueError, KeyError) as error:
        raise HyrfFormatError(
            f"the model's configuration is not valid ({error!s:.200}); write the file again"
        ) from error
