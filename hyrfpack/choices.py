"""Words that settings take: for the rooms that know what they mean, and for the command line, which loads none of them
to list its options."""

AS_PHOTOGRAPHED, CONSISTENT = EXPOSURES = ("as-photographed", "consistent")  # of renders
LOCAL_EXPOSURE, _ = SPLAT_EXPOSURES = ("local", CONSISTENT)  # of splats that a model is baked to
LAYOUTS = (  # of photos and poses: the keys of `hyrfpack.data.LAYOUTS`
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
MATCHING = ("auto", "exhaustive", "sequential", "retrieval")  # which photos are compared
PRESETS = ("auto", "synthetic", "standard", "large", "street")  # the kind of scene that is trained
PRECISIONS = ("mixed", "float32")  # what a GPU multiplies in
QUALITIES = ("draft", "normal", "best")  # how long `make` works: the keys of `hyrfpack.make.QUALITIES`
