"""The report of a compression: the file that was written, and what compression did to the model."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace

from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format import FileReport


@dataclass(frozen=True)
class CompressionReport(FileReport):
    """Contents and size of a compressed file, and the error that compression added.

    Attributes:
        shares: profile "compact" only: the fraction of the error in renders that comes from each section, and from
            the "pruned" Gaussians.
        error: profile "compact" only: the mean squared error of renders, colours in [0, 1]; an estimate where the file
            was not rendered.
        found: the outcome of a search for a target size or quality, as a sentence.
        finetuned: profile "compact" only: whether the quantised numbers were fine-tuned on photos.
        sensitivity: profile "compact" only: how much each number changes renders, by which the steps were chosen. It is
            kept so that a report page need not measure it again.
    """

    shares: dict[str, float] = field(default_factory=dict)
    error: float | None = None
    found: str = ""
    finetuned: bool = False
    sensitivity: Sensitivity | None = field(default=None, repr=False, compare=False)

    def to_dict(self) -> dict:
        """Return all fields except the sensitivity as plain numbers, strings, lists and dictionaries for JSON."""
        values = asdict(replace(self, sensitivity=None))
        del values["sensitivity"]
        return values
