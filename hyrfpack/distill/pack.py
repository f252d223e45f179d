"""A taught model as a file, as small as the quality asked for allows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import brentq

from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.compress.calibrate import measure_calibrated_sensitivity
from hyrfpack.compress.packer import Packer
from hyrfpack.distill.teach import Taught
from hyrfpack.progress import Report, no_report, report_part, report_round

PACKED = 0.8  # of what packing may add, to ask for
LEAST_ADDED = 0.25  # of the error before packing, that packing may add in any case
HOPELESS = 0.5  # of the error allowed, that it may add where that is passed already
TRIALS = 5  # files that are made so


def pack(
    taught: Taught,
    psnr: float,
    provenance: dict,
    say: Callable[[str], None] = lambda sentence: None,
    report: Report = no_report,
) -> bytes:
    """A file as small as the quality that is asked for allows, as views tell that it has not learnt from.

    Args:
        psnr: dB of its pictures against the original's.
        provenance: that the file tells, besides where it is looked at from.
        say: told what is going on.
        report: called with what is being done and the share of the work that is done, 0 to 1.

    Example:
        >>> from hyrfpack.distill import DistillConfig
        >>> from hyrfpack.distill.teach import teach
        >>> from hyrfpack.splats.files import read_splats
        >>> taught = teach(read_splats("bonsai.ply"), DistillConfig(steps=1, size=16, train_views=2, test_views=2))
        >>> pack(taught, psnr=15, provenance={})[:4]
        b'HYRF'
    """
    model = taught.model
    likeness = np.array(taught.deciding.likeness(model))
    allowed, error = _mse(psnr), _mse(likeness.mean())
    room = max(allowed - error, min(LEAST_ADDED * error, HOPELESS * allowed))
    say(f"measuring what each number does to pictures, at {len(taught.train)} cameras and between them")
    wanted = PACKED * added_to_each(_mse(likeness), error + room)
    sensitivity, originals = measure_calibrated_sensitivity(
        model, taught.train, wanted, report=report_part(report, 0.0, 0.7)
    )
    provenance = {**provenance, "viewpoint": Viewpoint.from_cameras(taught.train).to_json()}
    making = report_part(report, 0.7, 0.85)
    packer = Packer(model, provenance, sensitivity, scene=None, finetune_steps=0, prune=True, say=say, report=making)
    trial = packer.encode_to_distortion(wanted, originals)
    for number in range(TRIALS):
        trying = report_round(report_part(report, 0.85, 1.0), number)
        trying("comparing the file with the original", 0.0)
        off = _mse(np.mean(taught.deciding.likeness(packer.decode(trial)))) - error
        if off <= room:
            break
        wanted *= max(PACKED * room / off, 1 / 16)
        say(f"packing adds {off:.2g} to the error instead of {room:.2g}: finer, for {wanted:.2g}")
        trial = packer.encode(wanted, report_part(trying, 0.5, 1.0))
    return trial.data


def added_to_each(errors: np.ndarray, mean: float) -> float:
    """What, added to the errors (n,) of all views, brings their geometric mean, that of the mean PSNR, to `mean`.

    It is less than `mean` less their own: the views that are nearly right lose most.

    Example:
        >>> round(added_to_each(np.array([1.0, 100.0]), 20.0), 2)
        2.89
    """

    def above(added: float) -> float:
        return float(np.log(errors + added).mean() - np.log(mean))

    least = 1e-6 * mean
    return least if above(least) >= 0 else float(brentq(above, least, mean, xtol=1e-3 * least))


def _mse(psnr: Any) -> Any:
    """Mean squared errors, of colours in [0, 1], of PSNRs in dB."""
    return 10 ** (-psnr / 10)
