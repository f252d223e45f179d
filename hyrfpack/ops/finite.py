"""Whether numbers are finite."""

from __future__ import annotations

from math import isfinite

import torch
from torch import Tensor


def all_finite(values: Tensor) -> bool:
    """Whether no number of a tensor is NaN or infinite. Waits for the device once.

    By its extremes, which are NaN where any number is: twice as fast as asking each.
    """
    return not values.numel() or all(map(isfinite, torch.stack(values.detach().aminmax()).tolist()))
