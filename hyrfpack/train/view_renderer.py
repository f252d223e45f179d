"""Renders the training views of a run, and computes the gradients of their losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import nn

from hyrfpack.config.train import TrainConfig
from hyrfpack.device import Photos, upload_array
from hyrfpack.measure.stages import add_seconds
from hyrfpack.model import HybridModel
from hyrfpack.ops.dispatch import GPU_OPERATIONS, replaced_operations
from hyrfpack.ops.viewport import PackedCamera
from hyrfpack.render import RenderSettings
from hyrfpack.render.renderer import pack_camera
from hyrfpack.render.reserve import Reserve, can_reserve
from hyrfpack.scene import Picture, View
from hyrfpack.train.exposure import Exposures
from hyrfpack.train.gradients import StepInputs, StepShape, ViewGradients, compute_gradients
from hyrfpack.train.reserves import ReserveEstimator
from hyrfpack.train.step_graphs import StepGraphs


class ViewRenderer:
    """Renders training views of a model, and computes the gradients of their losses.

    A GPU renders into memory that is reserved beforehand, so that the host launches a view without waiting for numbers.
    It replays the steps that were captured before (`StepGraphs`).

    Attributes:
        graphs: the captured steps. Clear them before a parameter is replaced.
        replays_steps: whether a GPU replays captured steps. If False, the host launches each step, as it does for
            several processes and for models that need more than kernels.
        reserves: estimates the memory for a view; None where none is reserved.
    """

    def __init__(
        self,
        views: Sequence[View],
        config: TrainConfig,
        exposures: Exposures | None,
        device: torch.device,
        *,
        is_single_process: bool,
        has_position_gradients: bool,
    ) -> None:
        """Prepare to render.

        Args:
            views: all training views; those of equal size share a reserve.
            config: settings of the run.
            exposures: the per-image gains that are learnt; None without exposure compensation.
            device: device of the model.
            is_single_process: whether one process trains the model.
            has_position_gradients: whether the fields of the model have gradients in the positions.
        """
        self._views, self._exposures, self._device = views, exposures, device
        self._ssim_weight = config.ssim_weight
        self._photos = Photos(device)
        self._packed_cameras: dict[tuple[str, RenderSettings, int], PackedCamera] = {}
        self.graphs = StepGraphs()
        self.reserves = ReserveEstimator() if can_reserve(device) and is_single_process else None
        # What replaces the kernels may wait for the GPU or upload numbers, which a graph cannot hold.
        has_only_kernels = replaced_operations().isdisjoint(GPU_OPERATIONS) and not has_position_gradients
        self.replays_steps = self.reserves is not None and has_only_kernels

    def compute_gradients(
        self,
        model: HybridModel,
        parameters: Sequence[nn.Parameter],
        view: View,
        picture: Picture,
        solid: np.ndarray,
        settings: RenderSettings,
        *,
        absgrad: bool,
    ) -> ViewGradients:
        """Render a view, and compute the gradients of its loss. The next call may overwrite the result.

        Args:
            model: the model that is trained.
            parameters: the parameters whose gradients are computed.
            view, picture: the view and its photo, at the resolution of the step.
            solid: (3,) colour behind transparent pixels of the photo, and behind a model without a background sphere.
            settings: settings of the rendering.
            absgrad: whether to collect absolute gradients of the projected centres.

        Raises:
            HyrfError: a number to be rendered is not finite; see `render_view`.
        """
        seconds: dict[str, float] = {}
        with add_seconds(seconds, "data"):
            inputs = self._upload_inputs(model, view, picture, solid, settings)
        size = view.camera.width, view.camera.height
        reserve = self._estimate_reserve(view, len(model))
        shape = StepShape(size, settings, absgrad, inputs.mask is not None, reserve, view.camera)

        def compute(shape: StepShape, inputs: StepInputs) -> ViewGradients:
            return compute_gradients(model, self._exposures, parameters, self._ssim_weight, shape, inputs)

        result = self.graphs.run(compute, shape, inputs) if self.replays_steps else compute(shape, inputs)
        return replace(result, seconds={**seconds, **result.seconds})

    def _upload_inputs(
        self, model: HybridModel, view: View, picture: Picture, solid: np.ndarray, settings: RenderSettings
    ) -> StepInputs:
        """Return a photo and what else its gradients are computed from, on the device."""
        target, mask = self._photos.get(view.load, picture, solid)
        color_behind = None if model.config.background else upload_array(solid, self._device)
        photo_row = None if self._exposures is None else self._exposures.row(view)
        if self.reserves is None:
            return StepInputs(target, mask, color_behind, photo_row)
        key = view.name, settings, view.camera.width
        camera = self._packed_cameras.get(key)
        if camera is None:
            camera = self._packed_cameras[key] = pack_camera(model, view.camera, settings)
        return StepInputs(target, mask, color_behind, photo_row, camera)

    def _estimate_reserve(self, view: View, gaussians: int) -> Reserve | None:
        """Return the memory to render a view into: the same for all views of a size, so that they share a graph."""
        return None if self.reserves is None else self.reserves.estimate_shared(self._views, view, gaussians)
