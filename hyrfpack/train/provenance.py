"""What a file states about the photos that its model was trained on."""

from __future__ import annotations

from hyrfpack.cameras.capture import scene_provenance
from hyrfpack.cameras.sampling import BACKGROUND_STRIDE_KEY, DEFAULT_BACKGROUND_STRIDE, PhotoCameras
from hyrfpack.scene import Scene
from hyrfpack.train.resolution import background_stride


def training_provenance(scene: Scene) -> dict:
    """Collect what a trained model's provenance stores of its scene and of the sampling of its photos.

    It adds the stride at which the last training steps evaluate the background, if it is not the default, to
    `scene_provenance`. Of photos of several sizes, it is the smallest one.
    """
    stride, kept = _last_background_stride(scene), scene_provenance(scene)
    return kept if stride == DEFAULT_BACKGROUND_STRIDE else {**kept, BACKGROUND_STRIDE_KEY: stride}


def training_background_spacing(scene: Scene) -> float:
    """Return the spacing of the background's nodes in the last training steps, see `HybridModel.background_spacing`."""
    return PhotoCameras([view.camera for view in scene.train], 1.0, _last_background_stride(scene)).background_spacing


def _last_background_stride(scene: Scene) -> int:
    return min((background_stride(view.camera) for view in scene.train), default=DEFAULT_BACKGROUND_STRIDE)
