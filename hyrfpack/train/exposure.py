"""Per-image gains: exposure and white balance of each training photo, learnt beside the model.

The gains are initialised from the colours of tracked points. Before a render is compared with a training photo, the
photo's three gains are applied to it (`hyrfpack.model.exposure.apply_exposure_gains`). The mean of the log gains over
all training photos is zero, so that the model has the photos' mean exposure.
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

from hyrfpack.config.train import TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.format.exposure_header import STOPS_PER_LOG_GAIN
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.model.frame import Frame
from hyrfpack.ops.adam import adam_step
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.scene import Camera, Picture, Scene, View
from hyrfpack.train.exposure_map import ExposureFit, fit_exposure_map

GAIN_DECAY = 1e-4  # Weight decay: this multiple of each log gain is added to its gradient.
MAX_TRACKS_PER_PHOTO = 500  # Of more tracks, the longest ones are taken.
COLOR_WINDOW_RADIUS_PIXELS = 2  # A point's colour in a photo is the mean of a square window around it.
MIN_PIXEL_LEVEL, MAX_PIXEL_LEVEL = 8, 247  # A window with a level outside these is nearly black or clipped.
MIN_POINTS_PER_PHOTO = 10  # A photo with fewer usable points starts with gains of one.
REWEIGHTING_ROUNDS = 10
# Scale of the Cauchy weights in standard deviations: an error of this size has half the weight. With this scale the
# estimate is 95 % efficient for normal errors.
CAUCHY_SCALE = 2.385
# Each photo gets this many virtual observations of gains of one, which determine the gains that tracks leave open.
PRIOR_OBSERVATIONS = 0.01
# Two photos with fewer points in common are not compared, so that a few glossy points cannot shift a whole group.
MIN_SHARED_POINTS = 10


@dataclass(frozen=True)
class Observations:
    """Colours of points in photos.

    Attributes:
        photo, point: (K,) int64 row of the photo, and row of the point, of each observation.
        logits: (K, 3) log(y / (1 - y)) of display-referred RGB y in (0, 1).
    """

    photo: np.ndarray
    point: np.ndarray
    logits: np.ndarray


def observe(scene: Scene, cache: PictureCache) -> Observations:
    """Measure the colours of tracked points in the training photos, reading each photo once.

    Windows that cross the photo's border, or contain masked, transparent, nearly black or nearly white pixels, are left
    out. So are points that only one photo observes.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    seen = {view.name: scene.tracks.get(view.name, np.zeros(0, np.int64)) for view in scene.train}
    lengths = sum((np.bincount(rows, minlength=len(scene.points)) for rows in seen.values()), np.zeros(1, np.int64))
    parts = []
    with closing(cache.stream(view for view in scene.train if len(seen[view.name]))) as pictures:
        numbers = {view.name: number for number, view in enumerate(scene.train)}
        for view, picture in pictures:
            rows = seen[view.name][lengths[seen[view.name]] > 1]
            rows = rows[np.argsort(-lengths[rows], kind="stable")[:MAX_TRACKS_PER_PHOTO]]
            usable, logits = _colors(picture, view.camera, scene.points[rows])
            parts.append((np.full(len(logits), numbers[view.name]), rows[usable], logits))
    if not parts:
        return Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    photo, point, logits = map(np.concatenate, zip(*parts, strict=True))
    shared = np.bincount(point)[point] > 1
    return Observations(photo[shared], point[shared], logits[shared])


