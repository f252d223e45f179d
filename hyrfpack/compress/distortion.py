"""How much packing may add to pictures, as mean squared error of colours in [0, 1]."""

from __future__ import annotations

from hyrfpack.evaluate.metrics import stated_error

# dB that a file may cost, by estimate, unless told otherwise. Of as many bytes, a model of more Gaussians with coarser
# numbers is better than one of fewer with finer ones: docs/design-choices.md.
PSNR_DROP = 0.1
LIMITS = (1e-8, 1e-2)  # least and largest that files are made for


def default_distortion(provenance: dict) -> float:
    """What costs PSNR_DROP: errors of photos and of quantising add up."""
    return stated_error(provenance) * (10 ** (PSNR_DROP / 10) - 1)
