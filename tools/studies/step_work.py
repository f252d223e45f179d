"""Count the least work of each operation of a training step on the CPU: bytes moved through memory, and arithmetic.

The counts are those of tools/gpu/roofline.py, by its rules, where the CPU computes the same. They differ here:

- Sorting: 11 bits of a key per pass, instead of 8. Pairs are not sorted but counted by tile and written in place.
- Blending: a pair is evaluated in the pixel rows of its tile that it touches, not in all 256 pixels, and exp is a
  polynomial of 10 operations and 3 squarings instead of one operation of a special unit.
- Gradients: a pair's sums go through memory, because the projection's backward pass adds them up. Gaussians that are
  not drawn have no gradient, so the decoders' backward passes are counted for drawn ones alone.
- The loss computes its gradient in the forward pass; its backward pass only scales that.
"""

from __future__ import annotations

from dataclasses import dataclass

from hyrfpack.model import HybridModel
from hyrfpack.model.field import Field
from hyrfpack.ops.shade import DIRECTION_FEATURES
from tools.gpu.roofline import (
    Work,
    count_adam,
    count_blend,
    count_hash_encode,
    count_hash_encode_backward,
    count_mlp,
    count_mlp_backward,
    count_photometric_loss,
    count_project,
    count_project_backward,
)

SORT_PASSES = 3  # A pass sorts by 11 bits of the 32-bit key.
EVALUATION_OPERATIONS = 23  # offset along both axes 6, exponent 3, exp 13, opacity 1
BLENDED_OPERATIONS = 10
BLENDED_BACKWARD_OPERATIONS = 40
EXPLICIT_NUMBERS = 8  # of a Gaussian: position 3, colour 3, scale 1, opacity 1
GEOMETRY_OUTPUTS, COLORS = 8, 3


@dataclass(frozen=True)
class FieldSizes:
    """Sizes of a field.

    Attributes:
        widths: widths of the decoder's inputs, hidden layers and outputs.
        levels, rows: levels and rows of the hash grid.
    """

    widths: tuple[int, ...]
    levels: int
    rows: int


@dataclass(frozen=True)
class ModelSizes:
    """Sizes of a model that are the same in all steps.

    Attributes:
        gaussians: number of Gaussians.
        parameters: number of trained parameters.
        geometry, radiance: sizes of the fields.
        directions: features of an encoded direction.
        background: whether there is a background sphere.
    """

    gaussians: int
    parameters: int
    geometry: FieldSizes
    radiance: FieldSizes
    directions: int
    background: bool


@dataclass(frozen=True)
class ViewSizes:
    """Sizes of one step, which depend on the view.

    Attributes:
        pixels: pixels of the photo.
        photo_bytes: bytes per pixel of the decoded photo, 3 or 4.
        in_view: Gaussians that are decoded and projected.
        drawn: Gaussians that touch the picture.
        pairs: tile-Gaussian pairs.
        reached: pairs that are blended before all pixels of their tile are finished.
        evaluations: pixels at which reached pairs are evaluated, summed over pairs.
        blended: mean number of Gaussians that contribute to a pixel.
        nodes, needed: nodes of the background's grid, and those that are evaluated.
    """

    pixels: int
    photo_bytes: int
    in_view: int
    drawn: int
    pairs: int
    reached: int
    evaluations: int
    blended: float
    nodes: int
    needed: int


def measure_model_sizes(model: HybridModel) -> ModelSizes:
    """Return the sizes of a model."""
    return ModelSizes(
        gaussians=len(model),
        parameters=sum(parameter.numel() for parameter in model.parameters()),
        geometry=_field_sizes(model.geometry),
        radiance=_field_sizes(model.radiance),
        directions=DIRECTION_FEATURES[model.config.direction_encoding],
        background=model.config.background,
    )


def _field_sizes(field: Field) -> FieldSizes:
    widths = (field.weights[0].shape[1], *(weight.shape[0] for weight in field.weights))
    return FieldSizes(widths, field.grid.config.levels, field.grid.config.rows)


