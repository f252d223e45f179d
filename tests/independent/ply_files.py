"""Read and write PLY files of 3D Gaussian Splatting in the INRIA layout without using hyrfpack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class StoredSplats:
    """Explicit 3D Gaussians as the INRIA PLY layout stores them, float32.

    Attributes:
        positions: (N, 3).
        log_scales: (N, 3) natural logarithms of standard deviations.
        quats: (N, 4) wxyz.
        opacity_logits: (N,).
        harmonics: (N, (degree + 1)^2, 3) coefficients; a colour is 0.5 + the sum of coefficient times basis function.
    """

    positions: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray


def write_ply(path: Path, splats: StoredSplats) -> None:
    """Write the INRIA layout: binary little-endian float32, higher harmonics channel after channel."""
    rest = splats.harmonics[:, 1:].transpose(0, 2, 1).reshape(len(splats.positions), -1)
    columns = [
        splats.positions,
        splats.harmonics[:, 0],
        rest,
        splats.opacity_logits[:, None],
        splats.log_scales,
        splats.quats,
    ]
    names = ["x", "y", "z", *_names("f_dc", 3), *_names("f_rest", rest.shape[1]), "opacity"]
    names += [*_names("scale", 3), *_names("rot", 4)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats.positions)}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    path.write_bytes("\n".join(header).encode() + np.concatenate(columns, axis=1).astype("<f4").tobytes())


def read_ply(path: Path) -> StoredSplats:
    """Read a PLY with float properties only, as `write_ply` and splat-transform write them."""
    data = path.read_bytes()
    header, mark, body = data.partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    if not mark or sum(line.startswith("property") for line in lines) != len(names):
        raise ValueError(f"{path}: not a PLY of floats")
    table = dict(zip(names, np.frombuffer(body, "<f4").reshape(count, len(names)).T, strict=True))
    rest = [name for name in names if name.startswith("f_rest_")]

    def stack(names: Sequence[str]) -> np.ndarray:
        return np.stack([table[name] for name in names], axis=1)

    harmonics = stack(_names("f_dc", 3))[:, None]
    if rest:
        higher = stack(_names("f_rest", len(rest))).reshape(count, 3, -1).transpose(0, 2, 1)
        harmonics = np.concatenate((harmonics, higher), axis=1)
    scales, quats = stack(_names("scale", 3)), stack(_names("rot", 4))
    return StoredSplats(stack("xyz"), scales, quats, table["opacity"].copy(), harmonics)


def _names(stem: str, count: int) -> list[str]:
    return [f"{stem}_{number}" for number in range(count)]
