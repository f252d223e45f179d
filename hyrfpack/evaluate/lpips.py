"""LPIPS, the learned perceptual distance (Zhang et al. 2018), in plain torch.

The weights are not part of hyrfpack. With the `lpips` package, this makes the file that `LPIPS.load` reads:

    torch.save(lpips.LPIPS(net="alex").state_dict(), "lpips_alex.pt")      # or net="vgg"
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from hyrfpack.errors import HyrfError

# Channel means and standard deviations of the networks' training pictures, for inputs in [-1, 1].
INPUT_MEANS = (-0.030, -0.088, -0.188)
INPUT_STDS = (0.458, 0.448, 0.450)
NORM_EPSILON = 1e-10


@dataclass(frozen=True)
class Network:
    """A feature extractor of five stages of convolutions, each followed by ReLU; LPIPS compares each stage's output.

    Attributes:
        stages: layer numbers of each stage's convolutions, as in torchvision.
        channels: number of output channels of each stage.
        strides, paddings: strides and paddings by layer number, if they differ from 1 and from half the kernel size.
        pool: kernel size of the max-pooling (stride 2) before a stage.
        pooled_stages: the stages that start with pooling.
        min_size_pixels: shortest picture side in pixels for which the last stage has an output.
    """

    stages: tuple[tuple[int, ...], ...]
    channels: tuple[int, ...]
    strides: dict[int, int]
    paddings: dict[int, int]
    pool: int
    pooled_stages: tuple[int, ...]
    min_size_pixels: int


NETWORKS_BY_NAME = {
    "alex": Network(
        ((0,), (3,), (6,), (8,), (10,)),
        (64, 192, 384, 256, 256),
        {0: 4},
        {0: 2},
        pool=3,
        pooled_stages=(1, 2),
        min_size_pixels=31,
    ),
    "vgg": Network(
        ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28)),
        (64, 128, 256, 512, 512),
        {},
        {},
        pool=2,
        pooled_stages=(1, 2, 3, 4),
        min_size_pixels=16,
    ),
}


class LPIPS:
    """Perceptual distance between two pictures: 0 if they are equal, about 0.1 to 0.6 for poor renders.

        d = sum over stages of mean over pixels of sum over channels of w_c (f_c - g_c)^2

    where f and g are the features of the two pictures, each pixel's vector scaled to length 1.

    Attributes:
        name: "alex" or "vgg", recognised by the shape of the weights.
    """

    def __init__(self, state: dict[str, Tensor]) -> None:
        """Extract the weights from an `lpips.LPIPS` state dictionary.

        Raises:
            ValueError: `state` is not such a dictionary, or a weight is missing or has another shape.
        """
        shapes = {(64, 3, 11, 11): "alex", (64, 3, 3, 3): "vgg"}
        shape = tuple(_take_weight(state, "net.slice1.0.weight", 4).shape)
        if shape not in shapes:
            raise ValueError("'net.slice1.0.weight' is not a first convolution of AlexNet or VGG-16")
        self.name = shapes[shape]
        self.network = NETWORKS_BY_NAME[self.name]
        self._convolutions: dict[int, tuple[Tensor, Tensor]] = {}
        self._channel_weights: list[Tensor] = []
        width = 3
        for stage, (layers, channels) in enumerate(zip(self.network.stages, self.network.channels, strict=True)):
            for layer in layers:
                name = f"net.slice{stage + 1}.{layer}"
                weight, bias = _take_weight(state, f"{name}.weight", 4), _take_weight(state, f"{name}.bias", 1)
                if weight.shape[:2] != (channels, width) or bias.shape != (channels,):
                    raise ValueError(f"'{name}' has the shape {tuple(weight.shape)}")
                self._convolutions[layer] = weight, bias
                width = channels
            key = next((key for key in state if re.fullmatch(rf"lin{stage}\.model\.\d+\.weight", str(key))), "")
            linear = _take_weight(state, key or f"lin{stage}.model.1.weight", 4)
            if linear.shape != (1, channels, 1, 1):
                raise ValueError(f"'{key}' has the shape {tuple(linear.shape)}")
            self._channel_weights.append(linear)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> LPIPS:
        """Read the weights file, without executing code from it.

        Raises:
            HyrfError: the file is missing, or does not hold the weights of an `lpips.LPIPS`.
        """
        advice = 'make it with torch.save(lpips.LPIPS(net="alex").state_dict(), FILE)'
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except OSError as error:
            raise HyrfError(
                f"{path}: the LPIPS weights cannot be read ({error.strerror or error})",
                fix=advice,
            ) from error
        except Exception as error:  # torch's unpickler raises exceptions of many types, with long advice
            raise HyrfError(f"{path}: these are not LPIPS weights (no tensors saved by torch)", fix=advice) from error
        try:
            return cls(state if isinstance(state, dict) else {})
        except ValueError as error:
            raise HyrfError(f"{path}: these are not LPIPS weights ({error})", fix=advice) from error

    @torch.no_grad()
    def __call__(self, image: Tensor, reference: Tensor) -> float:
        """Return the symmetric distance between two pictures (H, W, 3) in [0, 1].

        Raises:
            HyrfError: a side of the pictures is too short for the network.
        """
        if min(image.shape[:2]) < self.network.min_size_pixels:
            raise HyrfError(
                f"LPIPS ({self.name}) needs pictures of {self.network.min_size_pixels} pixels a side and these have "
                f"{image.shape[1]} x {image.shape[0]}",
                fix="score without `lpips_weights`",
            )
        pair = torch.stack((image, reference)).permute(0, 3, 1, 2).float().cpu() * 2 - 1
        features = (pair - pair.new_tensor(INPUT_MEANS).view(3, 1, 1)) / pair.new_tensor(INPUT_STDS).view(3, 1, 1)
        distance = 0.0
        for stage, weights in enumerate(self._channel_weights):
            features = self._stage(features, stage)
            length = torch.linalg.vector_norm(features, dim=1, keepdim=True)
            first, second = features / (length + NORM_EPSILON)
            distance += float(F.conv2d(((first - second) ** 2)[None], weights).mean())
        return distance

    def _stage(self, features: Tensor, stage: int) -> Tensor:
        network = self.network
        if stage in network.pooled_stages:
            features = F.max_pool2d(features, network.pool, 2)
        for layer in network.stages[stage]:
            weight, bias = self._convolutions[layer]
            padding = network.paddings.get(layer, weight.shape[-1] // 2)
            features = F.conv2d(features, weight, bias, stride=network.strides.get(layer, 1), padding=padding).relu()
        return features


def _take_weight(state: dict[str, Tensor], key: str, dimensions: int) -> Tensor:
    value = state.get(key)
    if not isinstance(value, Tensor) or value.dim() != dimensions:
        raise ValueError(f"'{key}' is missing or is not a weight")
    return value.float()
