"""How much packing may add to pictures, as mean squared error of colours in [0, 1]."""

from __future__ import annotations

from hyrfpack.evaluate.metrics import stated_error

# dB that a file may cost, by estimate, unless told otherwise. Of as many bytes, a model of more Gaussians with coarser
# numbers is better than one of fewer with finer ones: docs/design-choices.md.
PSNR_DROP = 0.1
FINETUNED = 2.5  # times as much for so many steps of fine-tuning, which take most of it back
FULLY_FINETUNED = 1000
LIMITS = (1e-8, 1e-2)  # least and largest that files are made for


def default_distortion(provenance: dict, finetune_steps: int = 0) -> float:
    """What costs PSNR_DROP before fine-tuning takes something back: errors of photos and of quantising add up.

    Args:
        provenance: of the model; it says how well it fits its photos.
        finetune_steps: that a file gets; the more, the coarser it may start.
    """
    coarser = FINETUNED ** min(1.0, finetune_steps / FULLY_FINETUNED)
    return coarser * stated_error(provenance) * (10 ** (PSNR_DROP / 10) - 1)
