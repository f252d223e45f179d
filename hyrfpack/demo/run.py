"""The demo: all stages on a procedural scene, from photos to training, compression, rendering and scores."""

from __future__ import annotations

import dataclasses
import logging
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from hyrfpack.compress import compress_model
from hyrfpack.config.compress import CompressConfig
from hyrfpack.context import RunContext
from hyrfpack.counts import format_count
from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.evaluate import evaluate_model
from hyrfpack.evaluate.figures import draw_comparison, draw_contact_sheet
from hyrfpack.evaluate.metrics import psnr, to_8bit
from hyrfpack.export import ExportReport, export_model
from hyrfpack.format import FileReport, load_model, repack
from hyrfpack.lock import exclusive_folder
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.render import render_view
from hyrfpack.render.files import render_files, save_picture
from hyrfpack.scene import Scene, evenly_spaced
from hyrfpack.train import TrainConfig, train_model

_LOG = logging.getLogger(__name__)

DRAWN_VIEW_COUNT = 4
SCENE_FOLDER = "scene"
RUN_FOLDER = "run"
RENDERS_FOLDER = "renders"
PAGE_FILE = "demo.html"
PICTURE_FILE = "demo.png"
UNPACKED_FILE = "back.hyrf"
PACKED_FILES = {profile: f"{profile}.hyrf" for profile in ("paper", "compact")}
# Files that a demo writes; for numbered pictures, only the first is listed.
RESULT_FILES = (
    PICTURE_FILE,
    PAGE_FILE,
    UNPACKED_FILE,
    *PACKED_FILES.values(),
    f"{SCENE_FOLDER}/transforms.json",
    f"{SCENE_FOLDER}/images/0000.png",
    f"{RUN_FOLDER}/model.hyrf",
    f"{RENDERS_FOLDER}/0000.png",
)


@dataclass(frozen=True)
class ProfileResult:
    """Scores, size and times of the demo's model in one profile, measured on the decoded file.

    Attributes:
        profile: "raw", "paper" or "compact".
        psnr, ssim: mean PSNR (dB) and SSIM of the held-out views.
        bytes: size on disk.
        compress_seconds: time to read the trained file and write this one, for "compact" including its measurements;
            None for the file that training wrote.
        decompress_seconds: time to read this file and write it as raw.
    """

    profile: str
    psnr: float
    ssim: float
    bytes: int
    compress_seconds: float | None
    decompress_seconds: float


@dataclass(frozen=True)
class DemoResult:
    """The result of a demo.

    Attributes:
        steps, gaussians: number of training steps that were taken, and of trained Gaussians.
        train_seconds: time of the training, including the compilation of kernels.
        frames_per_second: inverse of the median time to render a held-out view from the compact file.
        profiles: results of the profiles raw, paper and compact.
        picture: path of the picture that shows the result.
        page: report of the page that holds the compact file and plays it in a browser.
    """

    steps: int
    gaussians: int
    train_seconds: float
    frames_per_second: float
    profiles: list[ProfileResult]
    picture: Path
    page: ExportReport

    def table(self) -> list[str]:
        """Return lines of text: a table of the profiles, the speed, and the size of the page."""
        lines = ["profile  PSNR (dB)    SSIM       bytes  compress (s)  decompress (s)"]
        for p in self.profiles:
            there = "-" if p.compress_seconds is None else f"{p.compress_seconds:.2f}"
            back = f"{p.decompress_seconds:.2f}"
            lines.append(f"{p.profile:<7}  {p.psnr:9.2f}  {p.ssim:.4f}  {p.bytes:10,}  {there:>12}  {back:>14}")
        rate = self.steps / self.train_seconds
        speed = f"{rate:.0f} training steps/s, {self.frames_per_second:.0f} rendered frames/s"
        return [*lines, speed, f"{self.page.bytes:,} bytes: a web page with the compact file and its player inside"]

    def to_dict(self) -> dict:
        """Return the result as numbers, strings, lists and dictionaries, ready for JSON."""
        return {**asdict(self), "picture": str(self.picture)}


