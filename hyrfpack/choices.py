"""The allowed values of settings that take one of a few words.

They are defined here, below the packages that implement them, so that the command line lists its options without
loading these packages.
"""

# How renders are exposed: each like the photos taken near its camera, or all alike.
AS_PHOTOGRAPHED = "as-photographed"
CONSISTENT_EXPOSURE = "consistent"
RENDER_EXPOSURES = (AS_PHOTOGRAPHED, CONSISTENT_EXPOSURE)
# How the splats that a model is baked to are exposed: each like the photos that see it, or all alike.
LOCAL_EXPOSURE = "local"
SPLAT_EXPOSURES = (LOCAL_EXPOSURE, CONSISTENT_EXPOSURE)
# Files of depth and of normals that are written beside renders.
DEPTH_FORMATS = ("tiff", "png", "exr")
NORMAL_FORMATS = ("png", "exr")
# Versions of SPZ files that can be written: 4 (May 2026) is smaller and faster to read, 3 is for programs without it.
SPZ_VERSIONS = (3, 4)
DEFAULT_SPZ_VERSION = 4
# Contents of 3D Tiles: SPZ in glTF, or plain glTF.
SPZ_TILE_CONTENT = "spz"
TILE_CONTENTS = (SPZ_TILE_CONTENT, "gltf")
# Layouts of photos and poses. They are the keys of `hyrfpack.data.LAYOUTS`.
LAYOUTS = (
    "colmap",
    "blender",
    "nerfstudio",
    "llff",
    "metashape",
    "bundler",
    "realityscan",
    "polycam",
    "record3d",
)
# Methods that choose the pairs of photos to match.
MATCHING_METHODS = ("auto", "exhaustive", "sequential", "retrieval")
# Kinds of scenes, each with its own defaults for training.
PRESETS = ("auto", "synthetic", "standard", "large", "street")
# Number formats of matrix products on a GPU: bfloat16 with float32 sums, or float32.
PRECISIONS = ("mixed", "float32")
# Trade-offs of time and quality of `make`. They are the keys of `hyrfpack.make.QUALITIES`.
QUALITIES = ("draft", "normal", "best")
# Groups of measurements of `bench`. They are the keys of `hyrfpack.bench.suite.ROW_FUNCTIONS_BY_GROUP`.
BENCH_GROUPS = ("rasterize", "hash_encode", "mlp", "render", "codec")
