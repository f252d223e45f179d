"""The command `hyrfpack edit`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import (
    format_table,
    json_option,
    note_rename,
    overwrite_option,
    print_json,
    read_scene,
    resolve_model_file,
    scene_options,
)
from hyrfpack.cli.ordered import OrderedCommand, options_in_order
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT, TURNED_BOX, Numbers, NumbersOrWord
from hyrfpack.config.compress import PROFILES
from hyrfpack.config.edit import (
    DEFAULT_MIN_OPACITY_SHARE,
    DEFAULT_REFIT_STEPS,
    UPRIGHT_AXES,
    Action,
    Background,
    Center,
    Crop,
    CropBox,
    CropCameras,
    CropMasks,
    CropSphere,
    EditLimits,
    EstimateUp,
    KeepGaussians,
    MaxScale,
    MinOpacity,
    Refit,
    Remove,
    RemoveFloaters,
    Rotate,
    Scale,
    Translate,
    Up,
    Upright,
)
from hyrfpack.counts import format_count

if TYPE_CHECKING:
    from hyrfpack.edit import EditReport

ESTIMATED_UP_WORD = "auto"


def _read_polygon(path: Path) -> Action:
    from hyrfpack.edit.polygon import read_polygon

    return read_polygon(path)


# How the value of each option becomes an action.
_ACTION_BY_OPTION: dict[str, Callable[[Any], Action]] = {
    "crop_box": lambda box: CropBox(tuple(box[:3]), tuple(box[3:6]), *box[6:]),
    "crop_sphere": lambda numbers: CropSphere(tuple(numbers[:3]), numbers[3]),
    "crop_cameras": CropCameras,
    "crop_polygon": _read_polygon,
    "crop_masks": lambda folder: CropMasks(str(folder)),
    "min_opacity": MinOpacity,
    "max_scale": MaxScale,
    "remove_floaters": RemoveFloaters,
    "gaussians": KeepGaussians,
    "background_color": Background,
    "translate": Translate,
    "scale": Scale,
    "rotate": lambda numbers: Rotate(tuple(numbers[:3]), numbers[3]),
    "up": lambda direction: EstimateUp() if direction == ESTIMATED_UP_WORD else Up(direction),
    "upright": Upright,
    "center": lambda _: Center(),
}


@click.command(short_help="Crop, clean, repair, reduce and move a model.", cls=OrderedCommand)
@click.argument("model", type=INPUT_PATH)
@click.option("-o", "--output", type=OUTPUT, metavar="FILE", help="The .hyrf file to write.")
@click.option("--plan", is_flag=True, help="Print what the actions would do, and write no model.")
@click.option("--picture", type=OUTPUT, metavar="FILE", help="Write a .png or .jpg of the scene before and after.")
@click.option(
    "--crop-box",
    type=TURNED_BOX,
    multiple=True,
    help="Keep the Gaussians inside MINX,MINY,MINZ,MAXX,MAXY,MAXZ[,DEGREES]. The degrees turn the box about its centre "
    "and the up direction, by the right-hand rule.",
)
@click.option(
    "--crop-sphere", type=Numbers(4, "X,Y,Z,RADIUS"), multiple=True, help="Keep the Gaussians inside a sphere."
)
@click.option(
    "--crop-cameras",
    type=float,
    multiple=True,
    metavar="MARGIN",
    help="Keep the Gaussians that the cameras surround, seen from above. The margin enlarges this area by a fraction "
    "of its size; 0 for none.",
)
@click.option(
    "--crop-polygon",
    type=INPUT_PATH,
    multiple=True,
    metavar="JSON",
    help="Keep the Gaussians above and below a polygon on the ground, which the file states as [[x, y, z], ...], or as "
    'an object with "points", "min_height" and "max_height".',
)
@click.option(
    "--crop-masks",
    type=INPUT_PATH,
    multiple=True,
    metavar="DIR",
    help="Keep the Gaussians that the masks in DIR show; black is outside. Masks have the names of their photos; needs "
    "--data.",
)
@click.option("--invert", count=True, help="After a crop: remove the Gaussians that it would keep.")
@click.option(
    "--refit",
    type=int,
    multiple=True,
    metavar="STEPS",
    help="After a crop: remove nothing, and train the Gaussians that it would keep on the photos, while all others "
    f"stay as they are; needs --data. Begin with {DEFAULT_REFIT_STEPS} steps.",
)
@click.option("--min-opacity", type=float, multiple=True, metavar="OPACITY", help="Remove lower opacities, 0 to 1.")
@click.option(
    "--max-scale", type=float, multiple=True, metavar="LENGTH", help="Remove Gaussians with a longer axis (std. dev.)."
)
@click.option(
    "--remove-floaters",
    type=float,
    multiple=True,
    metavar="SHARE",
    help="Remove floaters, which are Gaussians in front of the surfaces, if the photos support less than SHARE (0 to "
    f"1) of their opacity; needs --data. Begin with {DEFAULT_MIN_OPACITY_SHARE}; a higher SHARE removes more.",
)
@click.option(
    "--gaussians",
    type=int,
    multiple=True,
    metavar="N",
    help="Keep the N Gaussians whose removal would change renders at the cameras most.",
)
@click.option(
    "--background-color",
    type=Numbers(3, "R,G,B"),
    multiple=True,
    help="Replace the background by a colour, each number 0 to 1.",
)
@click.option("--translate", type=Numbers(3, "X,Y,Z"), multiple=True, help="Move the scene.")
@click.option("--scale", type=float, multiple=True, metavar="FACTOR", help="Scale the scene about the origin.")
@click.option(
    "--rotate",
    type=Numbers(4, "X,Y,Z,DEGREES"),
    multiple=True,
    help="Rotate the scene about the axis X,Y,Z through the origin, by the right-hand rule.",
)
@click.option("--center", count=True, help="Move the point that the cameras look at to the origin.")
@click.option(
    "--up",
    type=NumbersOrWord(3, "X,Y,Z", ESTIMATED_UP_WORD),
    multiple=True,
    help="State which direction is up, for viewers, exports and --upright; auto estimates it from the cameras.",
)
@click.option(
    "--upright",
    type=click.Choice(UPRIGHT_AXES),
    multiple=True,
    help="Rotate the scene about the origin so that its up direction becomes +y, as in three.js, Unity and glTF, or "
    "+z, as in Blender, Unreal and CAD.",
)
@click.option(
    "--part",
    metavar="NAME",
    help="The part of a merged file that is taken out and edited.  [default: all parts together]",
)
@click.option(
    "--profile",
    type=click.Choice(PROFILES),
    help="Profile of the file to write.  [default: that of MODEL; compact with --target-size or --max-psnr-drop]",
)
@settings_options(EditLimits, "target_bytes", "max_psnr_drop")
@click.option(
    "--data",
    type=INPUT_PATH,
    help="Photos and poses of MODEL, for --remove-floaters, --crop-masks, --refit and --max-psnr-drop, and for scores "
    "on held-out photos before and after.",
)
@overwrite_option
@scene_options
@json_option
@click.pass_context
def edit(
    ctx: click.Context,
    model: Path,
    output: Path | None,
    plan: bool,
    picture: Path | None,
    part: str | None,
    profile: str | None,
    target_bytes: int | None,
    max_psnr_drop: float | None,
    data: Path | None,
    overwrite: bool,
    reader_options: dict[str, Any],
    as_json: bool,
    **values: Any,
) -> None:
    """Edit MODEL, a .hyrf file or the folder of a run, and report how much its pictures change.

    Actions are applied in the order in which they are given, and may be repeated. Positions and lengths are in world
    units, after the moves before them. The file that is written has the profile of MODEL.

    \b
    Examples:
      hyrfpack edit bonsai.hyrf --plan --crop-sphere 0,0,0,1.5
      hyrfpack edit bonsai.hyrf -o table.hyrf --center --crop-sphere 0,0,0,1.5 --background-color 1,1,1
      hyrfpack edit garden.hyrf -o clean.hyrf --min-opacity 0.02 --crop-cameras 0.5
      hyrfpack edit runs/garden -o clean.hyrf --remove-floaters 0.35 --data photos/garden
      hyrfpack edit runs/desk -o lamp.hyrf --crop-masks lamp_masks --data photos/desk --background-color 1,1,1
      hyrfpack edit runs/desk -o desk.hyrf --crop-sphere 0,0,0,0.4 --refit 500 --data photos/desk
      hyrfpack edit runs/garden -o small.hyrf --crop-cameras 0.5 --target-size 150kB
      hyrfpack edit survey.hyrf -o plot.hyrf --crop-polygon plot.json
      hyrfpack edit room.hyrf -o hole.hyrf --crop-box=-1,-1,-1,1,1,1 --invert
      hyrfpack edit survey.hyrf -o meters.hyrf --scale 2.54
      hyrfpack edit bonsai.hyrf -o upright.hyrf --up auto --upright z --center
      hyrfpack edit furnished.hyrf -o corner.hyrf --crop-box=-1,-1,-1,1,1,1
      hyrfpack edit furnished.hyrf -o chair.hyrf --part chair
    """
    actions = _read_actions(options_in_order(ctx, values))
    limits = EditLimits(target_bytes, max_psnr_drop)
    if not actions and part is None and limits == EditLimits():
        raise click.UsageError("there is nothing to do; give at least one action, such as --crop-sphere 0,0,0,1")
    if plan == (output is not None):
        raise click.UsageError("give either -o FILE to write the edited model, or --plan to see what would change")
    if plan and limits != EditLimits():
        raise click.UsageError("--plan writes no file, whose size or loss could be limited; leave out the limit")
    if plan and profile is not None:
        raise click.UsageError("--plan writes no file, which could have a profile; leave out --profile")
    from hyrfpack.edit import edit_model, plan_edit
    from hyrfpack.format import describe_file

    model = resolve_model_file(model)
    scene = None
    if data is not None:
        facts = describe_file(model)
        edited = next((entry for entry in facts.get("parts", []) if entry["name"] == part), facts)
        scene = read_scene(data, reader_options, model, edited, must_match=True)
    if plan:
        report = plan_edit(model, actions, part=part, data=scene, picture=picture, overwrite=overwrite)
    else:
        assert output is not None
        report = edit_model(
            model,
            output,
            actions,
            part=part,
            profile=profile,
            limits=limits,
            data=scene,
            picture=picture,
            overwrite=overwrite,
        )
        note_rename(output, report.file)
    if as_json:
        print_json(report.to_dict())
    else:
        _print_report(report)


def _read_actions(options: Iterable[tuple[str, Any]]) -> list[Action]:
    """Return the actions that options name by their names and values, in this order.

    Raises:
        UsageError: a number is out of its range, or --invert or --refit does not follow a crop.
    """
    actions: list[Action] = []
    for name, value in options:
        try:
            if name == "invert":
                if not actions or not isinstance(actions[-1], Crop):
                    raise click.UsageError("--invert must follow an option that crops, such as --crop-box")
                actions[-1] = Remove(actions[-1])
            elif name == "refit":
                if not actions or not isinstance(actions[-1], Crop | Remove):
                    raise click.UsageError("--refit must follow an option that crops, such as --crop-box")
                actions[-1] = Refit(actions[-1], value)
            else:
                actions.append(_ACTION_BY_OPTION[name](value))
        except ValueError as error:
            raise click.UsageError(f"--{name.replace('_', '-')}: {error}") from error
    return actions


def _print_report(report: EditReport) -> None:
    rows = [
        [step.action, f"{step.gaussians_before:,}", f"{step.gaussians_after - step.gaussians_before:+,}"]
        for step in report.actions
    ]
    if rows:
        click.echo(format_table(["action", "Gaussians before", "change"], rows))
    for step in report.actions:
        if step.region_psnr_before is not None:
            click.echo(
                f"{step.action}: {format_count(step.gaussians_trained, 'Gaussian')}, PSNR there on held-out photos "
                f"{step.region_psnr_before:.2f} to {step.region_psnr_after:.2f} dB"
            )
    click.echo(
        f"renders before and after, {format_count(report.views, 'view')}: PSNR mean {report.psnr_change:.2f} dB, "
        f"lowest {report.psnr_change_worst:.2f} dB"
    )
    if report.psnr_before is not None:
        click.echo(
            f"held-out photos: PSNR {report.psnr_before:.3f} to {report.psnr_after:.3f} dB, SSIM "
            f"{report.ssim_before:.4f} to {report.ssim_after:.4f}"
        )
    if report.found:
        click.echo(report.found)
    if report.file:
        click.echo(f"{report.file}: {report.bytes_after:,} bytes, {report.bytes_before:,} before")