def run_demo(
    folder: str | os.PathLike[str],
    *,
    steps: int = 3000,
    views: int = 60,
    size: int = 200,
    overwrite: bool = True,
) -> DemoResult:
    """Write a scene, train on it, compress, decompress, render, score, export, and draw a picture of the result.

    The files in `folder` are: `scene/` (photos and poses), `run/` (the training), `paper.hyrf`, `compact.hyrf`,
    `back.hyrf` (compact.hyrf decompressed), `renders/` (held-out views from compact.hyrf), `demo.html` (a page that
    holds compact.hyrf and plays it) and `demo.png`.

    Args:
        folder: folder of the results; created if missing.
        steps: number of training steps.
        views, size: number of photos, and their width and height in pixels.
        overwrite: replace existing files; without it, they are an error.

    Raises:
        HyrfError: a file cannot be written, or another call is writing into the folder.
    """
    folder = Path(folder)
    Outputs(overwrite=True).folder(folder, RESULT_FILES)
    with exclusive_folder(folder):
        Outputs(overwrite=overwrite).folder(folder, RESULT_FILES)
        return _run_demo(folder, steps, views, size, overwrite)


def _run_demo(folder: Path, steps: int, views: int, size: int, overwrite: bool) -> DemoResult:
    """Run the demo as `run_demo` does, in a folder that is locked."""
    _LOG.info(f"making a scene of {views} photos")
    write_demo_scene(folder / SCENE_FOLDER, views=views, size=size, overwrite=overwrite)
    scene = load_scene(folder / SCENE_FOLDER)
    _LOG.info(f"training {steps:,} steps on {len(scene.train)} photos, {len(scene.test)} held out")
    trained = train_model(scene, folder / RUN_FOLDER, TrainConfig(steps=steps), overwrite=overwrite)
    if trained.model is None:
        raise KeyboardInterrupt

    _LOG.info("compressing, decompressing and scoring")
    unpacked_path, profiles, replace = folder / UNPACKED_FILE, [], overwrite
    for profile in ("raw", *PACKED_FILES):
        path, compress_seconds = trained.model, None
        if profile != "raw":
            config, context = CompressConfig(profile=profile), RunContext(progress=None)
            compress = partial(compress_model, trained.model, folder / PACKED_FILES[profile], config, context=context)
            packed, compress_seconds = _timed(partial(compress, overwrite=overwrite))
            path = Path(packed.file)
        unpacked, decompress_seconds = _timed(partial(repack, path, unpacked_path, overwrite=replace))
        unpacked_path, replace = Path(unpacked.file), True  # this call has written the file and may replace it
        scores = evaluate_model(load_model(unpacked_path), scene.test)
        stored = path.stat().st_size
        profiles.append(ProfileResult(profile, scores.psnr, scores.ssim, stored, compress_seconds, decompress_seconds))

    _LOG.info("rendering held-out views")
    model = load_model(path)
    held_out = [(view.name, view.camera) for view in scene.test]
    for _ in render_files(model, held_out, folder / RENDERS_FOLDER, overwrite=overwrite):
        pass
    _LOG.info("making a page for the browser")
    page = export_model(path, folder / PAGE_FILE, data=scene, overwrite=overwrite)
    result = DemoResult(
        steps=trained.step,
        gaussians=len(model),
        train_seconds=trained.metrics["seconds"],
        frames_per_second=1 / scores.seconds_per_frame,
        profiles=profiles,
        picture=folder / PICTURE_FILE,
        page=page,
    )
    picture = save_picture(result.picture, _draw(model, scene, result), overwrite=overwrite)
    return dataclasses.replace(result, picture=picture)


@torch.no_grad()
def _draw(model: HybridModel, scene: Scene, result: DemoResult) -> Image.Image:
    """Draw the demo's picture: held-out views of the compact file, and the table of results."""
    decoded = model.decode()
    solid = np.array(model.config.solid, np.float32)
    rows = []
    for view in evenly_spaced(scene.test, DRAWN_VIEW_COUNT):
        photo = torch.from_numpy(view.load().composite(solid))
        image = to_8bit(render_view(model, view.camera, decoded=decoded).rgb)
        rows.append(draw_comparison(photo, image, caption=f"{view.name}   {psnr(image, photo):.2f} dB"))
    title = f"hyrfpack demo: {format_count(result.gaussians, 'Gaussian')}, {result.steps:,} steps in "
    title += f"{result.train_seconds:.0f} s"
    return draw_contact_sheet(rows, title, result.table())


def _timed(action: Callable[[], FileReport]) -> tuple[FileReport, float]:
    """Return the result of an action, and the seconds that it took."""
    start = time.perf_counter()
    report = action()
    return report, time.perf_counter() - start
