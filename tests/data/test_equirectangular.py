from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from made_up_photos import arc_pose, wall_textures
from made_up_photos import render_panorama as render_room_panorama
from PIL import Image

from hyrfpack.data import load_scene
from hyrfpack.data.equirectangular import CUBE_FACES, cut_face, cut_panorama, face_lens, face_size, is_panorama
from hyrfpack.data.masks import assign_masks
from hyrfpack.errors import HyrfDataError
from hyrfpack.make.source import LoadSettings


def sky_colors(directions: np.ndarray) -> np.ndarray:
    """Return the colours (..., 3) in [0, 255] of a synthetic sky that is smooth in the direction (..., 3)."""
    x, y, z = np.moveaxis(directions / np.linalg.norm(directions, axis=-1, keepdims=True), -1, 0)
    waves = np.stack((np.sin(3 * x + y), np.cos(4 * y - 2 * z * x), np.sin(5 * z + 2 * y * x)), axis=-1)
    return 127.5 + 100 * waves


def render_panorama(height: int, finer: int = 1) -> np.ndarray:
    """Render a (H, 2 H, 3) uint8 panorama by the definition of longitude and latitude, `finer` ** 2 samples a pixel."""
    longitude = ((np.arange(2 * height * finer) + 0.5) / (2 * height * finer) - 0.5) * 2 * np.pi
    latitude = ((np.arange(height * finer) + 0.5) / (height * finer) - 0.5) * np.pi
    lon, lat = np.meshgrid(longitude, latitude)
    directions = np.stack((np.sin(lon) * np.cos(lat), np.sin(lat), np.cos(lon) * np.cos(lat)), axis=-1)
    colors = sky_colors(directions).reshape(height, finer, 2 * height, finer, 3).mean(axis=(1, 3))
    return np.round(colors).astype(np.uint8)


def render_face(face, size: int) -> np.ndarray:
    """Return what a 90 degree pinhole camera sees of the synthetic sky through the middle of each pixel."""
    lens = face_lens(size)
    v, u = np.mgrid[0:size, 0:size] + 0.5
    rays = np.stack(((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)), axis=-1)
    return sky_colors(rays @ face.rotation)  # the transpose maps columns from the face to the panorama's camera


@pytest.mark.parametrize("face", CUBE_FACES, ids=lambda face: face.name)
@pytest.mark.parametrize(("height", "size"), [(256, 163), (256, 64), (100, 200)])
def test_a_face_matches_the_view_of_a_pinhole_camera(face, height, size):
    error = cut_face(render_panorama(height), face, size).astype(float) - render_face(face, size)

    assert (
        np.abs(error).max() < 2.5 and np.sqrt(np.mean(error**2)) < 0.7
    )  # in levels of 255; rounding twice alone gives 0.4


def test_faces_are_proper_rotations_that_cover_all_directions():
    rays = np.random.default_rng(0).normal(size=(500, 3))

    for face in CUBE_FACES:
        assert np.linalg.det(face.rotation) == pytest.approx(1)
        np.testing.assert_array_equal(face.rotation @ face.rotation.T, np.eye(3))
    local = np.stack([rays @ face.rotation.T for face in CUBE_FACES])
    inside = (local[..., 2] > 0) & (np.abs(local[..., :2]) <= local[..., 2:]).all(axis=-1)
    assert (inside.sum(axis=0) == 1).all()


def test_forward_is_the_middle_of_the_panorama_and_up_its_top():
    picture = np.zeros((64, 128, 3), np.uint8)
    picture[28:36, 60:68] = (255, 0, 0)  # the forward direction
    picture[28:36, 92:100] = (0, 255, 0)  # a quarter turn to the right
    picture[:3] = (0, 0, 255)
    middles = {face.name: tuple(cut_face(picture, face, 41)[20, 20]) for face in CUBE_FACES}

    assert middles["front"] == (255, 0, 0) and middles["right"] == (0, 255, 0) and middles["up"] == (0, 0, 255)
    assert middles["down"] == middles["back"] == middles["left"] == (0, 0, 0)


