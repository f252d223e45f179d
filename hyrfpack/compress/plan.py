"""What is stored of a model, and how finely: the decisions that come before any number is quantised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hyrfpack.compress.rate_distortion import ERROR_PER_BIT
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE
from hyrfpack.format.compact.plan import Layer, Plan, build_step_groups
from hyrfpack.format.sections import COLORS, DECODER_SECTIONS, TABLE_SECTIONS
from hyrfpack.model import HybridModel
from hyrfpack.quant.morton import MAX_BITS
from hyrfpack.quant.points import Points, encode_points

CLASSES = 6
CLASS_WIDTH = 3.0  # log2 of sensitivity that a class spans: classes much narrower or wider cost more
ABOVE_MEAN = 2  # classes for what matters more than the mean
BITS_OF_A_GAUSSIAN = 16  # that pruning counts as saved: those it takes are cheap ones
LEAST_OF_LAYER = 5000, 8  # Gaussians of a layer: at least so many, and so much of all; smaller ones cost over 1 %


def make_plan(model: HybridModel, sensitivity: Sensitivity, distortion: float, prune: bool = True) -> Plan:
    """Decide what is stored, and how finely, so that pictures get about `distortion` mean squared error.

    Args:
        distortion: of colours in [0, 1]; 1e-5 is 50 dB between pictures before and after.
        prune: leave out Gaussians that cost more in bytes than they give to pictures.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    each = of_each_number(model, distortion)
    kept = worth_keeping(sensitivity, each, prune)
    of_kept = sensitivity.of(kept)
    cube, classes = _cube(model), importance_classes(of_kept)
    bits = position_bits(of_kept.positions, classes, each)
    layers, order = [], []
    for kinds in _layer_classes(np.bincount(classes, minlength=CLASSES)):
        members = np.flatnonzero(np.isin(classes, kinds))
        layer, index = _layer(cube[kept[members]], classes[members], bits)
        layers.append(layer)
        order.append(members[index])
    kept = kept[np.concatenate(order)]
    basis = color_basis(to_arrays(model)[COLORS][kept])
    groups = {
        group: build_step_groups(group, model.config, layers[0].points)
        for group in (*TABLE_SECTIONS, *DECODER_SECTIONS)
    }
    return Plan(kept, tuple(layers), basis, groups, each)


def of_each_number(model: HybridModel, distortion: float) -> float:
    """What each number of a model may add to the pictures' mean squared error."""
    return distortion / sum(parameter.numel() for parameter in model.parameters())


def worth_keeping(sensitivity: Sensitivity, each: float, prune: bool = True) -> np.ndarray:
    """Indices (n,), ascending, of the Gaussians that give more to pictures than they cost in bytes.

    Args:
        sensitivity: of all Gaussians (N,).
        each: what each number may add, see `of_each_number`.
        prune: without, all are kept.
    """
    removals = sensitivity.removals
    return np.flatnonzero(removals >= ERROR_PER_BIT * each * BITS_OF_A_GAUSSIAN) if prune else np.arange(len(removals))


@torch.no_grad()
def _cube(model: HybridModel) -> np.ndarray:
    """Where Gaussians are in the contracted cube, (N, 3) float64."""
    return model.cube_coords(model.gaussians.positions.double()).cpu().numpy()


def follow(plan: Plan, model: HybridModel) -> tuple[Plan, HybridModel]:
    """The plan of Gaussians that have moved, and they in its order, on the lattice.

    Each stays in its layer and class; places and order are new, and with them which rows of the tables are read.

    Args:
        plan: `plan.apply` made the model, in whose order it is.
        model: the part of a model that is stored, moved.
    """
    cube = _cube(model)
    layers, order, start = [], [], 0
    for points in (layer.points for layer in plan.layers):
        members = np.arange(start, start := start + len(points.classes))
        layer, index = _layer(cube[members], points.classes, points.bits)
        layers.append(layer)
        order.append(members[index])
    places = np.concatenate(order)
    groups = {group: build_step_groups(group, model.config, layers[0].points) for group in plan.groups}
    there = replace(plan, kept=places, layers=tuple(layers), groups=groups)
    return replace(there, kept=plan.kept[places]), there.apply(model)


def _layer(cube: np.ndarray, classes: np.ndarray, bits: np.ndarray) -> tuple[Layer, np.ndarray]:
    """A layer of the points (n, 3) of the cube, and which of them comes at each place."""
    while True:
        data, order, points = encode_points(at_cells(cube, classes, bits))
        # A class coarser than all share was made finer: its points are placed anew, in the middle of their cells.
        if (points.bits == bits).all():
            return Layer(points, data), order
        bits = points.bits


def at_cells(cube: np.ndarray, classes: np.ndarray, bits: np.ndarray) -> Points:
    """The lattice points of the cells that points (n, 3) of the cube are in."""
    side = (1 << bits)[classes][:, None]
    return Points(np.clip(np.floor(cube * side), 0, side - 1).astype(np.int64), classes, bits)


def _layer_classes(members: np.ndarray) -> list[list[int]]:
    """The classes of each layer, from the numbers of their members: in order, and no layer with few Gaussians."""
    fewest, share = LEAST_OF_LAYER
    least = max(fewest, members.sum() / share)
    layers: list[list[int]] = [[]]
    for kind in range(len(members)):
        if members[layers[-1]].sum() >= least and members[kind:].sum() >= least:
            layers.append([])
        layers[-1].append(kind)
    return layers


def importance_classes(sensitivity: Sensitivity) -> np.ndarray:
    """(N,) uint8, 0 for the Gaussians that matter most: by the geometric mean of the sensitivities of all 8 numbers."""
    logs = np.zeros(len(sensitivity.positions))
    for values, numbers in (
        (sensitivity.positions, 3),
        (sensitivity.colors, 3),
        (sensitivity.scales, 1),
        (sensitivity.opacities, 1),
    ):
        if len(values):
            logs += numbers / 8 * np.log2(np.maximum(values, 1e-300) / max(float(values.mean()), 1e-300))
    return np.clip(np.round(-logs / CLASS_WIDTH) + ABOVE_MEAN, 0, CLASSES - 1).astype(np.uint8)


def position_bits(sensitivity: np.ndarray, classes: np.ndarray, distortion: float) -> np.ndarray:
    """(CLASSES,) bits of an axis for each class: the lattice step nearest to sqrt(12 D / s)."""
    bits = np.ones(CLASSES, np.int64)
    for kind in np.unique(classes):
        step = np.sqrt(12 * distortion / max(float(sensitivity[classes == kind].mean()), 1e-300))
        bits[kind] = np.clip(np.round(-np.log2(max(step, 2.0**-MAX_BITS))), 1, MAX_BITS)
    return bits


def color_basis(colors: np.ndarray) -> np.ndarray:
    """The eigenvectors of the covariance of colour logits (N, 3), as columns (3, 3) float32, most varied first.

    In it the channels do not repeat each other (Karhunen-Loeve transform).
    """
    if len(colors) < 2:
        return np.eye(3, dtype=np.float32)
    within = np.clip(colors.T.astype(np.float64), -MAX_ABS_CHANNEL_VALUE / 2, MAX_ABS_CHANNEL_VALUE / 2)
    basis = np.linalg.eigh(np.cov(within))[1][:, ::-1]
    return (basis * np.where(basis.sum(axis=0) < 0, -1, 1)).astype(np.float32)
