"""Which photos the pilot runs train on, and which they are scored on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scenes import view_of
from scipy.spatial.transform import Rotation

from hyrfpack.scene import Camera, View
from hyrfpack.train import pilots


def views_at(places: Sequence[np.ndarray], per_place: int) -> list[View]:
    """Return views from places, `per_place` in other directions from each, one place after another."""
    views = []
    for place, center in enumerate(places):
        for face in range(per_place):
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_rotvec([0, face, 0.3 * place]).as_matrix()
            pose[:3, 3] = -pose[:3, :3] @ np.asarray(center)
            views.append(view_of(f"{place}_{face}.png", Camera(8, 8, 8.0, 8.0, 4.0, 4.0, pose), None))
    return views


@pytest.mark.parametrize("views", [8, 13, 15, 16, 100, 1000])
def test_validation_photos_are_not_trained_on_and_lie_between_training_photos(views):
    photos = views_at(np.random.default_rng(0).normal(size=(views, 3)), 1)
    near, judges = ([photos.index(view) for view in part] for part in pilots.split(photos))
    assert not set(near) & set(judges) and set(near) | set(judges) <= set(range(views))
    assert near == sorted(near) and len(near) == min(pilots.MAX_TRAINING_VIEWS, views - len(judges))
    assert 1 <= len(judges) <= pilots.MAX_VALIDATION_VIEWS
    assert all(min(abs(judge - n) for n in near) == 1 for judge in judges)


@pytest.mark.parametrize("count", [3, 4, 20])
def test_faces_of_a_panorama_are_validated_without_others_of_it_in_training(count):
    views = views_at(np.random.default_rng(0).normal(size=(count, 3)) * 1e4 + 1e6, 6)
    for fold in range(3):
        training, validation = pilots.split(views, number=fold)
        assert validation and len(training) >= 6
        assert {v.name[:-5] for v in training}.isdisjoint(v.name[:-5] for v in validation)


@pytest.mark.parametrize("places", [[[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]])
def test_photos_from_one_or_two_places_are_split_like_others(places):
    views = views_at(places, 12 // len(places))
    apart = views_at(np.random.default_rng(0).normal(size=(12, 3)), 1)
    names = [[view.name for view in part] for part in pilots.split(views)]
    assert names == [[views[apart.index(view)].name for view in part] for part in pilots.split(apart)]