def test_detail_finer_than_a_face_is_averaged():
    """The stripes are one pixel wide; taking every second column would give black and white bands."""
    stripes = np.zeros((512, 1024, 3), np.uint8)
    stripes[:, ::2] = 255

    for face in CUBE_FACES:
        inner = cut_face(stripes, face, 40)[4:-4, 4:-4].astype(float)
        assert np.abs(inner - 127.5).max() < 12, face.name


@pytest.mark.parametrize("channels", [1, 4])
def test_faces_keep_the_number_of_channels(channels):
    assert (
        cut_face(np.full((32, 64, channels), 9, np.uint8), CUBE_FACES[0], 20).tolist() == [[[9] * channels] * 20] * 20
    )


def test_a_picture_of_another_shape_is_rejected_as_a_panorama(tmp_path):
    Image.new("RGB", (90, 60)).save(tmp_path / "a.png")

    with pytest.raises(ValueError, match="90 x 60"):
        cut_face(np.zeros((60, 90, 3), np.uint8), CUBE_FACES[0], 8)
    with pytest.raises(HyrfDataError, match="twice as wide as high, but this one is 90 x 60"):
        cut_panorama(tmp_path / "a.png", tmp_path)


def test_faces_are_written_as_files(tmp_path):
    Image.fromarray(render_panorama(128)).save(tmp_path / "street.png")

    files = cut_panorama(tmp_path / "street.png", tmp_path / "faces")

    assert [file.name for file in files] == [f"street_{face.name}.jpg" for face in CUBE_FACES]
    for file, face in zip(files, CUBE_FACES, strict=True):
        picture = np.asarray(Image.open(file)).astype(float)
        assert picture.shape == (face_size(256), face_size(256), 3)
        assert np.abs(picture - render_face(face, len(picture))).mean() < 2


def test_panoramas_are_recognised_by_shape_and_content(tmp_path):
    Image.fromarray(render_panorama(256)).save(tmp_path / "sky.png")
    Image.fromarray(render_panorama(256)[64:192, 100:356]).save(tmp_path / "part.png")
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (256, 512, 3), np.uint8)).save(tmp_path / "noise.png")

    assert is_panorama(tmp_path / "sky.png")
    assert not is_panorama(tmp_path / "part.png") and not is_panorama(tmp_path / "noise.png")


