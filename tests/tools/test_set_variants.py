"""tools/studies/set_variants.py: sets with few photos, or with photos in two groups of exposure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import ball_scene

from hyrfpack.errors import HyrfError
from tools.studies import set_variants
from tools.studies.set_variants import keep_few_photos, load_variant, split_exposures


def split_scene():
    scene = ball_scene(views=32, points=40, side=16)
    return replace(scene, train=[v for n, v in enumerate(scene.train) if n % 8], test=scene.train[::8])


def is_lighter(before, after) -> list[bool]:
    return [
        bool((new.load().rgb.astype(int) - old.load().rgb).mean() > 5) for old, new in zip(before, after, strict=True)
    ]


def test_few_photos_are_spread_over_all_and_the_held_out_photos_stay():
    scene = split_scene()
    few = keep_few_photos(scene, 7)
    assert len(few.train) == 7 and few.test == scene.test
    assert {view.name for view in few.train} < {view.name for view in scene.train}
    places = [scene.train.index(view) for view in few.train]
    assert max(np.diff(places)) <= 5
    assert few.tracks.keys() <= {view.name for view in few.views}


def test_the_second_half_by_name_is_lighter():
    scene = split_scene()
    relit = split_exposures(scene, interleaved=False)
    names = sorted(view.name for view in scene.views)
    for before, after in ((scene.train, relit.train), (scene.test, relit.test)):
        assert is_lighter(before, after) == [view.name in names[16:] for view in before]


def test_interleaved_groups_are_half_of_all_and_both_hold_photos_out():
    scene = split_scene()
    relit = split_exposures(scene, interleaved=True)
    lighter = is_lighter(scene.train, relit.train) + is_lighter(scene.test, relit.test)
    assert sum(lighter) == 16
    assert 0 < sum(is_lighter(scene.test, relit.test)) < len(scene.test)


def test_middle_grey_becomes_two_stops_lighter():
    """With a display gamma of 2.2 a stop doubles the light; the tone curve has that slope at middle grey."""
    scene = split_scene()
    relit = split_exposures(scene, interleaved=False)
    old, new = scene.train[-1].load().rgb / 255, relit.train[-1].load().rgb / 255
    inside = (old > 0.1) & (old < 0.9)
    logit = np.log(new / (1 - np.minimum(new, 0.999))) - np.log(old / (1 - np.minimum(old, 0.999)))
    expected = 2 * 2 * np.log(2) / 2.2
    assert np.median(logit[inside]) == pytest.approx(expected, abs=0.05)


def test_names_say_what_is_changed(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(set_variants.hyrfpack, "load_scene", lambda path: asked.append(path) or split_scene())
    scene = load_variant(tmp_path, "balls@5@contiguous")
    assert asked == [tmp_path / "balls"] and len(scene.train) == 5
    for wrong in ("balls@0", "balls@dark", "balls@"):
        with pytest.raises(HyrfError, match="balls@.*there is no change"):
            load_variant(tmp_path, wrong)
