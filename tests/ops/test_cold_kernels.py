"""Kernels give the same bytes when they are freshly compiled and when they are loaded from the cache."""

from __future__ import annotations

import os
import subprocess
import sys

HASH_RESULTS_SCRIPT = """
import hashlib
import torch
from hyrfpack.ops.background import BackgroundField, background_grid
from hyrfpack.ops.composite import composite
from hyrfpack.ops.hash_encode import hash_encode, level_offsets, level_resolutions
from hyrfpack.ops.rasterize import Gaussians3D, Viewport, rasterize
from hyrfpack.ops.ssim import photometric_loss

g = torch.Generator().manual_seed(0)
count, resolutions = 500, level_resolutions(4, 8, 64)
table = torch.randn(level_offsets(resolutions, 10)[-1], 2, generator=g).requires_grad_()
features = hash_encode(torch.rand(count, 3, generator=g), table, resolutions, 10)
means = (torch.randn(count, 3, generator=g) + torch.tensor([0, 0, 4.0])).requires_grad_()
scales, opacities = torch.rand(count, 3, generator=g) * 0.2, torch.rand(count, generator=g)
colors, quats = torch.rand(count, 3, generator=g), torch.randn(count, 4, generator=g)
gaussians = Gaussians3D(means, quats, scales, opacities)
viewport = Viewport(torch.eye(4), (60.0, 60.0, 32.0, 32.0), 64, 64)
raster = rasterize(gaussians, colors, viewport, absgrad=torch.zeros(count, 2))
layers = [torch.randn(16, 32, generator=g), torch.randn(3, 16, generator=g)], [torch.zeros(16), torch.zeros(3)]
field = BackgroundField((1.0, 0.5, 0.25), table, resolutions, 10, *layers, "frequency")
grid = background_grid(raster.transmittance, viewport, field, threshold=0.01, stride=3)
grid.retain_grad()
picture = composite(raster.rgb, raster.transmittance, grid, 3)
loss = photometric_loss(picture, torch.rand(64, 64, 3, generator=g)) + features.square().mean()
loss.backward()
for result in (features, picture, loss, table.grad, means.grad, grid.grad):
    print(hashlib.sha256(result.detach().contiguous().numpy().tobytes()).hexdigest())
"""


def test_compiled_and_cached_kernels_agree_in_every_bit(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    cold, warm = (
        subprocess.run(
            [sys.executable, "-c", HASH_RESULTS_SCRIPT], env=environment, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    )

    assert len(cold.split()) == 6 and cold == warm
