"""The reports of an edit."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class ActionReport:
    """What one action has done.

    Attributes:
        action: the action in words.
        gaussians_before, gaussians_after: number of Gaussians before and after it.
        gaussians_trained: number of Gaussians that `Refit` has trained.
        region_psnr_before, region_psnr_after: PSNR in dB on held-out photos before and after `Refit`, of the pixels
            that mostly show its region; None for other actions, or if no held-out photo shows the region.
    """

    action: str
    gaussians_before: int
    gaussians_after: int
    gaussians_trained: int = 0
    region_psnr_before: float | None = None
    region_psnr_after: float | None = None


@dataclass(frozen=True)
class EditReport:
    """What an edit has changed, or would change.

    Attributes:
        file: the path that was written; "" for a plan.
        profile: profile of the file.
        bytes_before, bytes_after: bytes of both files; `bytes_after` is 0 for a plan.
        actions: what each action has done.
        views: number of cameras at which renders were compared.
        psnr_change, psnr_change_worst: PSNR in dB of the edited scene's renders against those of the original, mean and
            lowest. It says how much of the pictures has changed, whether this was wanted or not.
        psnr_before, psnr_after, ssim_before, ssim_after: scores on held-out photos; None without photos.
        found: the outcome of the search for a file within `EditLimits`, as a sentence; "" without limits.
    """

    file: str
    profile: str
    bytes_before: int
    bytes_after: int
    actions: list[ActionReport]
    views: int
    psnr_change: float
    psnr_change_worst: float
    psnr_before: float | None = None
    psnr_after: float | None = None
    ssim_before: float | None = None
    ssim_after: float | None = None
    found: str = ""

    def to_dict(self) -> dict:
        """Return the report as numbers, strings, lists and dictionaries for JSON."""
        return asdict(self)
