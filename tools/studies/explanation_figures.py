"""Draw the figures of docs/explanation/how-it-works.md from one trained model.

    python -m hyrfpack demo -o demo
    python -m tools.studies.explanation_figures demo/run -o docs/images

It writes `how-method.png` (one view with the parts of the model added one after another), `how-file.png` (the bytes of
the model's file) and `how-codec.png` (sensitivities, steps and symbols of profile `compact`). All numbers and pictures
in them are those of the model.
"""

from __future__ import annotations

import argparse
import io
import struct
import tempfile
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

import hyrfpack
from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.capture import Capture
from hyrfpack.compress import CompressionReport
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.quantize import quantize
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.evaluate.figures import make_blank_figure
from hyrfpack.format.codec import PROFILES
from hyrfpack.format.compact.groups import encode_groups
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.format.container import Container
from hyrfpack.format.info import section_sizes
from hyrfpack.format.sections import (
    COLORS,
    DECODER_SECTIONS,
    GEOMETRY_DECODER,
    GEOMETRY_TABLE,
    METADATA,
    OPACITIES,
    POSITIONS,
    RADIANCE_DECODER,
    RADIANCE_TABLE,
    SCALES,
    SECTION_CONTENTS,
    TABLE_SECTIONS,
    group_and_layer,
)
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import logit
from hyrfpack.quant.steps import ALL_ZERO_CODE, FIXED_POINT_ONE, decode_step
from hyrfpack.scene import Camera
from tools.command import run_command

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIGURE_WIDTH_INCHES = 8.0
TEXT_COLOR = "#202124"
LINE_COLOR = "#5f6368"
STORED_COLOR = "#d2e3fc"
FIELD_COLOR = "#ceead6"
RESULT_COLOR = "#fef0c7"
DOT_SCALE_LOCAL = 0.004  # standard deviation of the dots that show the Gaussians' centres
CONTAINER_GROUP = "container"
SECTION_COLORS = {
    CONTAINER_GROUP: "#3c4043",
    METADATA: "#9aa0a6",
    GEOMETRY_DECODER: "#7b61c9",
    RADIANCE_DECODER: "#b39ddb",
    POSITIONS: "#1a73e8",
    COLORS: "#e8710a",
    SCALES: "#12a4af",
    OPACITIES: "#f4b400",
    GEOMETRY_TABLE: "#188038",
    RADIANCE_TABLE: "#81c995",
}
SECTION_LABEL_WIDTH_PERCENT = 4.6  # the axes are 100 units wide
MAX_UNREAD_SENSITIVITY = 1e-29  # no view reads numbers of this sensitivity or less
MAX_DRAWN_SYMBOL = 6  # symbols of larger magnitude are counted with this one


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a training run, or its model.hyrf")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the figures")
    parser.add_argument("--camera", type=int, default=0, help="number of the training camera to render from (0)")
    parser.add_argument("--size", type=int, default=300, help="longer side of the renders in pixels (300)")
    args = parser.parse_args()
    for path in draw_figures(args.run, args.output, camera=args.camera, size=args.size):
        print(f"{path}: {path.stat().st_size:,} bytes")


def draw_figures(run: Path, folder: Path, *, camera: int = 0, size: int = 300) -> list[Path]:
    """Draw the three figures of a trained model into `folder` and return their paths.

    Args:
        run: folder of a training run, or its file of profile raw.
        folder: folder of the figures.
        camera: number of the training camera that the method's figure is rendered from.
        size: longer side of the renders in pixels.
    """
    model = hyrfpack.load_model(run)
    cameras = Capture(hyrfpack.describe_file(run)).cameras
    with tempfile.TemporaryDirectory() as scratch:
        files = {profile: Path(scratch) / f"{profile}.hyrf" for profile in PROFILES}
        reports = {
            profile: hyrfpack.compress_model(run, path, hyrfpack.CompressConfig(profile=profile))
            for profile, path in files.items()
        }
        return [
            draw_method(model, resized(cameras[camera % len(cameras)], size), folder / "how-method.png"),
            draw_file(files, folder / "how-file.png"),
            draw_codec(model, reports["compact"], files["compact"], folder / "how-codec.png"),
        ]