def _colors(picture: Picture, camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which of the points (M, 3) are usable, (M,) bool, and the logits of the usable ones' colours."""
    x, y, z = camera.project(points)
    column, row = np.floor(x), np.floor(y)
    inside = (z > 0) & (column >= COLOR_WINDOW_RADIUS_PIXELS) & (column < camera.width - COLOR_WINDOW_RADIUS_PIXELS)
    inside &= (row >= COLOR_WINDOW_RADIUS_PIXELS) & (row < camera.height - COLOR_WINDOW_RADIUS_PIXELS)
    around = np.arange(-COLOR_WINDOW_RADIUS_PIXELS, COLOR_WINDOW_RADIUS_PIXELS + 1)
    rows = row[inside].astype(np.int64)[:, None, None] + around[:, None]
    columns = column[inside].astype(np.int64)[:, None, None] + around
    rgb = picture.rgb[rows, columns]
    good = ((rgb >= MIN_PIXEL_LEVEL) & (rgb <= MAX_PIXEL_LEVEL)).all(axis=(1, 2, 3))
    for counted in (picture.mask, None if picture.alpha is None else picture.alpha == 255):
        if counted is not None:
            good &= counted[rows, columns].all(axis=(1, 2))
    usable = inside.copy()
    usable[inside] = good
    colors = rgb[good].mean(axis=(1, 2)) / 255
    return usable, np.log(colors / (1 - colors))


def estimate_log_gains(observed: Observations, photos: int) -> np.ndarray:
    """Estimate each photo's log gains, (photos, 3), from the colours of shared points.

    Photo i shows point p with the point's colour, changed by the photo's gains g:

        logit y_ip = log g_i + c_p + e        weighted least squares over log g and c

    The weights 1 / (1 + (|e| / 2.385 s)^2) are recomputed in each round, so that occlusions and highlights have little
    weight. Here s is the standard deviation of the residuals, estimated from their median. For given weights the best
    c_p is a weighted mean. That leaves a sparse linear system for the gains, which conjugate gradients solve. Photos
    with fewer than `MIN_POINTS_PER_PHOTO` points get log gains of 0; the others have mean 0. Groups of photos that no
    pair with `MIN_SHARED_POINTS` common points connects are not compared: each group keeps a mean near 0.
    """
    gains = np.zeros((photos, 3))
    known = _has_enough_points(observed, photos)
    if not known.any():
        return gains
    photo, logits = observed.photo, observed.logits
    point = _points_of_groups(observed, photos)
    weights = np.ones(len(photo))
    for _ in range(REWEIGHTING_ROUNDS):
        shares = csr_array((weights, (point, photo)), shape=(point.max() + 1, photos))
        point_weights, photo_weights = shares.sum(1), shares.sum(0) + PRIOR_OBSERVATIONS
        system = diags_array(photo_weights) - shares.T @ diags_array(1 / point_weights) @ shares
        errors = np.empty_like(logits)
        for channel, logit in enumerate(logits.T):
            rest = logit - _means(point, weights, logit)[point]
            right = np.bincount(photo, weights * rest, minlength=photos)
            preconditioner = diags_array(1 / photo_weights)
            gains[:, channel], _ = cg(system, right, gains[:, channel], rtol=1e-6, M=preconditioner)
            rest = logit - gains[photo, channel]
            errors[:, channel] = rest - _means(point, weights, rest)[point]
        size = np.sqrt((errors**2).mean(1))
        spread = max(1.4826 * float(np.median(size)), 1e-4)
        weights = 1 / (1 + (size / (CAUCHY_SCALE * spread)) ** 2)
    gains[~known] = 0
    gains[known] -= gains[known].mean(0)
    return gains


def _has_enough_points(observed: Observations, photos: int) -> np.ndarray:
    """Return whether each photo has enough points to estimate its gains, (photos,) bool."""
    return np.bincount(observed.photo, minlength=photos) >= MIN_POINTS_PER_PHOTO


def _points_of_groups(observed: Observations, photos: int) -> np.ndarray:
    """Return point rows (K,) in which a point that several groups of photos observe has one row for each group."""
    _, point = np.unique(observed.point, return_inverse=True)
    sees = csr_array((np.ones(len(point)), (observed.photo, point)), shape=(photos, point.max() + 1))
    _, group = connected_components((sees @ sees.T) >= MIN_SHARED_POINTS, directed=False)
    _, point = np.unique(np.stack((point, group[observed.photo])), axis=1, return_inverse=True)
    return point.ravel()


def _means(group: np.ndarray, weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the weighted mean of each group's values."""
    return np.bincount(group, weights * values) / np.bincount(group, weights)


class Exposures:
    """The gains of each training photo and their Adam state.

    Attributes:
        values: (N, 3) log gains of the N photos, in their order, with mean zero; with virtual views one more row, which
            is theirs and stays zero.
    """

    def __init__(
        self, views: Sequence[View], gains: np.ndarray, device: torch.device, virtual: Sequence[View] = ()
    ) -> None:
        """Start from `gains`, (N, 3) log gains of the photos, less their mean.

        Args:
            views: the photos.
            virtual: views that have the exposure of the model itself.
        """
        self._row = {view.name: row for row, view in enumerate(views)}
        self._photos, self._virtual = len(views), {view.name for view in virtual}
        rows = np.concatenate([gains - gains.mean(0), np.zeros((min(1, len(virtual)), 3))])
        self.values = nn.Parameter(torch.from_numpy(rows).float().to(device))
        self._exp_avg, self._exp_avg_sq = torch.zeros_like(self.values), torch.zeros_like(self.values)
        self._steps = [0] * len(views)
        self._stepped: list[int] = []  # The rows of the last step.
        self._rows_on_device = torch.arange(len(rows), device=device)

    def row(self, view: View) -> Tensor:
        """Return the row (1,) int64 of a view, on the device."""
        row = self._photos if view.name in self._virtual else self._row[view.name]
        return self._rows_on_device[row : row + 1]

    def exposed(self, rgb: Tensor, row: Tensor) -> Tensor:
        """Apply the gains of the photo in a row, see `row`, to its render (H, W, 3); differentiable."""
        return apply_exposure_gains(rgb, self.values.index_select(0, row)[0].exp())

    def fit_map(self, frame: Frame, views: Sequence[View]) -> ExposureFit:
        """Fit an exposure map to the gains, given the model's frame and the same photos as at construction."""
        poses = [frame.local_pose(view.camera) for view in views]
        return fit_exposure_map(poses, self.values[: self._photos].detach().cpu().numpy())

    def to_dict(self) -> dict[str, list[float]]:
        """Return the three log gains of each photo, by its name."""
        values = self.values.detach().cpu().tolist()
        return {name: values[row] for name, row in self._row.items()}

    @torch.no_grad()
    def step(self, rate: float, views: Iterable[View], enabled: Tensor | None = None) -> Tensor:
        """Take one Adam step for the photos of these views, clear the gradients, and subtract the mean of all gains.

        Args:
            enabled: bool scalar on the device; if it is False, no gain changes. Then call `retract_step`.

        Returns:
            Bool scalar on the device: whether a gradient was not finite. Such a gain stays as it is. The host does not
            wait for the device.
        """
        assert self.values.grad is not None
        views = list(views)
        photos = [self._row[view.name] for view in views if view.name not in self._virtual]
        rows = self._stepped = sorted(set(photos))
        for row in rows:
            self._steps[row] += 1
        if not rows:
            self.values.grad = None
            return torch.zeros((), dtype=torch.bool, device=self.values.device)
        decay = GAIN_DECAY / len(views)  # The gradients are those of the mean loss of all views.
        gradients = [self.values.grad[row] + decay * self.values[row] for row in rows]
        values, *moments = ([tensor[row] for row in rows] for tensor in (self.values, self._exp_avg, self._exp_avg_sq))
        steps = [self._steps[row] for row in rows]
        broken = adam_step(values, gradients, *moments, step=steps, rate=rate, enabled=enabled).any()
        self.values.grad = None
        gains = self.values[: self._photos]
        mean = gains.mean(0)
        gains.sub_(mean if enabled is None else torch.where(enabled, mean, 0))
        return broken

    def retract_step(self) -> None:
        """Discount the last step, which was not enabled and is to be taken again."""
        for row in self._stepped:
            self._steps[row] -= 1

    def state_dict(self) -> dict[str, Tensor]:
        """Return gains, Adam moments and step counts."""
        return {
            "values": self.values.detach(),
            "exp_avg": self._exp_avg,
            "exp_avg_sq": self._exp_avg_sq,
            "steps": torch.tensor(self._steps),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned for the same views."""
        device = self.values.device
        values, self._exp_avg, self._exp_avg_sq = (
            state[name].to(device).clone() for name in ("values", "exp_avg", "exp_avg_sq")
        )
        self.values = nn.Parameter(values)
        self._steps = state["steps"].tolist()


def estimate_exposure_spread(scene: Scene, cache: PictureCache) -> float | None:
    """Estimate the standard deviation of the training photos' exposures in stops, from their tracks.

    Returns:
        The standard deviation; None if fewer than two photos have `MIN_POINTS_PER_PHOTO` usable points.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    observed = observe(scene, cache)
    return _spread_of(observed, estimate_log_gains(observed, len(scene.train)))


def describe_exposure_spread(spread: float | None) -> str:
    """Describe in words what `estimate_exposure_spread` returned."""
    if spread is None:
        return "too few tracks show the photos' exposures"
    return f"by their tracks the photos differ by {spread:.2f} stops"


def _spread_of(observed: Observations, gains: np.ndarray) -> float | None:
    """Return the standard deviation of exposures in stops, given log gains (N, 3); None if too few were estimated."""
    if np.count_nonzero(_has_enough_points(observed, len(gains))) < 2:
        return None
    return float(gains.mean(1).std()) * STOPS_PER_LOG_GAIN


def initialize_exposures(
    scene: Scene,
    config: TrainConfig,
    cache: PictureCache,
    device: torch.device,
    ranks: Ranks = SINGLE_PROCESS,
    virtual: Sequence[View] = (),
) -> tuple[Exposures | None, str]:
    """Estimate the per-image gains that a run starts from, if `config.exposure` is True.

    Of several processes, all of which call this, the main one estimates them, so that they are the same on all.

    Returns:
        The gains, None if exposure compensation is off; and a description for the run's record.

    Raises:
        HyrfTrainingError: exposure compensation is on and the photos have transparency.
        HyrfDataError: a photo cannot be read.
    """
    if not config.exposure:
        return None, "off"
    if scene.has_alpha:
        raise HyrfTrainingError(
            f"{scene.path}: per-image gains do not work with transparent photos, whose background has one exposure",
            fix="leave out `exposure`",
        )
    gains, reason = ranks.run_on_main(lambda: _initial_gains(scene, cache))
    return Exposures(scene.train, gains, device, virtual), f"per-image gains; {reason}"


def _initial_gains(scene: Scene, cache: PictureCache) -> tuple[np.ndarray, str]:
    """Return the log gains (N, 3) that tracks of the training photos show, and their spread in words."""
    observed = observe(scene, cache)
    gains = estimate_log_gains(observed, len(scene.train))
    return gains, describe_exposure_spread(_spread_of(observed, gains))
