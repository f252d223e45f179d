"""A taught model as a file, as small as the quality asked for allows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.compress.calibrate import calibrated
from hyrfpack.compress.packer import Packer
from hyrfpack.distill.teach import Taught
from hyrfpack.format.codec import decode_model
from hyrfpack.model import HybridModel

PACKED = 0.8  # of what packing may add, to ask for
LEAST_ADDED = 0.25  # of the error before packing, that packing may add in any case
HOPELESS = 0.5  # of the error allowed, that it may add where that is passed already
TRIALS = 5  # files that are made so


def pack(taught: Taught, psnr: float, provenance: dict, say: Callable[[str], None] = lambda sentence: None) -> bytes:
    """A file as small as the quality that is asked for allows, as views tell that it has not learnt from.

    Args:
        psnr: dB of its pictures against the original's.
        provenance: that the file tells, besides where it is looked at from.

    Example:
        >>> from hyrfpack.distill import DistillConfig
        >>> from hyrfpack.distill.teach import teach
        >>> from hyrfpack.splats.files import read_splats
        >>> taught = teach(read_splats("bonsai.ply"), DistillConfig(steps=1, size=16, train_views=2, test_views=2))
        >>> pack(taught, psnr=15, provenance={})[:4]
        b'HYRF'
    """
    model = taught.model
    allowed, error = _mse(psnr), _error(model, taught)
    room = max(allowed - error, min(LEAST_ADDED * error, HOPELESS * allowed))
    say(f"measuring what each number does to pictures, at {len(taught.train)} cameras and between them")
    wanted = PACKED * room
    sensitivity, originals = calibrated(model, taught.train, wanted)
    provenance = {**provenance, "viewpoint": Viewpoint.of(taught.train).to_json()}
    packer = Packer(model, provenance, sensitivity, scene=None, finetune_steps=0, prune=True, say=say)
    trial = packer.settled(wanted, originals)
    for _ in range(TRIALS):
        off = _error(decode_model(trial.data), taught) - error
        if off <= room:
            break
        wanted *= max(PACKED * room / off, 1 / 16)
        say(f"packing adds {off:.2g} to the error instead of {room:.2g}: finer, for {wanted:.2g}")
        trial = packer.attempt(wanted)
    return trial.data


def _mse(psnr: float) -> float:
    return 10 ** (-psnr / 10)


def _error(model: HybridModel, taught: Taught) -> float:
    """Of the mean PSNR at the viewpoints to decide by, as mean squared error."""
    return _mse(float(np.mean(taught.deciding.likeness(model))))