# --- The method ------------------------------------------------------------------------------------------------------


def resized(camera: Camera, size: int) -> Camera:
    """Return a camera whose picture has a longer side of `size` pixels."""
    factor = size / max(camera.width, camera.height)
    width, height = (max(1, round(factor * side)) for side in (camera.width, camera.height))
    fx, fy, cx, cy = (factor * value for value in camera.intrinsics)
    return Camera(width, height, fx, fy, cx, cy, camera.camera_from_world)


@torch.no_grad()
def silence_fields(model: HybridModel, *names: str) -> HybridModel:
    """Return a copy of a model in which the named fields ("geometry", "radiance") predict 0 everywhere."""
    copy = deepcopy(model)
    for name in names:
        field = getattr(copy, name)
        field.weights[-1].zero_()
        field.biases[-1].zero_()
    return copy


@torch.no_grad()
def show_as_dots(model: HybridModel) -> HybridModel:
    """Return a copy of a model whose Gaussians are small opaque dots in their stored colours."""
    copy = silence_fields(model, "geometry", "radiance")
    copy.config = replace(copy.config, scale_grows=False)
    copy.gaussians.scale_logits.fill_(float(logit(torch.tensor(DOT_SCALE_LOCAL))))
    copy.gaussians.opacity_logits.fill_(4.0)
    return copy


def render_stages(model: HybridModel, camera: Camera) -> list[tuple[str, np.ndarray]]:
    """Render one view with the parts of the model added one after another; return captions and pictures."""
    stages = [
        ("stored positions\nand colours", show_as_dots(model), False),
        ("+ stored scales\nand opacities", silence_fields(model, "geometry", "radiance"), False),
        ("+ geometry field", silence_fields(model, "radiance"), False),
        ("+ radiance field", model, False),
        ("+ background sphere", model, True),
    ]
    return [
        (caption, hyrfpack.render_view(stage, camera, background=background).rgb.detach().clamp(0, 1).numpy())
        for caption, stage, background in stages
    ]


def draw_method(model: HybridModel, camera: Camera, path: Path) -> Path:
    """Draw how a Gaussian's properties are computed, and one view with the parts of the model added one by one."""
    figure = make_blank_figure(FIGURE_WIDTH_INCHES, 5.1, layout=None)
    axes = figure.add_axes((0.005, 0.43, 0.99, 0.565))
    axes.set(xlim=(-0.5, 100.5), ylim=(0, 36))
    axes.axis("off")
    box(axes, (0, 2, 19, 32), STORED_COLOR, "stored numbers", "", top=True)
    stored_lines = {25: "position  p (3)", 11.5: "opacity  $a_e$", 8: "scale  $s_e$", 4.5: "colour  $c_e$ (3)"}
    write_lines(axes, 1.5, stored_lines, fontsize=9)
    box(axes, (26, 21, 12, 8), FIELD_COLOR, "contraction", "c(p / h)")
    arrow(axes, (19, 25), (26, 25))
    for bottom, name, outputs in (
        (25, "geometry", "$a_n$,  $s_n$ (3),\n$r_n$ (4)"),
        (14, "radiance", "$c_n$ (3)"),
    ):
        middle = bottom + 4
        box(axes, (42, bottom, 12, 8), FIELD_COLOR, name, "hash grid")
        box(axes, (57, bottom, 10, 8), FIELD_COLOR, "decoder", "MLP")
        arrow(axes, (38, 25), (42, middle))
        arrow(axes, (54, middle), (57, middle))
        arrow(axes, (67, middle), (79, middle))
        axes.text(72.6, middle + 0.8, outputs, fontsize=8.5, color=TEXT_COLOR, ha="center", va="bottom")
    axes.text(62, 9.3, "direction  d", fontsize=9, color=TEXT_COLOR, ha="center", va="center")
    arrow(axes, (62, 10.8), (62, 14))
    arrow(axes, (19, 5), (79, 5))
    axes.text(41, 5.8, "added to what the fields predict", fontsize=9, color=TEXT_COLOR, ha="center", va="bottom")
    box(axes, (79, 2, 21, 32), RESULT_COLOR, "drawn Gaussian", "", top=True)
    drawn_lines = {
        25: "opacity  $\\sigma(a_n + a_e)$",
        19.5: "scales  $S\\,\\sigma(s_n + s_e)$",
        14: "rotation  $r_n + (1,0,0,0)$",
        8.5: "colour  $\\sigma(c_n + c_e)$",
    }
    write_lines(axes, 80.3, drawn_lines, fontsize=8.5)
    figure.text(
        0.01,
        0.39,
        "One view, with one part of the model added at a time",
        fontsize=9.5,
        weight="bold",
        color=TEXT_COLOR,
    )
    stages = render_stages(model, camera)
    width = 0.98 / len(stages)
    for number, (caption, picture) in enumerate(stages):
        left = 0.01 + number * width
        panel = figure.add_axes((left + 0.003, 0.005, width - 0.006, 0.3))
        panel.imshow(picture, interpolation="lanczos")
        panel.axis("off")
        panel.set_anchor("N")
        figure.text(left + width / 2, 0.345, caption, fontsize=8.5, color=TEXT_COLOR, ha="center", va="center")
    return save_png(figure, path)


