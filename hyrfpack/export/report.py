"""What an export came to."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ExportReport:
    """What an export came to. PSNR in dB, means over views.

    Attributes:
        file: what was written, a file or a folder.
        bytes: on disk; of all files that were written into a folder.
        gaussians: in the file, those of the background included; 0 where it is one of cameras.
        native: whether it holds the model itself, so that nothing was lost and nothing is measured.
        background: how many of the Gaussians make the background.
        degree: of the spherical harmonics in the file.
        chosen_by: PSNR of the baked model's pictures against the model's own, by degree, at cameras kept back for the
            purpose: what the degree was chosen by; empty where it was given.
        views: how many views the loss was measured at; 0 where it was not.
        psnr_baked: PSNR of the baked model's pictures against the model's own, before anything is rounded to what the
            file holds; None where it was not measured.
        psnr: PSNR of the file's pictures, as read back from its bytes, against the model's own.
        photos_model, photos_file: PSNR of the model's and of the file's pictures against held-out photos, if given.
        exposure: of the splats in the file, "local" or "consistent": the model's pictures that `psnr_baked`, `psnr` and
            `photos_model` are about have the same, as photographed or consistent. None of a model without an exposure
            map.
        psnr_by_exposure: PSNR of baked splats with local and with consistent exposure, before anything is rounded,
            against the model's pictures as photographed; empty without an exposure map, or where it was not measured.
        photos_by_exposure: the same against held-out photos, if given.
        cameras: in the file, where it is one of points or cameras.
    """

    file: str
    bytes: int
    gaussians: int = 0
    native: bool = False
    background: int = 0
    degree: int = 0
    chosen_by: dict[int, float] = field(default_factory=dict)
    views: int = 0
    psnr_baked: float | None = None
    psnr: float | None = None
    photos_model: float | None = None
    photos_file: float | None = None
    exposure: str | None = None
    psnr_by_exposure: dict[str, float] = field(default_factory=dict)
    photos_by_exposure: dict[str, float] = field(default_factory=dict)
    cameras: int = 0
