"""Choose the held-out photo of a small set, and decide whether its score is meaningful."""

from __future__ import annotations

import numpy as np

from hyrfpack.scene import Scene, View

NEIGHBOUR_CAMERAS = 4
MAX_UNREPRESENTATIVE_VIEWS = 2  # up to this number, the mean score depends on which photos are held out
# A held-out PSNR this far below that of the training photos means four times their squared error.
MAX_PSNR_GAP_DB = 6.0


def choose_inner_view(scene: Scene) -> View:
    """Choose the view that is best surrounded by others; of equally good views, the first by name is chosen.

    Each camera is a point with six coordinates: its position, in units of the median distance from cameras to scene
    points, and its viewing direction. The score of a camera is the mean distance to its NEIGHBOUR_CAMERAS nearest
    neighbours plus the distance to their centre. The first part is large for a camera that is far from all others. The
    second part is large for a camera at the edge, which has all its neighbours on one side. The camera with the lowest
    score is chosen.

    Args:
        scene: a scene with at least two views.
    """
    views = scene.views
    positions = np.array([view.camera.position for view in views])
    directions = np.array([view.camera.forward for view in views])
    cameras = np.hstack((positions / _median_depth(scene, positions), directions))
    offsets = cameras[None] - cameras[:, None]  # [i, j] points from i to j
    scores = []
    for index, others in enumerate(offsets):
        others = np.delete(others, index, axis=0)
        distances = np.linalg.norm(others, axis=1)
        near = np.argsort(distances, kind="stable")[:NEIGHBOUR_CAMERAS]
        scores.append(distances[near].mean() + np.linalg.norm(others[near].mean(axis=0)))
    return views[int(np.argmin(np.round(scores, 9)))]


def _median_depth(scene: Scene, positions: np.ndarray) -> float:
    """Return the median distance from cameras to points; without points, the spread of the cameras, or 1 if it is 0."""
    if len(scene.points):
        depths = [np.median(np.linalg.norm(scene.points - position, axis=1)) for position in positions]
        depth = float(np.median(depths))
    else:
        depth = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean())
    return depth if depth > 0 else 1.0


def score_note(views: int, psnr: float | None, training_psnr: float | None) -> str:
    """Return a sentence that explains why a score says little about the scene; "" if it is meaningful.

    Args:
        views: number of scored held-out photos.
        psnr: their mean PSNR in dB; None if none was scored.
        training_psnr: PSNR of training photos in dB, as the training's last steps measured it; None if unknown.
    """
    if psnr is None:
        return ""
    reasons = []
    if views <= MAX_UNREPRESENTATIVE_VIEWS:
        reasons.append(
            f"only {views} photo{'s were' if views > 1 else ' was'} held out, so that the score depends on "
            f"which {'they are' if views > 1 else 'one it is'}"
        )
    if training_psnr is not None and training_psnr - psnr > MAX_PSNR_GAP_DB:
        reasons.append(
            f"held-out photos score {training_psnr - psnr:.1f} dB less than training photos ({training_psnr:.1f} dB): "
            "they show what few other photos show, or their poses are wrong, or there are too few photos"
        )
    if not reasons:
        return ""
    return f"the score is not representative: {'; and '.join(reasons)}; look at the result to judge it"
