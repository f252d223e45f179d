"""Default and limits of the distortion: the mean squared error, of colours in [0, 1], that compression may add."""

from __future__ import annotations

from hyrfpack.evaluate.metrics import provenance_mse

# Estimated loss of PSNR by default. At equal size, a model of more Gaussians with coarser numbers is better than one of
# fewer Gaussians with finer numbers: docs/research/count-and-precision.md.
DEFAULT_PSNR_DROP_DB = 0.1
# Fine-tuning of at least FULL_FINETUNING_STEPS recovers most of the loss, so it starts from a larger distortion.
FINETUNED_DISTORTION_RATIO = 2.5
FULL_FINETUNING_STEPS = 1000
DISTORTION_RANGE = (1e-8, 1e-2)


def default_distortion(provenance: dict, finetune_steps: int = 0) -> float:
    """Return the distortion that costs DEFAULT_PSNR_DROP_DB of PSNR against photos, before fine-tuning.

    The model's own error E against its photos and the distortion D are assumed to be independent. Then they add up, so
    D = E (10^(drop / 10) - 1).

    Args:
        provenance: provenance of the model, which states how well it fits its photos.
        finetune_steps: steps of fine-tuning that the file will get; more steps allow a larger distortion.
    """
    ratio = FINETUNED_DISTORTION_RATIO ** min(1.0, finetune_steps / FULL_FINETUNING_STEPS)
    return ratio * provenance_mse(provenance) * (10 ** (DEFAULT_PSNR_DROP_DB / 10) - 1)