def box(
    axes: Axes, rectangle: tuple[float, float, float, float], color: str, title: str, text: str, *, top: bool = False
) -> None:
    """Draw a rounded box (left, bottom, width, height) with a title and a line of text, centred or at its top."""
    from matplotlib.patches import FancyBboxPatch

    left, bottom, width, height = rectangle
    axes.add_patch(
        FancyBboxPatch(
            (left, bottom),
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.8",
            facecolor=color,
            edgecolor=LINE_COLOR,
        )
    )
    middle = bottom + (height - 3 if top else height / 2)
    offset = 1.6 if text else 0
    axes.text(
        left + width / 2, middle + offset, title, fontsize=9, color=TEXT_COLOR, ha="center", va="center", weight="bold"
    )
    axes.text(left + width / 2, middle - offset, text, fontsize=9, color=TEXT_COLOR, ha="center", va="center")


def write_lines(axes: Axes, left: float, text_by_height: dict[float, str], fontsize: float) -> None:
    """Write left-aligned lines, each centred at its height."""
    for height, text in text_by_height.items():
        axes.text(left, height, text, fontsize=fontsize, color=TEXT_COLOR, va="center")


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw an arrow between two points of the axes."""
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": LINE_COLOR, "linewidth": 1.2})


# --- The file --------------------------------------------------------------------------------------------------------


def draw_file(files: dict[str, Path], path: Path) -> Path:
    """Draw the header, an entry of the table of contents, and the sections of the three profiles by their bytes."""
    figure = make_blank_figure(FIGURE_WIDTH_INCHES, 5.0, layout=None)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set(xlim=(0, 100), ylim=(0, 64))
    axes.axis("off")
    data = files["compact"].read_bytes()
    axes.text(0, 62.5, "Header: 48 bytes", fontsize=9.5, weight="bold", color=TEXT_COLOR, va="center")
    draw_fields(axes, 53, read_header_fields(data))
    axes.text(
        0, 49.5, "Table of contents: 40 bytes for each section, here POSI", fontsize=9.5, weight="bold", va="center"
    )
    draw_fields(axes, 40, read_entry_fields(data, POSITIONS))

    sections = {profile: read_sizes(file) for profile, file in files.items()}
    axes.text(0, 35.8, "Sections of a file of profile compact", fontsize=9.5, weight="bold", va="center")
    draw_bar(axes, 22.5, 5, sections["compact"], 100, labels=True)
    longest = sum(sections["raw"].values())
    axes.text(0, 14.2, "The same model in each profile", fontsize=9.5, weight="bold", va="center")
    for row, (profile, parts) in enumerate(sections.items()):
        bottom, length = 9 - 4 * row, sum(parts.values())
        axes.text(0, bottom + 1.5, profile, fontsize=9, color=TEXT_COLOR, va="center")
        end = draw_bar(axes, bottom, 3, parts, 74 * length / longest, left=9)
        axes.text(end + 1, bottom + 1.5, f"{length:,} bytes", fontsize=9, color=TEXT_COLOR, va="center")
    return save_png(figure, path)


def read_header_fields(data: bytes) -> list[tuple[int, str, str]]:
    """Return the fields of a file's header: bytes, name and value."""
    _, major, minor, flags, length, start, toc_length, count, toc_sum = struct.unpack_from("<8sHHIQQIII", data)
    (header_sum,) = struct.unpack_from("<I", data, 44)
    return [
        (8, "magic", "89 H Y R F ..."),
        (4, "version", f"{major}.{minor}"),
        (4, "flags", f"{flags}"),
        (8, "file length", f"{length:,}"),
        (8, "contents at", f"{start}"),
        (4, "bytes", f"{toc_length}"),
        (4, "sections", f"{count}"),
        (4, "CRC-32", f"{toc_sum:08x}"),
        (4, "CRC-32", f"{header_sum:08x}"),
    ]


