"""tools/studies/video.py: which photos are held out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hyrfpack.scene import Camera, Picture, Scene, View
from tools.studies.video import find_photos, hold_out


def make_scene(*names: str) -> Scene:
    camera = Camera(2, 2, 1.0, 1.0, 1.0, 1.0, np.eye(4))
    views = [View(name, camera, lambda: Picture(np.zeros((2, 2, 3), np.uint8))) for name in names]
    return Scene(Path("."), "colmap", views[1:], views[:1], np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def test_photos_and_frames_hold_out_the_same_photos():
    photo_by_frame = dict(enumerate(Path(name) for name in ("a.jpg", "a.jpg", "b.jpg", "c.jpg", "c.jpg")))
    photos = make_scene("a.jpg", "b.jpg", "c.jpg")
    frames = make_scene("clip_0.png", "clip_1.png", "clip_2.png", "clip_4.png")
    shown = find_photos(photos), find_photos(frames, photo_by_frame)
    photos, frames = (hold_out(s, photo, ["a", "c"]) for s, photo in zip((photos, frames), shown, strict=True))
    assert [view.name for view in photos.test] == ["a.jpg", "c.jpg"]
    assert [view.name for view in frames.test] == ["clip_0.png", "clip_4.png"]
    assert [view.name for view in photos.train] == ["b.jpg"]
    assert [view.name for view in frames.train] == ["clip_2.png"]