def count_step(model: ModelSizes, view: ViewSizes) -> dict[str, Work]:
    """Count the least work of each operation of one step, by its row in the table of step_profile.py."""
    return {
        "data": Work((view.photo_bytes + 12) * view.pixels, 3 * view.pixels),
        "cull": count_cull(model.gaussians, view.in_view),
        **_count_decode(model, view),
        "project": count_project(view.in_view),
        "sort": count_sort(view.in_view, view.drawn),
        "bin": count_bin(view.drawn, view.pairs),
        "blend": count_cpu_blend(view),
        **(_count_background(model, view) if model.background else {}),
        **count_composite(view, model.background),
        "loss": count_photometric_loss(view.pixels) + count_mean_square(view.pixels),
        "loss backward": Work(24 * view.pixels, 3 * view.pixels),
        "blend backward": count_cpu_blend_backward(view),
        "project backward": count_cpu_project_backward(view),
        "density observation": count_observation(model.gaussians, view.in_view),
        "Adam": count_adam(model.parameters),
    }


def count_cull(gaussians: int, in_view: int) -> Work:
    """Count the work of culling: it reads positions and writes 8-byte indices of those in view.

    The operations are 18 to the camera, 2 products, 4 limits with 4 comparisons, depth 1, finite 3.
    """
    return Work(12 * gaussians + 8 * in_view, 32 * gaussians)


def count_sort(in_view: int, drawn: int) -> Work:
    """Count the work of sorting by depth: it reads all keys; a pass reads and writes key and index of drawn Gaussians.

    The arithmetic is one digit and one counter per item, twice in each pass.
    """
    return Work(4 * in_view + SORT_PASSES * 16 * drawn, SORT_PASSES * 4 * drawn)


def count_bin(drawn: int, pairs: int) -> Work:
    """Count the work of binning: it reads index and 7 numbers per Gaussian and writes 8 bytes per pair.

    Tile and rows of a pair (5 bytes) are written and read between counting and writing. The arithmetic is 20 operations
    per Gaussian and 10 per pair.
    """
    return Work(32 * drawn + (8 + 10) * pairs, 20 * drawn + 10 * pairs)


def count_cpu_blend(view: ViewSizes) -> Work:
    """Count the work of blending; the bytes are those of `count_blend`."""
    bytes_moved = count_blend(view.reached, view.pixels, 1, 0).bytes
    blended = view.blended * view.pixels
    return Work(bytes_moved, EVALUATION_OPERATIONS * view.evaluations + BLENDED_OPERATIONS * blended)


def count_cpu_blend_backward(view: ViewSizes) -> Work:
    """Count the work of blending's backward pass.

    It reads the reached pairs again (40 bytes), and rgb, T and the gradients of both (32 bytes per pixel). It writes 11
    sums of each pair (44 bytes), reached or not.
    """
    blended = view.blended * view.pixels
    flops = EVALUATION_OPERATIONS * view.evaluations + BLENDED_BACKWARD_OPERATIONS * blended
    return Work(40 * view.reached + 44 * view.pairs + 32 * view.pixels, flops)


def count_cpu_project_backward(view: ViewSizes) -> Work:
    """Count the work of the projection's backward pass.

    It reads 11 sums of each pair and 11 numbers of each drawn Gaussian, and writes 14 gradients and 2 sums of absolute
    gradients of each Gaussian in view.
    """
    bytes_moved = 44 * view.pairs + 44 * view.drawn + 64 * view.in_view
    return Work(bytes_moved, count_project_backward(view.drawn).flops + 11 * view.pairs)


