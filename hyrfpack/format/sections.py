"""The sections of a `.hyrf` file: what each is called, and what it holds. Plain Python: `describe` needs it fast."""

from __future__ import annotations

METADATA = "META"
EXPOSURE = "EXPO"
POSITIONS, COLORS, SCALES, OPACITIES = "POSI", "COLO", "SCAL", "OPAC"
GEOMETRY_TABLE, GEOMETRY_DECODER, RADIANCE_TABLE, RADIANCE_DECODER = "GTAB", "GMLP", "RTAB", "RMLP"

LOGITS = (COLORS, SCALES, OPACITIES)
TABLES = (GEOMETRY_TABLE, RADIANCE_TABLE)
MLPS = (GEOMETRY_DECODER, RADIANCE_DECODER)
# Gaussians may come in layers, the most important first: sections of the first, and how many layers there may be.
LAYERED = (POSITIONS, *LOGITS)
MAX_LAYERS = 8
NON_PARAMETERS = (METADATA, EXPOSURE)  # sections that hold no parameters of the model

# Section types and what they hold; every one but EXPOSURE is required.
SECTIONS = {
    METADATA: "metadata",
    EXPOSURE: "exposure map",
    POSITIONS: "positions",
    COLORS: "colour logits",
    SCALES: "scale logits",
    OPACITIES: "opacity logits",
    GEOMETRY_TABLE: "geometry hash table",
    GEOMETRY_DECODER: "geometry decoder",
    RADIANCE_TABLE: "radiance hash table",
    RADIANCE_DECODER: "radiance decoder",
}


def layer_section(group: str, layer: int) -> str:
    """What a section of LAYERED is called in a layer: "POSI", then "POS1", "POS2", ..."""
    return f"{group[:3]}{layer}" if layer else group


_OF_LAYERS = {layer_section(group, layer): (group, layer) for layer in range(MAX_LAYERS) for group in LAYERED}
SECTIONS |= {tag: f"{SECTIONS[group]}, layer {layer}" for tag, (group, layer) in _OF_LAYERS.items() if layer}


def group_and_layer(tag: str) -> tuple[str, int]:
    """What a section is called in the first layer, and its layer: "POS2" is ("POSI", 2). Others are of layer 0."""
    return _OF_LAYERS.get(tag, (tag, 0))
