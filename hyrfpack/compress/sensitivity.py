"""How much each number of a model matters to pictures, measured on renders."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from hyrfpack.compress.views import views_between
from hyrfpack.format.arrays import GROUPS
from hyrfpack.format.compact import Sensitivity
from hyrfpack.model import HybridModel
from hyrfpack.model.frame import expand
from hyrfpack.render import render
from hyrfpack.scene import Camera, evenly_spaced

DRAWN = 8_000_000  # Gaussians drawn in all views together, about: more views of smaller models
FEWEST, MOST = 8, 192  # views
FIELD_VIEWS = 1 / 6  # share of the views that the fields are measured on; each counts for many Gaussians there
UNSEEN = 1e-3  # share of what a Gaussian would add to pictures if nothing hid it, that it counts at least
DULL = 0.04 / 3  # (d colour / d logit)^2 of a typical colour, over the three channels of a picture
NEAREST = 0.05  # local units
LEAST = 1e-2  # of a decoder's number, against the mean of its decoder


def measure_sensitivity(model: HybridModel, cameras: Sequence[Camera], seed: int = 0) -> Sensitivity:
    """Estimate the mean squared derivatives of pictures by every number of a model.

    With v a picture of random signs, the derivative of (picture . v) by a number x is a sum of random signs times the
    pixels' derivatives by x; its square is on average the sum of their squares (Hutchinson 1990). One such v a view,
    half of the views at cameras and half between them.

    A Gaussian that few views show may still be seen in others: it counts at least a share of what it would if nothing
    stood before it.

    Args:
        cameras: where pictures will be looked at from, about; world units.
        seed: of the signs and of the views between cameras.

    Raises:
        HyrfError: a number of the model is NaN or infinite.
    """
    count = int(np.clip(DRAWN // max(len(model), 1), FEWEST, MOST)) // 2
    near = evenly_spaced(cameras, count)
    views = [view for pair in zip(near, views_between(near, seed), strict=True) for view in pair]
    every = max(1, round(1 / FIELD_VIEWS))
    generator = torch.Generator().manual_seed(seed)
    squares = {name: torch.zeros_like(parameter) for name, parameter in model.named_parameters()}
    stretch = _stretch(model)
    pixels, field_pixels = 0, 0
    for number, camera in enumerate(views):
        # Pairs alternate, so a field's views fall on cameras and between them.
        with_fields = number % (2 * every) < 2
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(with_fields or name.startswith("gaussians"))
            parameter.grad = None
        rgb = render(model, camera).rgb
        signs = torch.randint(0, 2, rgb.shape, generator=generator).to(rgb) * 2 - 1
        if rgb.requires_grad:
            (rgb * signs).sum().backward()
        pixels += rgb.numel()
        field_pixels += rgb.numel() * with_fields
        for name, parameter in model.named_parameters():
            gradient = parameter.grad
            if gradient is None:
                continue
            if name == "gaussians.positions":
                gradient = (stretch * gradient[:, :, None]).sum(1)
            squares[name] += gradient.square()
            parameter.grad = None
    for parameter in model.parameters():
        parameter.requires_grad_(True)
    return _gathered(model, squares, pixels, field_pixels, near)


def _gathered(
    model: HybridModel, squares: dict[str, torch.Tensor], pixels: int, field_pixels: int, cameras: Sequence[Camera]
) -> Sensitivity:
    def of(name: str) -> np.ndarray:
        return squares[name].double().mean(dim=1).cpu().numpy() / pixels

    explicit = {
        name: of(f"gaussians.{name}") for name in ("positions", "color_logits", "scale_logits", "opacity_logits")
    }
    least = UNSEEN * _unhidden(model, cameras)
    colors = explicit["color_logits"]
    seen = colors > 1e-2 * colors.mean() if len(colors) else np.zeros(0, bool)
    for name, values in explicit.items():
        ratio = np.exp(np.median(np.log(np.maximum(values[seen], 1e-30) / colors[seen]))) if seen.any() else 1.0
        explicit[name] = np.maximum(np.maximum(values, ratio * least), 1e-30)
    fields = {
        group: np.concatenate([squares[name].double().cpu().numpy().ravel() for name in GROUPS[group]]) / field_pixels
        for group in ("GTAB", "GMLP", "RTAB", "RMLP")
    }
    decoders = {group: fields[group] for group in ("GMLP", "RMLP")}
    return Sensitivity(
        *explicit.values(),
        # Both numbers of a row are read together.
        tables={group: fields[group].reshape(-1, 2).mean(axis=1).repeat(2) for group in ("GTAB", "RTAB")},
        decoders={group: np.maximum(values, LEAST * values.mean()) for group, values in decoders.items()},
    )


def _stretch(model: HybridModel) -> torch.Tensor:
    """(N, 3, 3): d local position / d cube coordinate, rows local axes, columns cube axes."""
    cube = model.cube_coords(model.gaussians.positions.detach().double()).requires_grad_()
    local = expand(cube) * cube.new_tensor(model.config.frame.half_extent)
    rows = [torch.autograd.grad(local[:, axis].sum(), cube, retain_graph=True)[0] for axis in range(3)]
    return torch.stack(rows, dim=1).float()


@torch.no_grad()
def _unhidden(model: HybridModel, cameras: Sequence[Camera]) -> np.ndarray:
    """(N,) what a colour logit would do to pictures if its Gaussian were in view of every camera and nothing before it.

    Each pixel under a Gaussian of opacity o and standard deviations a, b (the larger two) adds at most (o dc/dlogit)^2,
    and there are pi f^2 a b / z^2 of them.
    """
    geometry = model.decode_geometry()
    sides = geometry.scales.double().sort(dim=1).values
    energy = torch.pi * sides[:, 1] * sides[:, 2] * geometry.opacities.double() ** 2
    total = torch.zeros_like(energy)
    frame = model.config.frame
    positions = model.gaussians.positions.double()
    for camera in cameras:
        place = torch.as_tensor((camera.position - np.array(frame.center)) / frame.scale).to(positions)
        distance = torch.linalg.vector_norm(positions - place, dim=1).clamp_min(NEAREST)
        share = energy * (camera.fx * camera.fy / (camera.width * camera.height)) / distance**2
        total += share.clamp_max(1)
    return (total * (DULL / max(len(cameras), 1))).cpu().numpy()
