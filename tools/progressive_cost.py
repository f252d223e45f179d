"""What it would cost if a prefix of a `compact` file were a coarser model: Gaussians in layers, most important first.

    python tools/progressive_cost.py runs/bonsai/model.hyrf [more models]

Each layer is coded by itself, so that it can be read without the rest: its own Morton order, gaps, steps and prediction
between its own neighbours. Tables and decoders stay as they are. Printed: bytes of the whole file, in one piece and in
layers, for layers by importance class and for two layers of equal number.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from hyrfpack.compress.run import default_noise
from hyrfpack.compress.sensitivity import measure_sensitivity
from hyrfpack.format import describe, encode_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.format.compact import Plan, make_plan, quantize
from hyrfpack.format.compact.sections import encode
from hyrfpack.model import HybridModel
from hyrfpack.quant.points import Points, encode_points
from hyrfpack.render.capture import stored_cameras

EXPLICIT = ("POSI", "COLO", "SCAL", "OPAC")


def explicit_bytes(model: HybridModel, plan: Plan, members: np.ndarray) -> int:
    """Bytes of the positions and explicit logits of some of a plan's Gaussians, coded by themselves."""
    points = Points(plan.points.cells[members], plan.points.classes[members], plan.points.bits)
    data, order, points = encode_points(points)
    index = members[order]
    layer = dataclasses.replace(
        plan, kept=plan.kept[index], points=points, positions=data, sensitivity=plan.sensitivity.of(index)
    )
    coded = encode(quantize(layer.apply(model), layer), layer)
    return sum(len(coded[group][1]) for group in EXPLICIT)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path, help="trained .hyrf files, profile raw")
    print("| model | one piece | a layer for each class | two halves |\n|---|---|---|---|")
    for path in parser.parse_args().models:
        model, provenance = load_with_provenance(path)
        plan = make_plan(model, measure_sensitivity(model, stored_cameras(describe(path))), default_noise(provenance))
        whole = len(encode_model(model, "compact", plan=plan))
        everyone = np.arange(len(plan.kept))
        joint = explicit_bytes(model, plan, everyone)
        # Stable: within a half the file's order stays.
        ranked = np.argsort(plan.points.classes, kind="stable")
        halves = [np.sort(part) for part in np.array_split(ranked, 2)]
        classes = [np.flatnonzero(plan.points.classes == kind) for kind in np.unique(plan.points.classes)]
        cells = []
        for layers in (classes, halves):
            extra = sum(explicit_bytes(model, plan, layer) for layer in layers) - joint
            cells.append(f"{whole + extra:,} ({extra / whole:+.1%}, {len(layers)} layers)")
        print(f"| {path.parent.name} | {whole:,} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
