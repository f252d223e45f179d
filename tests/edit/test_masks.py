"""Masks of the photos select what they show."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused, succeeded
from PIL import Image
from scenes import QUIET_CONTEXT, ring, small_model

from hyrfpack.config.edit import CropMasks, CropSphere, Refit, Remove, Scale, Translate
from hyrfpack.data import load_scene
from hyrfpack.edit import edit_model, plan_edit
from hyrfpack.edit.masks import share_of_light_in_masks
from hyrfpack.errors import HyrfError
from hyrfpack.format import load_model
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Picture, View
from tools.safety.train_golden import DEMO_MODEL_FILE

OBJECT_CENTER, OBJECT_RADIUS = (0.0, 0.0, 0.0), 1.0


@pytest.fixture(scope="module")
def is_object() -> np.ndarray:
    model = load_model(DEMO_MODEL_FILE)
    positions = model.config.frame.to_world(model.gaussians.positions.numpy())
    return np.linalg.norm(positions - OBJECT_CENTER, axis=1) <= OBJECT_RADIUS


@pytest.fixture(scope="module")
def masks(scene, is_object, tmp_path_factory) -> Path:
    """Return a folder of masks of the object: where the whole model shows the light of its Gaussians."""
    folder = tmp_path_factory.mktemp("masks")
    model = load_model(DEMO_MODEL_FILE)
    gaussians = model.decode_geometry().with_means(model.gaussians.positions)
    colors = torch.from_numpy(is_object).float()[:, None].expand(-1, 3).contiguous()
    for view in scene.train:
        viewport = model.config.frame.local_viewport(view.camera)
        share = rasterize(gaussians, colors, viewport, RenderSettings().raster_settings(antialiased=False)).rgb[..., 0]
        Image.fromarray((share > 0.5).numpy()).save(folder / f"{Path(view.name).stem}.png")
    return folder


def mask_views(model, cameras, inside) -> list[View]:
    """Return views whose masks are True where `inside(row, column)` is."""

    def picture(camera):
        rows, columns = np.mgrid[: camera.height, : camera.width]
        return Picture(np.zeros((camera.height, camera.width, 3), np.uint8), mask=inside(rows, columns))

    return [View(str(k), camera, lambda camera=camera: picture(camera)) for k, camera in enumerate(cameras)]


def test_the_share_is_that_of_the_pixels_a_gaussian_lights():
    """A Gaussian at the picture's centre is cut in halves, one far to the left lies outside the mask."""
    model = small_model([(0, 0, 0), (0, -0.6, 0)], scale_logits=-3.0, opacity_logits=2.0)
    cameras = ring(1, radius=3.0, elevation=0.0)  # at x = 3, so y points to the right
    right = share_of_light_in_masks(model, mask_views(model, cameras, lambda _, column: column >= 16))
    assert right == pytest.approx([0.5, 0.0], abs=0.01)
    every = share_of_light_in_masks(model, mask_views(model, cameras, lambda _, column: column >= 0))
    assert every == pytest.approx([1.0, 1.0], abs=1e-5)


def test_a_gaussian_that_no_photo_shows_has_no_light_in_masks():
    model = small_model([(0, 0, 0), (50.0, 0, 0)], scale_logits=-3.0, opacity_logits=2.0)
    views = mask_views(model, ring(1, elevation=0.0), lambda _, column: column >= 0)
    assert share_of_light_in_masks(model, views).tolist() == pytest.approx([1, 0], abs=1e-5)


def test_masks_of_an_object_select_its_gaussians(scene, masks, is_object):
    model = load_model(DEMO_MODEL_FILE)
    opaque = model.decode_geometry().opacities.numpy() > 0.3
    assert 50 < is_object.sum() < 0.7 * len(is_object)
    report = plan_edit(DEMO_MODEL_FILE, [CropMasks(str(masks))], data=scene, context=QUIET_CONTEXT)
    kept = report.actions[0].gaussians_after
    from hyrfpack.data.masks import assign_masks

    found = share_of_light_in_masks(model, assign_masks(scene.train, masks)) >= 0.5
    assert found.sum() == kept
    assert found[is_object & opaque].mean() > 0.85
    assert (~found)[~is_object & opaque].mean() > 0.85


def test_masks_select_the_same_in_a_moved_scene(scene, masks):
    crop, other = CropMasks(str(masks)), [Scale(2.0), Translate((1.0, 2.0, 3.0))]
    counts = [
        plan_edit(DEMO_MODEL_FILE, [*moves, crop], data=scene, context=QUIET_CONTEXT).actions[-1].gaussians_after
        for moves in ([], other)
    ]
    assert counts[0] == pytest.approx(counts[1], abs=2)


