"""Of a photo, only the pixels count in which two renders show the same."""

from __future__ import annotations

import numpy as np
import torch
from scenes import ball_scene

from hyrfpack.data.masked_views import mask_differing_pixels, mask_view


def test_only_pixels_in_which_two_renders_show_the_same_count():
    view = ball_scene(1, side=8).train[0]
    first = torch.full((8, 8, 3), 0.5)
    second = first.clone()
    second[:, 2, 1] += 7.5 / 255
    second[:, 5, 1] -= 8.5 / 255
    own_mask = np.ones((8, 8), bool)
    own_mask[0] = False

    masked = mask_differing_pixels(view, first, second)
    masked_twice = mask_differing_pixels(mask_view(view, own_mask), first, second)

    assert masked is not None and masked_twice is not None
    expected = np.ones((8, 8), bool)
    expected[:, 5] = False
    np.testing.assert_array_equal(masked.load().mask, expected)
    np.testing.assert_array_equal(masked_twice.load().mask, expected & own_mask)


def test_renders_that_differ_everywhere_leave_no_view():
    view = ball_scene(1, side=8).train[0]

    assert mask_differing_pixels(view, torch.zeros(8, 8, 3), torch.ones(8, 8, 3)) is None
