"""Encode and decode Gaussians with gsplat's PNG compression: a folder of quantised pictures.

It needs `pip install --no-deps gsplat jaxtyping wadler-lindig imageio`.

Two parts for which gsplat needs CUDA packages are replaced. Gaussians fill the grid's rows in Morton order; gsplat uses
PLAS, whose order is smoother. Filling the grid along a Morton curve instead of by rows takes 3 % more bytes. The
clusters come from k-means with squared distances; gsplat uses TorchPQ with absolute distances. gsplat always asks for
65,536 clusters, which is more than the number of Gaussians in a small scene.
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
from hyrfpack.splats.splats import Splats, normalize_quats

MAX_OPACITY_LOGIT = 7.0  # opacities are clamped to 1 - 1e-3; the rasteriser clamps alpha to 0.99
MIN_SCALE = 4.5e-5  # world units, far below a pixel; also the smallest scale of SPZ


def list_missing_packages() -> list[str]:
    """Return the names of the required packages that are not installed."""
    names = ("gsplat", "jaxtyping", "wadler_lindig", "imageio")
    return [name for name in names if importlib.util.find_spec(name) is None]


def round_trip(splats: Splats, clusters: int) -> tuple[int, Splats]:
    """Encode and decode splats; return the bytes of the folder and the decoded splats.

    As in gsplat, only the most opaque Gaussians are kept, as many as fill a square grid.

    Args:
        splats: splats in the order of `sort_in_morton_order`.
        clusters: number of clusters for the harmonics of bands 1 and up.
    """
    from gsplat.compression import PngCompression

    side = int(len(splats) ** 0.5)
    splats = splats[np.sort(np.argsort(-splats.opacities, kind="stable")[: side**2])]
    logits = torch.from_numpy(splats.opacities).logit().clamp_max(MAX_OPACITY_LOGIT)
    groups = {
        "means": torch.from_numpy(splats.positions.astype(np.float32)),
        "scales": torch.from_numpy(splats.scales).clamp_min(MIN_SCALE).log(),
        "quats": torch.from_numpy(splats.quats),
        "opacities": logits,
        "sh0": torch.from_numpy(splats.harmonics[:, :1]),
    }
    if splats.degree:
        groups["shN"] = torch.from_numpy(splats.harmonics[:, 1:])
    compression = PngCompression(use_sort=False, verbose=False)
    with tempfile.TemporaryDirectory() as folder:
        with _replace_torchpq(min(clusters, len(splats))), contextlib.redirect_stdout(io.StringIO()):
            compression.compress(folder, groups)
            decoded = {name: values.numpy() for name, values in compression.decompress(folder).items()}
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
    return size, replace(
        splats,
        positions=decoded["means"],
        scales=np.exp(decoded["scales"]),
        quats=normalize_quats(decoded["quats"]),
        opacities=expit(decoded["opacities"]),
        harmonics=np.concatenate([decoded[name] for name in ("sh0", "shN") if name in decoded], axis=1),
    )


def sort_in_morton_order(splats: Splats) -> Splats:
    """Sort splats along a Morton curve of their positions after sign(x) log(1 + |x|), which brings outliers closer."""
    compressed_positions = np.sign(splats.positions) * np.log1p(np.abs(splats.positions))
    low, high = compressed_positions.min(0), compressed_positions.max(0)
    cells = (compressed_positions - low) / max(float((high - low).max()), 1e-12) * (2**16 - 1)
    return splats[np.argsort(morton_codes(cells.astype(np.int64)), kind="stable")]


@contextlib.contextmanager
def _replace_torchpq(clusters: int) -> Iterator[None]:
    """Within this context, gsplat imports our k-means under TorchPQ's name."""

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