def count_composite(view: ViewSizes, background: bool) -> dict[str, Work]:
    """Count the work of compositing over the background's grid, or over one colour, and of its backward pass.

    It reads rgb, T and the grid and writes the picture. The operations of a channel are 3 interpolations of 3 and a
    multiply-add. The backward pass reads the gradient, T and the grid and writes the gradients of both. One colour
    needs no grid and no interpolation.
    """
    grid, interpolation = (12 * view.nodes, 9) if background else (0, 0)
    forward = Work(28 * view.pixels + grid, 3 * (interpolation + 2) * view.pixels)
    # A channel takes the interpolation and a multiply-add for T, and one factor and 4 shares of nodes for the grid.
    backward = Work(20 * view.pixels + 2 * grid, 3 * (interpolation + 2 + (9 if background else 0)) * view.pixels)
    return {"composite": forward, "composite backward": backward}


def count_mean_square(pixels: int) -> Work:
    """Count the work of the mean squared error: it reads two pictures; 3 operations for each number."""
    return Work(24 * pixels, 9 * pixels)


def count_observation(gaussians: int, in_view: int) -> Work:
    """Count the work of density control's observation of a step.

    It reads 2 absolute gradients, an index and a flag of each Gaussian in view and updates 2 sums, and it adds the
    square of each opacity's gradient to a third.
    """
    return Work((8 + 8 + 1 + 16) * in_view + 12 * gaussians, 6 * in_view + 2 * gaussians)


def _count_decode(model: ModelSizes, view: ViewSizes) -> dict[str, Work]:
    """Count the work of decoding the Gaussians in view, and of the backward pass for drawn ones.

    The rest of the forward pass gathers explicit numbers, and computes coordinates in the cube (20 operations),
    directions (10 and one for each feature), and 10 operations for each output. The rest of the backward pass writes
    the gradients of all explicit numbers, zeros included.
    """
    seen, drawn, geometry, radiance = view.in_view, view.drawn, model.geometry, model.radiance
    outputs = GEOMETRY_OUTPUTS + COLORS
    # Bytes of a Gaussian: index; explicit numbers in and out; coordinates, directions; outputs in and out.
    rest_bytes = 8 + 4 * (2 * EXPLICIT_NUMBERS + 3 + model.directions + 2 * outputs)
    return {
        "decode: hash encoding": count_hash_encode(seen, geometry.levels, geometry.rows)
        + count_hash_encode(seen, radiance.levels, radiance.rows),
        "decode: MLP": count_mlp(seen, geometry.widths, False) + count_mlp(seen, radiance.widths, False),
        "decode: rest": Work(rest_bytes * seen, (20 + 10 + model.directions + 10 * outputs) * seen),
        "decode backward: MLP": count_mlp_backward(drawn, geometry.widths, False)
        + count_mlp_backward(drawn, radiance.widths, False),
        "decode backward: hash encoding": count_hash_encode_backward(drawn, geometry.levels, geometry.rows)
        + count_hash_encode_backward(drawn, radiance.levels, radiance.rows),
        "decode backward: rest": Work(
            (8 + 4 * 3 * outputs) * drawn + 4 * EXPLICIT_NUMBERS * model.gaussians, 5 * outputs * drawn
        ),
    }


def _count_background(model: ModelSizes, view: ViewSizes) -> dict[str, Work]:
    """Count the work of the background's grid.

    The rest of the forward pass reads T of each pixel, writes 3 colours of each node, and at needed nodes coordinates
    and encoded directions; 130 operations as in `count_background`. The rest of the backward pass gathers the gradients
    at needed nodes and differentiates the sigmoid.
    """
    needed, field = view.needed, model.radiance
    rest_bytes = 4 * view.pixels + 12 * view.nodes + (4 * (3 + model.directions) + 4 * COLORS) * needed
    return {
        "background: hash encoding": count_hash_encode(needed, field.levels, field.rows),
        "background: MLP": count_mlp(needed, field.widths, False),
        "background: rest": Work(rest_bytes, 130 * needed),
        "background backward: MLP": count_mlp_backward(needed, field.widths, False),
        "background backward: hash encoding": count_hash_encode_backward(needed, field.levels, field.rows),
        "background backward: rest": Work((8 + 4 * 3 * COLORS) * needed, 3 * COLORS * needed),
    }