def read_entry_fields(data: bytes, tag: str) -> list[tuple[int, str, str]]:
    """Return the fields of a section's entry in the table of contents: bytes, name and value."""
    (count,) = struct.unpack_from("<I", data, 36)
    for number in range(count):
        name, codec, flags, offset, stored, raw, checksum, reserved = struct.unpack_from(
            "<4sHHQQQII", data, 48 + 40 * number
        )
        if name == tag.encode():
            return [
                (4, "type", tag),
                (2, "codec", f"{codec}"),
                (2, "flags", f"{flags}"),
                (8, "offset", f"{offset:,}"),
                (8, "stored length", f"{stored:,}"),
                (8, "decoded length", f"{raw:,}"),
                (4, "CRC-32", f"{checksum:08x}"),
                (4, "reserved", f"{reserved}"),
            ]
    raise ValueError(f"the file has no section {tag}")


def draw_fields(axes: Axes, bottom: float, fields: Sequence[tuple[int, str, str]]) -> None:
    """Draw fields as boxes whose width is their number of bytes; 48 bytes fill the axes."""
    left = 0.0
    for length, name, value in fields:
        width = 100 * length / 48
        axes.add_patch(make_rectangle((left, bottom, width, 7), STORED_COLOR))
        axes.text(left + width / 2, bottom + 4.9, name, fontsize=8, color=TEXT_COLOR, ha="center", va="center")
        axes.text(
            left + width / 2,
            bottom + 2,
            value,
            fontsize=7.5,
            color=TEXT_COLOR,
            ha="center",
            va="center",
            family="monospace",
        )
        left += width


def read_sizes(path: Path) -> dict[str, int]:
    """Return the bytes of header, contents and padding, then of each section in file order with all its layers."""
    with Container.open(path, SECTION_CONTENTS) as container:
        sizes = {CONTAINER_GROUP: container.length}
        for size in section_sizes(container):
            group = group_and_layer(size.type)[0]
            sizes[group] = sizes.get(group, 0) + size.after
            sizes[CONTAINER_GROUP] -= size.after
    return sizes


def draw_bar(
    axes: Axes,
    bottom: float,
    height: float,
    parts: dict[str, int],
    width: float,
    *,
    left: float = 0,
    labels: bool = False,
) -> float:
    """Draw the sections of a file as a bar and return its right end; labels name the sections and their bytes."""
    total, is_label_above = sum(parts.values()), False
    for group, size in parts.items():
        part = width * size / total
        axes.add_patch(
            make_rectangle((left, bottom, part, height), SECTION_COLORS.get(group, SECTION_COLORS[METADATA]))
        )
        if labels and group != CONTAINER_GROUP:
            is_label_above = not is_label_above
            axes.text(
                min(max(left + part / 2, SECTION_LABEL_WIDTH_PERCENT / 2), 100 - SECTION_LABEL_WIDTH_PERCENT / 2),
                bottom + height + 2.6 if is_label_above else bottom - 2.6,
                f"{group}\n{size / 1000:.1f} kB",
                fontsize=7.5,
                color=TEXT_COLOR,
                ha="center",
                va="center",
            )
        left += part
    return left


def make_rectangle(rectangle: tuple[float, float, float, float], color: str) -> Any:
    """Return a filled rectangle (left, bottom, width, height) with a thin edge."""
    from matplotlib.patches import Rectangle

    left, bottom, width, height = rectangle
    return Rectangle((left, bottom), width, height, facecolor=color, edgecolor="white", linewidth=1)


