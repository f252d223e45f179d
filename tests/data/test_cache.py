from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest

from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera, Picture, View


class CountedPhoto:
    """A `load` function that counts its calls."""

    def __init__(self, value: int, size: int = 10, fails: bool = False):
        self.value, self.size, self.fails, self.loads = value, size, fails, 0

    def __call__(self) -> Picture:
        self.loads += 1
        if self.fails:
            raise HyrfDataError("gone.png: the picture is missing", fix="restore it")
        return Picture(np.full((self.size, self.size, 3), self.value, np.uint8))


def make_views(*photos: CountedPhoto) -> list[View]:
    camera = Camera(10, 10, 1.0, 1.0, 5.0, 5.0, np.eye(4))
    return [View(f"{index}.png", camera, photo) for index, photo in enumerate(photos)]


def photo_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("hyrfpack-photos")]


def test_pictures_are_decoded_once():
    views = make_views(CountedPhoto(1), CountedPhoto(2))
    cache = PictureCache(10_000)

    for view in views * 3:
        assert cache.get(view).rgb[0, 0, 0] == view.load.value

    assert [view.load.loads for view in views] == [1, 1]
    assert cache.nbytes == 600


def test_the_limit_is_kept_by_dropping_the_least_recently_used_picture():
    a, b, c = make_views(CountedPhoto(1), CountedPhoto(2), CountedPhoto(3))
    cache = PictureCache(700)

    for view in (a, b, a, c, a):
        cache.get(view)
        assert cache.nbytes <= 700
    cache.get(b)

    assert [view.load.loads for view in (a, b, c)] == [1, 2, 1]


def test_the_last_derived_result_is_kept():
    (view,), cache, calls = make_views(CountedPhoto(7)), PictureCache(), []

    def brightness(views, cache):
        calls.append(views)
        return cache.get(views[0]).rgb.mean()

    def half_brightness(views, cache):
        return brightness(views, cache) / 2

    scene, equal = [view], [view]
    assert [cache.derive(brightness, owner) for owner in (scene, scene, equal, equal, scene)] == [7] * 5
    assert len(calls) == 3
    assert cache.derive(half_brightness, scene) == 3.5
    cache.clear()
    assert cache.derive(half_brightness, scene) == 3.5 and len(calls) == 5


def test_a_failed_derivation_keeps_nothing():
    (view,), cache = make_views(CountedPhoto(7, fails=True)), PictureCache()
    for _ in range(2):
        with pytest.raises(HyrfDataError, match="missing"):
            cache.derive(lambda owner, cache: cache.get(owner), view)


def test_picture_above_the_limit_is_not_kept():
    (view,) = make_views(CountedPhoto(1))
    cache = PictureCache(100)

    cache.get(view)
    cache.get(view)

    assert view.load.loads == 2 and cache.nbytes == 0


def test_a_cleared_cache_holds_nothing_and_decodes_again():
    a, b = make_views(CountedPhoto(1), CountedPhoto(2))
    cache = PictureCache(10_000)
    cache.get(a)
    cache.get(b)

    cache.clear()
    assert cache.nbytes == 0
    cache.get(b)

    assert [view.load.loads for view in (a, b)] == [1, 2]


def test_default_limit_is_part_of_the_memory():
    assert 1 << 20 < PictureCache().limit_bytes < 1 << 50


def test_stream_keeps_the_order():
    views = make_views(*(CountedPhoto(index) for index in range(20)))

    streamed = list(PictureCache(0).stream(views))

    assert [view.name for view, _ in streamed] == [view.name for view in views]
    assert all(picture.rgb[0, 0, 0] == view.load.value for view, picture in streamed)
    assert not photo_threads()


def test_stream_decodes_ahead_but_no_further_than_its_depth():
    views = make_views(*(CountedPhoto(index) for index in range(20)))
    stream = PictureCache(0).stream(views, depth=3)

    next(stream)
    stream.close()

    assert 1 <= sum(view.load.loads for view in views) <= 4


def test_stream_of_endless_views_ends_its_thread_when_closed():
    stream = PictureCache(10_000).stream(itertools.cycle(make_views(CountedPhoto(1), CountedPhoto(2))))
    for _ in range(50):
        next(stream)
    assert photo_threads()

    stream.close()

    assert not photo_threads()


def test_stream_raises_a_decoding_error_in_its_turn():
    views = make_views(CountedPhoto(1), CountedPhoto(2), CountedPhoto(3, fails=True), CountedPhoto(4))
    seen = []

    with pytest.raises(HyrfDataError, match=r"gone\.png"):
        for view, _ in PictureCache(0).stream(views):
            seen.append(view.name)

    assert seen == ["0.png", "1.png"]
    assert not photo_threads()


def test_threads_sharing_a_cache_keep_its_size_right():
    views = make_views(*(CountedPhoto(index) for index in range(30)))
    cache = PictureCache(1500)

    def read(seed: int) -> None:
        for index in np.random.default_rng(seed).integers(0, 30, 300):
            assert cache.get(views[index]).rgb[0, 0, 0] == index

    threads = [threading.Thread(target=read, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert cache.nbytes == sum(picture.nbytes for picture in cache._pictures.values()) <= 1500
