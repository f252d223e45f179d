"""Plan the compression: which Gaussians are kept, their order, importance classes and position lattice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from hyrfpack.compress.rate_distortion import LAMBDA_PER_DISTORTION
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE
from hyrfpack.format.compact.plan import Layer, Plan, build_step_groups
from hyrfpack.format.sections import COLORS, DECODER_SECTIONS, TABLE_SECTIONS
from hyrfpack.model import HybridModel
from hyrfpack.parallel.pool import map_row_blocks, parallel_map, run_jobs
from hyrfpack.quant.morton import MAX_BITS_PER_AXIS
from hyrfpack.quant.points import LatticePoints, sort_points

IMPORTANCE_CLASS_COUNT = 6
# Each class spans this much log2 of sensitivity; much narrower or wider classes give larger files.
CLASS_WIDTH_LOG2 = 3.0
# This many classes are for Gaussians that are more important than the mean.
CLASSES_ABOVE_MEAN = 2
# Pruning a Gaussian is assumed to save this many bits. This is low, because pruned Gaussians take few bits.
PRUNED_GAUSSIAN_BITS = 16
# A layer has at least MIN_LAYER_GAUSSIANS and this share of all Gaussians; smaller layers cost over 1 %.
MIN_LAYER_GAUSSIANS = 5000
MIN_LAYER_SHARE = 1 / 8


def make_plan(model: HybridModel, sensitivity: Sensitivity, distortion: float, prune: bool = True) -> Plan:
    """Plan what is stored, and how finely, so that compression adds about `distortion` to the pictures' error.

    Args:
        model: the model to compress.
        sensitivity: sensitivities of the model.
        distortion: mean squared error of colours in [0, 1]; 1e-5 is 50 dB between pictures before and after.
        prune: leave out Gaussians whose removal saves more rate than it costs in distortion.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    per_number = distortion_per_number(model, distortion)
    kept = indices_to_keep(sensitivity, per_number, prune)
    kept_sensitivity = sensitivity.subset(kept)
    cube, classes = _cube_coords(model), importance_classes(kept_sensitivity)
    bits = position_bits(kept_sensitivity.positions, classes, per_number)

    def sort_members(kinds: list[int]) -> tuple[Layer, np.ndarray]:
        members = np.flatnonzero(np.isin(classes, kinds))
        layer, index = _sort_layer(cube[kept[members]], classes[members], bits)
        return layer, members[index]

    kinds_by_layer = _group_classes_into_layers(np.bincount(classes, minlength=IMPORTANCE_CLASS_COUNT))
    layers, order = zip(*parallel_map(sort_members, kinds_by_layer), strict=True)
    kept = kept[np.concatenate(order)]
    jobs: dict[str, Callable[[], Any]] = {COLORS: lambda: color_basis(to_arrays(model)[COLORS][kept])}
    for group in (*TABLE_SECTIONS, *DECODER_SECTIONS):
        jobs[group] = partial(build_step_groups, group, model.config, layers[0].points)
    groups = run_jobs(jobs)
    basis = groups.pop(COLORS)
    return Plan(kept, layers, basis, groups, per_number, len(model))


def distortion_per_number(model: HybridModel, distortion: float) -> float:
    """Return D, the mean squared error of pictures that each number of a model may add.

    The residuals of imported Gaussians are not counted, so their errors add to the distortion. Imports choose the
    distortion by measured errors.
    """
    return distortion / sum(parameter.numel() for parameter in model.parameters())


def indices_to_keep(sensitivity: Sensitivity, per_number: float, prune: bool = True) -> np.ndarray:
    """Return the ascending indices (n,) of the Gaussians whose removal would cost more distortion than rate.

    The most important Gaussian is always kept.

    Args:
        sensitivity: sensitivities of all N Gaussians.
        per_number: D, the error that each number may add, see `distortion_per_number`.
        prune: if False, all Gaussians are kept.
    """
    removals = sensitivity.removals
    if not prune:
        return np.arange(len(removals))
    least = min(LAMBDA_PER_DISTORTION * per_number * PRUNED_GAUSSIAN_BITS, removals.max(initial=0.0))
    return np.flatnonzero(removals >= least)


def _cube_coords(model: HybridModel) -> np.ndarray:
    """Return the Gaussians' coordinates in the contracted cube, (N, 3) float64."""
    positions = model.gaussians.positions.detach()
    coords = map_row_blocks(lambda rows: model.cube_coords(positions[rows].double()), len(positions), positions.device)
    return coords.cpu().numpy()


