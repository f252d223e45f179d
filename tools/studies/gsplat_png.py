"""gsplat's PNG compression, written and read by gsplat itself: a folder of pictures, quantised and packed losslessly.

Needs `pip install --no-deps gsplat jaxtyping wadler-lindig imageio`.

Two parts that gsplat takes from packages for CUDA are ours: Gaussians fill the rows of the grid in Morton order
(gsplat: PLAS, smoother; a Morton curve over the grid as well takes 3 % more bytes), and the clusters come from k-means
with squared distances (gsplat: TorchPQ, absolute distances). gsplat always asks for 65,536 clusters, more than a small
scene has Gaussians.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from hyrfpack.quant.morton import morton_codes
from hyrfpack.splats.formats.palette import build_palette, find_nearest_entries
from hyrfpack.splats.splats import Splats, normalized_quats

LOGIT_TAIL = 7.0  # opacities beyond are cut, 1e-3 from 1; the rasteriser cuts alpha at 0.99
LEAST_SCALE = 4.5e-5  # units, far below a pixel; the least that SPZ can hold, too


def missing_packages() -> list[str]:
    """Of those that this takes, the ones that are not here."""
    return [name for name in ("gsplat", "jaxtyping", "imageio") if importlib.util.find_spec(name) is None]


def round_trip(splats: Splats, clusters: int) -> tuple[int, Splats]:
    """Bytes of the folder, and the Gaussians read back from it; as in gsplat, as many as fill a square grid.

    Args:
        splats: in Morton order, see `in_morton_order`.
        clusters: of the harmonics of bands 1 and up.
    """
    from gsplat.compression import PngCompression

    side = int(len(splats) ** 0.5)
    splats = splats[np.sort(np.argsort(-splats.opacities, kind="stable")[: side**2])]
    logits = torch.from_numpy(splats.opacities).logit().clamp_max(LOGIT_TAIL)
    groups = {
        "means": torch.from_numpy(splats.positions.astype(np.float32)),
        "scales": torch.from_numpy(splats.scales).clamp_min(LEAST_SCALE).log(),
        "quats": torch.from_numpy(splats.quats),
        "opacities": logits,
        "sh0": torch.from_numpy(splats.harmonics[:, :1]),
    }
    if splats.degree:
        groups["shN"] = torch.from_numpy(splats.harmonics[:, 1:])
    compression = PngCompression(use_sort=False, verbose=False)
    with tempfile.TemporaryDirectory() as folder:
        with _kmeans_of_gsplat(min(clusters, len(splats))), contextlib.redirect_stdout(io.StringIO()):
            compression.compress(folder, groups)
            read = {name: values.numpy() for name, values in compression.decompress(folder).items()}
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
    return size, replace(
        splats,
        positions=read["means"],
        scales=np.exp(read["scales"]),
        quats=normalized_quats(read["quats"]),
        opacities=expit(read["opacities"]),
        harmonics=np.concatenate([read[name] for name in ("sh0", "shN") if name in read], axis=1),
    )


def in_morton_order(splats: Splats) -> Splats:
    """Splats along a Morton curve through their positions, after the sign(x) log(1 + |x|) that draws outliers in."""
    drawn_in = np.sign(splats.positions) * np.log1p(np.abs(splats.positions))
    low, high = drawn_in.min(0), drawn_in.max(0)
    cells = (drawn_in - low) / max(float((high - low).max()), 1e-12) * (2**16 - 1)
    return splats[np.argsort(morton_codes(cells.astype(np.int64)), kind="stable")]


@contextlib.contextmanager
def _kmeans_of_gsplat(clusters: int) -> Iterator[None]:
    """Inside, gsplat finds our k-means under TorchPQ's name."""

    class KMeans:
        def __init__(self, n_clusters: int, distance: str, verbose: bool) -> None:
            self.centroids: Tensor | None = None

        def fit(self, columns: Tensor) -> Tensor:
            rows = np.ascontiguousarray(columns.numpy().T)
            entries = build_palette(rows, np.ones(len(rows)), clusters)
            self.centroids = torch.from_numpy(entries.T.copy())
            return torch.from_numpy(find_nearest_entries(rows, entries)[0])

    module = ModuleType("torchpq.clustering")
    module.KMeans = KMeans
    with patch.dict(sys.modules, {"torchpq": ModuleType("torchpq"), "torchpq.clustering": module}):
        yield