def picture_of_object(width: int, background: np.ndarray) -> np.ndarray:
    """Return a (256, 512, 3) picture of a textured object before a background (256, 512), with noise."""
    generator = np.random.default_rng(0)
    picture = np.repeat(background[..., None], 3, axis=2) + generator.normal(0, 2, (256, 512, 3))
    picture[40:216, 256 - width // 2 : 256 + width // 2] = generator.uniform(0, 255, (176, width, 3))
    return picture.clip(0, 255).astype(np.uint8)


PLAIN_WALL = np.full((256, 512), 200.0)
TABLE_BEFORE_WALL = np.where(np.arange(256)[:, None] < 150, PLAIN_WALL, 90.0)


@pytest.mark.parametrize(
    "picture",
    [
        np.full((256, 512, 3), 128, np.uint8),
        picture_of_object(200, PLAIN_WALL),
        picture_of_object(400, PLAIN_WALL),
        picture_of_object(200, TABLE_BEFORE_WALL),
        picture_of_object(200, PLAIN_WALL - 60 * np.linspace(-1, 1, 512) ** 2),
        np.random.default_rng(0).normal(8, 6, (256, 512, 3)).clip(0, 255).astype(np.uint8),
    ],
    ids=["grey", "object", "wide object", "object on a table", "darker edges", "dark and noisy"],
)
def test_photos_with_plain_edges_are_not_recognised_as_panoramas(picture, tmp_path):
    Image.fromarray(picture).save(tmp_path / "photo.png")
    assert not is_panorama(tmp_path / "photo.png")


@pytest.mark.acceptance
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_rendered_panoramas_of_a_room_are_recognised(share, tmp_path):
    panorama = render_room_panorama(arc_pose(share), wall_textures())
    Image.fromarray(panorama).save(tmp_path / "room.jpg", quality=95)
    assert is_panorama(tmp_path / "room.jpg")


def test_real_photos_cropped_to_2_by_1_are_not_recognised_as_panoramas(shared_data, tmp_path):
    for name in ("mipnerf360_bonsai", "gerrard_hall", "street_lund", "drone_caliterra"):
        for photo in sorted((shared_data / name / "images").iterdir())[::10]:
            with Image.open(photo) as picture:
                width = picture.width // 2 * 2
                picture.convert("RGB").crop((0, 0, width, width // 2)).save(tmp_path / "crop.png")
            assert not is_panorama(tmp_path / "crop.png"), photo


# -- posed panoramas ---------------------------------------------------------------------------------------------------


def write_posed_panoramas(root: Path, height: int = 128) -> None:
    """Write two panoramas of the synthetic sky with transforms.json; the second is turned 90 degrees about world y."""
    quarter = [[0, 0, 1, 2.0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": m}
        for name, m in (("a", np.eye(4).tolist()), ("b", quarter))
    ]
    (root / "images").mkdir()
    for name in "ab":
        Image.fromarray(render_panorama(height)).save(root / "images" / f"{name}.png")
    (root / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))


def test_posed_panoramas_become_views_with_the_right_directions(tmp_path):
    write_posed_panoramas(tmp_path)

    views = {view.name: view for view in load_scene(tmp_path, test_every=0).views}

    assert len(views) == 12
    for face in CUBE_FACES:
        view = views[f"a_{face.name}.png"]
        # In the OpenGL world, the panorama's down is the world's -y and its forward is the world's -z.
        np.testing.assert_allclose(view.camera.rotation, face.rotation @ np.diag([1.0, -1, -1]), atol=1e-12)
        np.testing.assert_allclose(view.load().rgb, render_face(face, view.camera.width), atol=2.5)
    np.testing.assert_allclose(views["b_front.png"].camera.forward, (-1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(views["b_left.png"].camera.position, (2, 0, 0), atol=1e-12)


def test_faces_are_reduced_and_masked_with_their_panorama(tmp_path):
    write_posed_panoramas(tmp_path)
    mask = np.full((128, 256), 255, np.uint8)
    mask[88:] = 0  # the photographer, from 34 degrees below the horizon
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "a.png")

    views = {view.name: view.load() for view in load_scene(tmp_path, test_every=0, max_size=40).views}

    assert views["a_down.png"].rgb.shape == (40, 40, 3)
    assert not views["a_down.png"].mask[10:30, 10:30].any() and views["a_up.png"].mask.all()
    # In its middle, the face reaches 45 degrees below the horizon. Pixels that mix with the photographer count, too.
    assert 0 < (~views["a_front.png"].mask).mean() < 0.2 + 1 / 40
    assert views["b_down.png"].mask is None


def test_no_colour_of_a_shrunk_face_comes_from_masked_pixels(tmp_path):
    write_posed_panoramas(tmp_path, 256)
    mask = np.full((256, 512), 255, np.uint8)
    mask[:, 255:258] = 0  # a pole
    photo = np.asarray(Image.open(tmp_path / "images" / "a.png")).copy()
    photo[:, 255:258] = 255, 0, 255
    Image.fromarray(photo).save(tmp_path / "images" / "a.png")
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "a.png")

    front = next(view for view in load_scene(tmp_path, test_every=0, max_size=40).views if view.name == "a_front.png")

    picture, clean = front.load(), render_face(CUBE_FACES[0], 40)
    # The side lobes of the filter that shrinks photos reach further than the pixel, with a tenth of the weight at most.
    assert np.abs(picture.rgb - clean)[picture.mask].max() < 0.1 * 255 and 0.8 < picture.mask.mean() < 1


def test_a_mask_with_the_name_of_a_panorama_is_assigned_to_all_its_faces(tmp_path):
    write_posed_panoramas(tmp_path)
    mask = np.zeros((128, 256), np.uint8)
    mask[:40] = 255  # the sky
    (tmp_path / "skies").mkdir()
    Image.fromarray(mask).save(tmp_path / "skies" / "a.png")

    views = {view.name: view for view in assign_masks(load_scene(tmp_path, test_every=0).views, tmp_path / "skies")}

    assert views.keys() == {f"a_{face.name}.png" for face in CUBE_FACES}
    assert views["a_up.png"].load().mask[10:30, 10:30].all() and not views["a_down.png"].load().mask.any()


def test_transparent_pixels_of_a_panorama_are_ignored_like_masked_ones(tmp_path):
    write_posed_panoramas(tmp_path)
    alpha = np.full((128, 256), 255, np.uint8)
    alpha[100:] = 0  # a tripod that was cut out
    Image.fromarray(np.dstack([render_panorama(128), alpha])).save(tmp_path / "images" / "a.png")

    views = {view.name: view.load() for view in load_scene(tmp_path, test_every=0).views}

    assert all(picture.alpha is None for picture in views.values())
    assert not views["a_down.png"].mask[15:25, 15:25].any() and views["a_up.png"].mask.all()
    assert views["b_down.png"].mask is None


def test_a_split_of_panoramas_includes_all_their_faces(tmp_path):
    write_posed_panoramas(tmp_path, 64)
    content = json.loads((tmp_path / "transforms.json").read_text())
    content |= {"train_filenames": ["images/a.png"], "test_filenames": ["images/b.png"]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))

    scene = load_scene(tmp_path)

    assert {view.name[0] for view in scene.train} == {"a"} and {view.name[0] for view in scene.test} == {"b"}
    assert all(view.is_resampled for view in scene.views)


def test_whole_panoramas_are_held_out(tmp_path):
    write_posed_panoramas(tmp_path, 64)

    scene = load_scene(tmp_path, test_every=2)

    assert {view.name[0] for view in scene.train} == {"b"} and {view.name[0] for view in scene.test} == {"a"}


@pytest.mark.parametrize(("count", "held_out"), [(1, 0), (7, 0), (8, 1), (16, 2)])
def test_for_a_scene_of_few_photos_a_panorama_counts_as_one_and_is_held_out_whole(tmp_path, count, held_out):
    write_posed_panoramas(tmp_path, 64)
    table = json.loads((tmp_path / "transforms.json").read_text())
    table["frames"] = []
    for number in range(count):
        shutil.copy(tmp_path / "images" / "a.png", tmp_path / "images" / f"{number:02d}.png")
        pose = np.eye(4)
        pose[0, 3] = number
        table["frames"].append({"file_path": f"images/{number:02d}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps(table))

    scene = LoadSettings().load(tmp_path)

    photos = {view.name[:2] for view in scene.test}
    assert len(photos) == held_out and len(scene.test) == 6 * held_out and len(scene.views) == 6 * count
    assert photos.isdisjoint(view.name[:2] for view in scene.train)


@pytest.mark.parametrize("test_every", [0, 8])
def test_a_photo_with_the_name_of_a_face_is_rejected(tmp_path, test_every):
    write_posed_panoramas(tmp_path, 64)
    (tmp_path / "images" / "b.png").rename(tmp_path / "images" / "a_front.png")
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"][1] |= {"file_path": "images/a_front.png", "camera_model": "PINHOLE", "fl_x": 64}
    (tmp_path / "transforms.json").write_text(json.dumps(content))

    with pytest.raises(HyrfDataError, match=r"photo a_front.png .* a face of the panorama a.png; rename") as caught:
        load_scene(tmp_path, test_every=test_every)
    assert str(caught.value).startswith(f"{tmp_path}: ")


def test_a_mask_of_another_shape_is_rejected(tmp_path):
    write_posed_panoramas(tmp_path, 64)
    (tmp_path / "masks").mkdir()
    Image.new("L", (64, 64)).save(tmp_path / "masks" / "a.png")

    with pytest.raises(HyrfDataError, match="mask is 64 x 64 but its photo 128 x 64"):
        load_scene(tmp_path)


def test_a_panorama_that_changed_is_rejected(tmp_path):
    write_posed_panoramas(tmp_path, 64)
    view = load_scene(tmp_path).views[0]
    Image.new("RGB", (64, 32)).save(tmp_path / "images" / "a.png")

    with pytest.raises(HyrfDataError, match="changed its size"):
        view.load()