# --- The codec -------------------------------------------------------------------------------------------------------


def draw_codec(model: HybridModel, report: CompressionReport, file: Path, path: Path) -> Path:
    """Draw sensitivities, steps and symbols of a compact file, and the shares of its bytes and errors."""
    sensitivity: Sensitivity = report.sensitivity
    per_number = hyrfpack.describe_file(file)["settings"]["distortion"]
    distortion = per_number * sum(parameter.numel() for parameter in model.parameters())
    plan = make_plan(model, sensitivity, distortion)
    planned = plan.apply(model)
    chosen, nearest = (quantize(planned, plan, sensitivity, reach=reach) for reach in (1, 0))

    figure = make_blank_figure(FIGURE_WIDTH_INCHES, 6.4)
    panels = figure.subplots(2, 2)
    draw_sensitivities(panels[0, 0], sensitivity)
    draw_steps(panels[0, 1], chosen, sensitivity)
    draw_symbols(panels[1, 0], chosen, nearest)
    draw_shares(panels[1, 1], report, file)
    for axes in panels.ravel():
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.title.set_size(9.5)
        axes.title.set_weight("bold")
        axes.xaxis.label.set_size(9)
        axes.yaxis.label.set_size(9)
    return save_png(figure, path)


def draw_sensitivities(axes: Axes, sensitivity: Sensitivity) -> None:
    """Draw the distribution of sensitivities of each kind of number."""
    sensitivities_by_section = {
        POSITIONS: sensitivity.positions,
        COLORS: sensitivity.colors,
        OPACITIES: sensitivity.opacities,
        RADIANCE_TABLE: sensitivity.fields[RADIANCE_TABLE],
        RADIANCE_DECODER: sensitivity.fields[RADIANCE_DECODER],
    }
    logs = {
        group: np.log10(values[values > MAX_UNREAD_SENSITIVITY]) for group, values in sensitivities_by_section.items()
    }
    low, high = np.percentile(
        np.concatenate([np.percentile(values, (1, 99)) for values in logs.values() if len(values)]), (0, 100)
    )
    bins = np.linspace(low - 1, high + 1, 60)
    for group, values in logs.items():
        shares = np.histogram(values, bins)[0] * (100 / max(len(values), 1))
        axes.stairs(shares, bins, color=SECTION_COLORS[group], linewidth=1.6, label=choose_legend_label(group))
    axes.set(title="1  Sensitivity of each number", xlabel="log10 of s", ylabel="share of the numbers (%)")
    axes.legend(fontsize=8, frameon=False, loc="upper left")


def draw_steps(axes: Axes, quantized: QuantizedModel, sensitivity: Sensitivity) -> None:
    """Draw the step of each class and group over its mean sensitivity, beside the rule sqrt(12 D / s)."""
    plan = quantized.plan
    kept_sensitivity = sensitivity.subset(plan.kept)
    classes = np.concatenate([layer.points.classes for layer in plan.layers])
    points: dict[str, list[tuple[float, float]]] = {}
    for kind in np.unique(classes):
        members = classes == kind
        layer = next(number for number, layer in enumerate(plan.layers) if (layer.points.classes == kind).any())
        bits = plan.layers[layer].points.bits[kind]
        points.setdefault(POSITIONS, []).append((kept_sensitivity.positions[members].mean(), 2.0**-bits))
        for group, values in (
            (COLORS, kept_sensitivity.colors),
            (SCALES, kept_sensitivity.scales),
            (OPACITIES, kept_sensitivity.opacities),
        ):
            code = quantized.channels[layer][group][0].codes[kind]
            points.setdefault(group, []).append((values[members].mean(), decode_step(code) / FIXED_POINT_ONE))
    for group, symbols in quantized.groups.items():
        index = plan.groups[group].index
        counts = np.maximum(np.bincount(index, minlength=len(symbols.codes)), 1)
        means = np.bincount(index, kept_sensitivity.fields[group], len(symbols.codes)) / counts
        for mean, code in zip(means, symbols.codes, strict=True):
            if code != ALL_ZERO_CODE:
                points.setdefault(group, []).append((mean, decode_step(code) / FIXED_POINT_ONE))
    everything = np.array([point for group in points.values() for point in group])
    ends = np.array([everything[:, 0].min() / 3, everything[:, 0].max() * 3])
    axes.plot(
        ends, np.sqrt(12 * plan.distortion_per_number / ends), color=LINE_COLOR, linewidth=1, label="$\\sqrt{12\\,D/s}$"
    )
    for group in (*DECODER_SECTIONS, *TABLE_SECTIONS, COLORS, SCALES, OPACITIES, POSITIONS):
        x, y = np.array(points.get(group, np.zeros((0, 2)))).reshape(-1, 2).T
        axes.scatter(x, y, s=12, color=SECTION_COLORS[group], zorder=3)
    axes.set(
        title="2  Step of each class and group", xlabel="mean sensitivity s", ylabel="step", xscale="log", yscale="log"
    )
    axes.legend(fontsize=9, frameon=False)


