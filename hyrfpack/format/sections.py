"""Types and contents of the sections of a `.hyrf` file.

This module imports nothing, because imports would make `describe_file` slow.
"""

from __future__ import annotations

METADATA = "META"
EXPOSURE = "EXPO"
POSITIONS = "POSI"
COLORS = "COLO"
SCALES = "SCAL"
OPACITIES = "OPAC"
GEOMETRY_TABLE = "GTAB"
GEOMETRY_DECODER = "GMLP"
RADIANCE_TABLE = "RTAB"
RADIANCE_DECODER = "RMLP"
SHAPES = "SHAP"
HARMONICS = "HARM"
# A merged file has these instead: the names of its parts, and the part files (`part_section`).
PART_NAMES = "PRTS"
MAX_PARTS = 64

LOGIT_SECTIONS = (COLORS, SCALES, OPACITIES)
TABLE_SECTIONS = (GEOMETRY_TABLE, RADIANCE_TABLE)
DECODER_SECTIONS = (GEOMETRY_DECODER, RADIANCE_DECODER)
# Gaussians may be stored in layers, the most important first. These are the section types of the first layer, which the
# code calls groups. `layer_section` makes the type of a section, also called its tag, of a group and a layer's number.
LAYERED_SECTIONS = (POSITIONS, *LOGIT_SECTIONS)
# A model with residuals has these, too, in the same layers.
RESIDUAL_SECTIONS = (SHAPES, HARMONICS)
MAX_LAYERS = 8
# These sections hold no parameters of the model.
NON_PARAMETER_SECTIONS = (METADATA, EXPOSURE)


def part_section(number: int) -> str:
    """Return the section type of a part of a merged file, from 0: "PT00", "PT01", ..."""
    return f"PT{number:02d}"


# Content of each section type. In a file of one model, every section of a model except EXPOSURE is required, and the
# residuals are if the configuration says so.
SECTION_CONTENTS = {
    METADATA: "metadata",
    EXPOSURE: "exposure map",
    POSITIONS: "positions",
    COLORS: "colour logits",
    SCALES: "scale logits",
    OPACITIES: "opacity logits",
    SHAPES: "residuals of shapes",
    HARMONICS: "residuals of colours",
    GEOMETRY_TABLE: "geometry hash table",
    GEOMETRY_DECODER: "geometry decoder",
    RADIANCE_TABLE: "radiance hash table",
    RADIANCE_DECODER: "radiance decoder",
}


def layer_section(group: str, layer: int) -> str:
    """Return the section type of a group with layers in one of them: "POSI", then "POS1", "POS2", ..."""
    return f"{group[:3]}{layer}" if layer else group


_GROUP_AND_LAYER_BY_TAG = {
    layer_section(group, layer): (group, layer)
    for layer in range(MAX_LAYERS)
    for group in (*LAYERED_SECTIONS, *RESIDUAL_SECTIONS)
}
SECTION_CONTENTS |= {
    tag: f"{SECTION_CONTENTS[group]}, layer {layer}" for tag, (group, layer) in _GROUP_AND_LAYER_BY_TAG.items() if layer
}

SECTION_CONTENTS |= {PART_NAMES: "names of the parts"}
SECTION_CONTENTS |= {part_section(number): f"part {number + 1}" for number in range(MAX_PARTS)}


def group_and_layer(tag: str) -> tuple[str, int]:
    """Return the section type in the first layer and the number of the layer: ("POSI", 2) for "POS2".

    Sections without layers are in layer 0.
    """
    return _GROUP_AND_LAYER_BY_TAG.get(tag, (tag, 0))
