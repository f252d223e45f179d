"""Exposure and white balance of each training photo: estimated from tracks, learnt beside the model, left out of it.

A photo is taken to be the picture that the model renders, exposed by gains of three channels (`evaluate.exposure`). The
mean of their logarithms over all training photos is zero, so that the model has the photos' mean exposure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from torch import Tensor, nn

from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.format.exposure_header import STOPS_PER_LOG_GAIN
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.model.frame import Frame
from hyrfpack.ops.adam import adam_step
from hyrfpack.scene import Camera, Picture, Scene, View
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.exposure_map import ExposureFit, fit_exposure_map

PULL = 1e-4  # towards gains of one: the gradient of a gain's logarithm, for each unit of it
LONGEST = 500  # tracks of a photo that are looked at, the longest ones
REACH = 2  # pixels around a point whose mean is its colour in a photo
USABLE = 8, 247  # of 255, that every pixel of it lies between
LEAST = 10  # usable points, of a photo whose gains are told
ROUNDS = 10  # of reweighting
CAUCHY = 2.385  # standard deviations at which an observation counts half; 95 % efficient for normal errors
DAMPING = 0.01  # observations of gains of one that each photo gets: they hold what nothing else determines
MIN_SHARED_POINTS = (
    10  # of two photos whose exposures are compared: a few glossy points must not set a whole group apart
)


@dataclass(frozen=True)
class Observations:
    """Colours of points in photos.

    Attributes:
        photo, point: (K,) int64 rows of the photos and of the points.
        logits: (K, 3) log(y / (1 - y)) of display-referred RGB y in (0, 1).
    """

    photo: np.ndarray
    point: np.ndarray
    logits: np.ndarray


def observe(scene: Scene, cache: PictureCache) -> Observations:
    """Colours that the training photos show where their tracks have points; each photo is read once.

    Left out: what lies near the border, masked, transparent, nearly black or white, and points that no other photo
    sees; of each photo the longest tracks count.
    """
    seen = {view.name: scene.tracks.get(view.name, np.zeros(0, np.int64)) for view in scene.train}
    lengths = sum((np.bincount(rows, minlength=len(scene.points)) for rows in seen.values()), np.zeros(1, np.int64))
    parts = []
    with closing(cache.stream(view for view in scene.train if len(seen[view.name]))) as pictures:
        numbers = {view.name: number for number, view in enumerate(scene.train)}
        for view, picture in pictures:
            rows = seen[view.name][lengths[seen[view.name]] > 1]
            rows = rows[np.argsort(-lengths[rows], kind="stable")[:LONGEST]]
            usable, logits = _colors(picture, view.camera, scene.points[rows])
            parts.append((np.full(len(logits), numbers[view.name]), rows[usable], logits))
    if not parts:
        return Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    photo, point, logits = map(np.concatenate, zip(*parts, strict=True))
    shared = np.bincount(point)[point] > 1
    return Observations(photo[shared], point[shared], logits[shared])


def _colors(picture: Picture, camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the points (M, 3) can be used, and the logits of their colours."""
    x, y, z = (points @ camera.rotation.T + camera.camera_from_world[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = np.floor(camera.fx * x / z + camera.cx), np.floor(camera.fy * y / z + camera.cy)
    inside = (z > 0) & (column >= REACH) & (column < camera.width - REACH)
    inside &= (row >= REACH) & (row < camera.height - REACH)
    around = np.arange(-REACH, REACH + 1)
    rows = row[inside].astype(np.int64)[:, None, None] + around[:, None]
    columns = column[inside].astype(np.int64)[:, None, None] + around
    rgb = picture.rgb[rows, columns]
    good = ((rgb >= USABLE[0]) & (rgb <= USABLE[1])).all(axis=(1, 2, 3))
    for counted in (picture.mask, None if picture.alpha is None else picture.alpha == 255):
        if counted is not None:
            good &= counted[rows, columns].all(axis=(1, 2))
    usable = inside.copy()
    usable[inside] = good
    colors = rgb[good].mean(axis=(1, 2)) / 255
    return usable, np.log(colors / (1 - colors))


def gains_from(observed: Observations, photos: int) -> np.ndarray:
    """Logarithms of each photo's gains, (photos, 3), with a mean of zero over those that anything is known of.

    A point has one colour, and a photo shows it exposed by the photo's gains g:

        logit y_ip = log g_i + c_p + e        weighted least squares over log g and c

    with weights 1 / (1 + (|e| / 2.385 s)^2), iterated, and s the standard deviation of the rest by its median, so that
    occlusions and highlights hardly count. For given weights the best c_p is a mean, which leaves a sparse system of
    the gains, solved by conjugate gradients. Photos that fewer than LEAST points tell of get 0. Groups of photos
    that no two photos with MIN_SHARED_POINTS points in common connect are not compared: each keeps a mean near 0.
    """
    gains = np.zeros((photos, 3))
    known = np.bincount(observed.photo, minlength=photos) >= LEAST
    if not known.any():
        return gains
    photo, logits = observed.photo, observed.logits
    point = _points_of_groups(observed, photos)
    weights = np.ones(len(photo))
    for _ in range(ROUNDS):
        shares = csr_array((weights, (point, photo)), shape=(point.max() + 1, photos))
        total, held = shares.sum(1), shares.sum(0) + DAMPING
        system = diags_array(held) - shares.T @ diags_array(1 / total) @ shares
        errors = np.empty_like(logits)
        for channel, logit in enumerate(logits.T):
            rest = logit - _means(point, weights, logit)[point]
            told = np.bincount(photo, weights * rest, minlength=photos)
            gains[:, channel], _ = cg(system, told, gains[:, channel], rtol=1e-6, M=diags_array(1 / held))
            rest = logit - gains[photo, channel]
            errors[:, channel] = rest - _means(point, weights, rest)[point]
        size = np.sqrt((errors**2).mean(1))
        spread = max(1.4826 * float(np.median(size)), 1e-4)
        weights = 1 / (1 + (size / (CAUCHY * spread)) ** 2)
    gains[~known] = 0
    gains[known] -= gains[known].mean(0)
    return gains


def _points_of_groups(observed: Observations, photos: int) -> np.ndarray:
    """(K,) rows of points, where a point that several groups of photos see is another one in each of them."""
    _, point = np.unique(observed.point, return_inverse=True)
    sees = csr_array((np.ones(len(point)), (observed.photo, point)), shape=(photos, point.max() + 1))
    _, group = connected_components((sees @ sees.T) >= MIN_SHARED_POINTS, directed=False)
    _, point = np.unique(np.stack((point, group[observed.photo])), axis=1, return_inverse=True)
    return point.ravel()


def _means(group: np.ndarray, weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The weighted mean of each group's values."""
    return np.bincount(group, weights * values) / np.bincount(group, weights)


class Exposures:
    """The gains of each training photo and Adam's state of them.

    Attributes:
        values: (N, 3) logarithms of the gains, in the order of the views, of mean zero over these.
    """

    def __init__(self, views: Sequence[View], gains: np.ndarray, device: torch.device) -> None:
        """Args: gains: (N, 3) logarithms to start from."""
        self._row = {view.name: row for row, view in enumerate(views)}
        self.values = nn.Parameter(torch.from_numpy(gains - gains.mean(0)).float().to(device))
        self._exp_avg, self._exp_avg_sq = torch.zeros_like(self.values), torch.zeros_like(self.values)
        self._steps = [0] * len(views)

    def exposed(self, rgb: Tensor, view: View) -> Tensor:
        """A render (H, W, 3) as the view's photo was exposed; differentiable."""
        return apply_exposure_gains(rgb, self.values[self._row[view.name]].exp())

    def fit_map(self, frame: Frame, views: Sequence[View]) -> ExposureFit:
        """Fit the exposure map of the views' gains; `views` as at the start, `frame` that of the model."""
        poses = [frame.local_pose(view.camera) for view in views]
        return fit_exposure_map(poses, self.values.detach().cpu().numpy())

    @torch.no_grad()
    def step(self, rate: float, views: Iterable[View]) -> Tensor:
        """One step of Adam for the photos of these views, by the gradients of `values`, which are cleared; then the
        mean of all is taken off.

        Returns:
            Bool scalar on the device: whether a gradient was not finite, whose gain took no step. Nothing waits for
            the device.
        """
        assert self.values.grad is not None
        rows = sorted({self._row[view.name] for view in views})
        for row in rows:
            self._steps[row] += 1
        gradients = [self.values.grad[row] + PULL * self.values[row] for row in rows]
        values, *moments = ([tensor[row] for row in rows] for tensor in (self.values, self._exp_avg, self._exp_avg_sq))
        broken = adam_step(values, gradients, *moments, step=[self._steps[row] for row in rows], rate=rate).any()
        self.values.grad = None
        self.values.sub_(self.values.mean(0))
        return broken

    def state_dict(self) -> dict[str, Tensor]:
        """Gains, moments and step counts."""
        return {
            "values": self.values.detach(),
            "exp_avg": self._exp_avg,
            "exp_avg_sq": self._exp_avg_sq,
            "steps": torch.tensor(self._steps),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """The inverse of `state_dict`; the views must be those of then."""
        device = self.values.device
        values, self._exp_avg, self._exp_avg_sq = (
            state[name].to(device).clone() for name in ("values", "exp_avg", "exp_avg_sq")
        )
        self.values = nn.Parameter(values)
        self._steps = state["steps"].tolist()


def exposure_spread(scene: Scene, cache: PictureCache) -> float:
    """Standard deviation of the training photos' exposures by their tracks, stops; 0 where no tracks tell.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    return float(gains_from(observe(scene, cache), len(scene.train)).mean(1).std()) * STOPS_PER_LOG_GAIN


def exposures_for(
    scene: Scene, config: TrainConfig, cache: PictureCache, device: torch.device
) -> tuple[Exposures | None, str]:
    """Estimate the per-image gains that a run starts from.

    Gains are learnt only where `config.exposure` says so.

    Returns:
        The gains, None where exposure compensation is off, and a sentence for the run's record.

    Raises:
        HyrfTrainingError: exposure compensation is on and the photos have transparency.
        HyrfDataError: a photo cannot be read.
    """
    if not config.exposure:
        return None, "off"
    if scene.has_alpha:
        raise HyrfTrainingError(
            f"{scene.path}: photos with transparency are laid over a colour of one exposure; leave out `exposure`"
        )
    observed = observe(scene, cache)
    gains = gains_from(observed, len(scene.train))
    known = len(np.unique(observed.photo))
    spread = float(gains.mean(1).std()) * STOPS_PER_LOG_GAIN
    found = f"by their tracks the photos differ by {spread:.2f} stops" if known else "no tracks tell of the photos"
    return Exposures(scene.train, gains, device), f"per-image gains; {found}"