def replan_moved(plan: Plan, model: HybridModel) -> tuple[Plan, HybridModel]:
    """Update a plan to the new positions of its Gaussians; return it and the model, reordered and on the lattice.

    Each Gaussian stays in its layer and class. Lattice points, the order, and the set of hash table rows that are read
    are computed again.

    Args:
        plan: the plan before the Gaussians moved.
        model: the stored part of a model, in the order of `plan` (made by `plan.apply`), after its Gaussians moved.
    """
    cube = _cube_coords(model)
    stops = np.cumsum([len(layer.points.classes) for layer in plan.layers])

    def sort_again(number: int) -> tuple[Layer, np.ndarray]:
        points = plan.layers[number].points
        members = np.arange(stops[number] - len(points.classes), stops[number])
        layer, index = _sort_layer(cube[members], points.classes, points.bits)
        return layer, members[index]

    layers, order = zip(*parallel_map(sort_again, range(len(plan.layers))), strict=True)
    places = np.concatenate(order)
    groups = {group: build_step_groups(group, model.config, layers[0].points) for group in plan.groups}
    moved = replace(plan, kept=places, layers=layers, groups=groups)
    return replace(moved, kept=plan.kept[places]), moved.apply(model)


def _sort_layer(cube: np.ndarray, classes: np.ndarray, bits: np.ndarray) -> tuple[Layer, np.ndarray]:
    """Sort points (n, 3) of the cube as a layer; return it and the index of the point at each place of the layer."""
    while True:
        order, points, base_bits = sort_points(snap_to_lattice(cube, classes, bits))
        # Classes coarser than the base are refined to it, so their points are assigned to cells again.
        if (points.bits == bits).all():
            return Layer(points, base_bits), order
        bits = points.bits


def snap_to_lattice(cube: np.ndarray, classes: np.ndarray, bits: np.ndarray) -> LatticePoints:
    """Return the lattice points of the cells that contain the points (n, 3) of the cube."""
    side = (1 << bits)[classes][:, None]
    return LatticePoints(np.clip(np.floor(cube * side), 0, side - 1).astype(np.int64), classes, bits)


def _group_classes_into_layers(members: np.ndarray) -> list[list[int]]:
    """Group consecutive classes into layers that are large enough, given the number of Gaussians in each class."""
    least = max(MIN_LAYER_GAUSSIANS, MIN_LAYER_SHARE * members.sum())
    layers: list[list[int]] = [[]]
    for kind in range(len(members)):
        if members[layers[-1]].sum() >= least and members[kind:].sum() >= least:
            layers.append([])
        layers[-1].append(kind)
    return layers


def importance_classes(sensitivity: Sensitivity) -> np.ndarray:
    """Return each Gaussian's importance class (N,) uint8, 0 for the most important ones.

    The class follows from the geometric mean of the sensitivities of a Gaussian's 8 numbers, relative to their means.
    """
    logs = np.zeros(len(sensitivity.positions))
    for values, numbers in (
        (sensitivity.positions, 3),
        (sensitivity.colors, 3),
        (sensitivity.scales, 1),
        (sensitivity.opacities, 1),
    ):
        if len(values):
            logs += numbers / 8 * np.log2(np.maximum(values, 1e-300) / max(float(values.mean()), 1e-300))
    return np.clip(np.round(-logs / CLASS_WIDTH_LOG2) + CLASSES_ABOVE_MEAN, 0, IMPORTANCE_CLASS_COUNT - 1).astype(
        np.uint8
    )


def position_bits(sensitivity: np.ndarray, classes: np.ndarray, distortion: float) -> np.ndarray:
    """Return the bits per axis, (classes,) int64, that give each class the lattice step nearest to sqrt(12 D / s)."""
    bits = np.ones(IMPORTANCE_CLASS_COUNT, np.int64)
    for kind in np.unique(classes):
        step = np.sqrt(12 * distortion / max(float(sensitivity[classes == kind].mean()), 1e-300))
        bits[kind] = np.clip(np.round(-np.log2(max(step, 2.0**-MAX_BITS_PER_AXIS))), 1, MAX_BITS_PER_AXIS)
    return bits


def color_basis(colors: np.ndarray) -> np.ndarray:
    """Return the eigenvectors of the covariance of colour logits (N, 3) as columns (3, 3) float32, largest first.

    The channels are uncorrelated in this basis (Karhunen-Loeve transform).
    """
    if len(colors) < 2:
        return np.eye(3, dtype=np.float32)
    clamped = np.clip(colors.T.astype(np.float64), -MAX_ABS_CHANNEL_VALUE / 2, MAX_ABS_CHANNEL_VALUE / 2)
    basis = np.linalg.eigh(np.cov(clamped))[1][:, ::-1]
    return (basis * np.where(basis.sum(axis=0) < 0, -1, 1)).astype(np.float32)