def test_an_inverted_crop_removes_what_masks_show(scene, masks):
    count = len(load_model(DEMO_MODEL_FILE))
    crop = CropMasks(str(masks))
    kept, removed = (
        plan_edit(DEMO_MODEL_FILE, [action], data=scene, context=QUIET_CONTEXT).actions[0].gaussians_after
        for action in (crop, Remove(crop))
    )
    assert kept + removed == count
    assert str(Remove(crop)) == f"remove what the masks in {masks} show"


def test_the_command_crops_to_masks(photos, masks, tmp_path):
    target = tmp_path / "object.hyrf"
    result = succeeded("edit", DEMO_MODEL_FILE, "-o", target, "--crop-masks", masks, "--data", photos)
    assert "crop to what the masks" in result.stdout and 0 < len(load_model(target)) < len(load_model(DEMO_MODEL_FILE))


def test_masks_that_cannot_be_used_are_a_clear_error(photos, masks, tmp_path):
    command = ("edit", DEMO_MODEL_FILE, "--plan", "--crop-masks")
    assert "name the photos with --data" in refused(*command, masks)
    missing = tmp_path / "none"
    assert "there is no such folder" in refused(*command, missing, "--data", photos)
    missing.mkdir()
    for name in ("one.png", "two.png"):
        Image.new("L", (48, 48)).save(missing / name)
    assert "no mask has the name of a photo" in refused(*command, missing, "--data", photos)
    assert "it holds the photos themselves" in refused(*command, photos / "images", "--data", photos)
    first = next(iter(masks.iterdir())).name
    Image.new("L", (48, 20)).save(missing / first)
    assert "the mask is 48 x 20 but its photo 48 x 48" in refused(*command, missing, "--data", photos)


def test_a_single_mask_does_not_apply_to_all_photos(photos, tmp_path):
    Image.new("L", (48, 48), 255).save(tmp_path / "mask.png")
    assert "no mask has the name of a photo" in refused(
        "edit", DEMO_MODEL_FILE, "--plan", "--crop-masks", tmp_path, "--data", photos
    )


def test_only_masks_of_no_photo_are_reported(photos, masks, scene, tmp_path):
    shutil.copytree(masks, tmp_path / "masks")
    for view in scene.test:
        Image.new("L", (48, 48), 255).save(tmp_path / "masks" / f"{Path(view.name).stem}.png")
    result = succeeded("edit", DEMO_MODEL_FILE, "--plan", "--crop-masks", tmp_path / "masks", "--data", photos)
    assert "no photo" not in result.stderr
    Image.new("L", (48, 48), 255).save(tmp_path / "masks" / "other.png")
    result = succeeded("edit", DEMO_MODEL_FILE, "--plan", "--crop-masks", tmp_path / "masks", "--data", photos)
    assert "masks matches no photo of the scene (such as other.png)" in result.stderr


def test_black_masks_are_refused_because_nothing_is_left(scene, masks, tmp_path):
    for path in masks.iterdir():
        Image.new("L", (48, 48)).save(tmp_path / path.name)
    with pytest.raises(HyrfError, match="would remove every Gaussian"):
        plan_edit(DEMO_MODEL_FILE, [CropMasks(str(tmp_path))], data=scene, context=QUIET_CONTEXT)


def test_a_crop_keeps_at_least_a_sphere_inside_the_object(scene, masks):
    """Crops can follow each other: of the masks' object, the sphere that made it keeps nearly all."""
    actions = [CropMasks(str(masks)), CropSphere(OBJECT_CENTER, 1.3 * OBJECT_RADIUS)]
    report = plan_edit(DEMO_MODEL_FILE, actions, data=scene, context=QUIET_CONTEXT)
    first, second = (action.gaussians_after for action in report.actions)
    assert second > 0.8 * first


@pytest.mark.parametrize("wrap", [lambda crop: crop, Remove, Refit, lambda crop: Refit(Remove(crop))])
def test_no_picture_replaces_a_mask_that_the_edit_reads(photos, masks, tmp_path, wrap):
    folder = Path(shutil.copytree(masks, tmp_path / "masks"))
    mask = next(folder.iterdir())
    before = mask.read_bytes()

    for call in (plan_edit, partial(edit_model, target=tmp_path / "edited.hyrf")):
        with pytest.raises(HyrfError, match="the output is an input itself"):
            call(DEMO_MODEL_FILE, actions=[wrap(CropMasks(str(folder)))], data=load_scene(photos), picture=mask)
    assert mask.read_bytes() == before