def draw_symbols(axes: Axes, chosen: QuantizedModel, nearest: QuantizedModel) -> None:
    """Draw the symbols of the radiance table, rounded to the nearest and chosen by rate and distortion."""
    group, drawn_symbols = RADIANCE_TABLE, np.arange(-MAX_DRAWN_SYMBOL, MAX_DRAWN_SYMBOL + 1)
    for offset, quantized, color, name in (
        (-0.2, nearest, "#bdc1c6", "nearest"),
        (0.2, chosen, SECTION_COLORS[group], "chosen"),
    ):
        symbols = quantized.groups[group]
        bits = 8 * len(encode_groups(symbols, quantized.plan.groups[group])) / len(symbols.symbols)
        shares = np.bincount(
            np.clip(symbols.symbols, drawn_symbols[0], drawn_symbols[-1]) - drawn_symbols[0],
            minlength=len(drawn_symbols),
        )
        axes.bar(
            drawn_symbols + offset,
            100 * shares / len(symbols.symbols),
            0.4,
            color=color,
            label=f"{name}: {bits:.2f} bits each",
        )
    axes.set(title="3  Symbols of the radiance table", xlabel="symbol", ylabel="share of the numbers (%)")
    axes.margins(y=0.25)
    axes.set_xticks(drawn_symbols[::2])
    axes.legend(fontsize=8, frameon=False)


def draw_shares(axes: Axes, report: CompressionReport, file: Path) -> None:
    """Draw each section's share of the bytes and of the predicted error."""
    sizes = {group: size for group, size in read_sizes(file).items() if group in report.shares}
    total, rows = sum(sizes.values()), np.arange(len(sizes))[::-1]
    axes.barh(
        rows + 0.2, [100 * size / total for size in sizes.values()], 0.4, color=[SECTION_COLORS[g] for g in sizes]
    )
    axes.barh(rows - 0.2, [100 * report.shares.get(group, 0) for group in sizes], 0.4, color="#bdc1c6")
    axes.set_yticks(rows, [choose_legend_label(group) for group in sizes])
    axes.set(title="4  Bytes (colour) and error (grey)", xlabel="share of the whole (%)")


def choose_legend_label(group: str) -> str:
    """Return the content of a section as a short text for a legend."""
    return SECTION_CONTENTS[group].replace(" logits", "s").replace("opacitys", "opacities").replace(" hash", "")


def save_png(figure: Any, path: Path) -> Path:
    """Write a figure as a PNG of 256 colours on white."""
    rendered, data = io.BytesIO(), io.BytesIO()
    figure.savefig(rendered, dpi=120, format="png", facecolor="white")
    picture = Image.open(rendered).convert("RGB")
    palette = picture.quantize(255)
    palette.putpalette([*(palette.getpalette() or [])[: 3 * 255], 255, 255, 255])
    reduced = picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
    indices = np.array(reduced)
    indices[(np.asarray(picture) == 255).all(-1)] = 255  # dithering would make white grey
    exact = Image.fromarray(indices, "P")
    exact.putpalette(reduced.getpalette() or [])
    exact.save(data, "PNG", optimize=True)
    return write_atomic(path, data.getbuffer())


if __name__ == "__main__":
    run_command(main)
