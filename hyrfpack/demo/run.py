"""Everything once, on a scene made on the spot: photos, training, compression, decompression, rendering, scores."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from hyrfpack.compress import compress
from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.evaluate import evaluate
from hyrfpack.evaluate.figures import draw_comparison, draw_contact_sheet
from hyrfpack.evaluate.metrics import psnr, to_8bit
from hyrfpack.export import ExportReport, export
from hyrfpack.format import CompressionReport, load, repack
from hyrfpack.lock import exclusive_folder
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.render import render
from hyrfpack.render.files import render_files, save_picture
from hyrfpack.scene import Scene, evenly_spaced
from hyrfpack.train import TrainConfig, train

DRAWN_VIEWS = 4
SCENE, RUN, RENDERS, PAGE, PICTURE, BACK = "scene", "run", "renders", "demo.html", "demo.png", "back.hyrf"
PACKED = {profile: f"{profile}.hyrf" for profile in ("paper", "compact")}
FILES = (  # what a demo leaves, one of each kind
    PICTURE,
    PAGE,
    BACK,
    *PACKED.values(),
    f"{SCENE}/transforms.json",
    f"{SCENE}/images/0000.png",
    f"{RUN}/model.hyrf",
    f"{RENDERS}/0000.png",
)


@dataclass(frozen=True)
class ProfileResult:
    """One profile of the demo's model, measured on the decoded file.

    Attributes:
        profile: "raw", "paper" or "compact".
        psnr, ssim: means over the held-out views.
        bytes: on disk.
        compress_seconds: reading the trained file and writing this one, for "compact" with the measuring; None for the
            file that training wrote.
        decompress_seconds: reading this file and writing it as raw.
    """

    profile: str
    psnr: float
    ssim: float
    bytes: int
    compress_seconds: float | None
    decompress_seconds: float


@dataclass(frozen=True)
class DemoResult:
    """What a demo came to.

    Attributes:
        steps, gaussians: of the training.
        train_seconds: its time, kernels compiled on the way included.
        frames_per_second: one over the median time to render a held-out view from the compact file.
        profiles: raw, paper, compact.
        picture: path of the picture that shows it.
        page: what the page takes that holds the compact file and plays it in a browser.
    """

    steps: int
    gaussians: int
    train_seconds: float
    frames_per_second: float
    profiles: list[ProfileResult]
    picture: Path
    page: ExportReport

    def table(self) -> list[str]:
        """The profiles as lines of aligned text, then the speed, and what the page takes."""
        lines = ["profile  PSNR (dB)    SSIM       bytes  compress (s)  decompress (s)"]
        for p in self.profiles:
            there = "-" if p.compress_seconds is None else f"{p.compress_seconds:.2f}"
            back = f"{p.decompress_seconds:.2f}"
            lines.append(f"{p.profile:<7}  {p.psnr:9.2f}  {p.ssim:.4f}  {p.bytes:10,}  {there:>12}  {back:>14}")
        rate = self.steps / self.train_seconds
        speed = f"{rate:.0f} training steps/s, {self.frames_per_second:.0f} rendered frames/s"
        return [*lines, speed, f"{self.page.bytes:,} bytes: a web page with the compact file and its player inside"]

    def to_dict(self) -> dict:
        """Plain numbers, strings, lists and dictionaries, ready for JSON."""
        return {**asdict(self), "picture": str(self.picture)}


def run_demo(
    folder: str | os.PathLike[str],
    *,
    steps: int = 3000,
    views: int = 60,
    size: int = 200,
    overwrite: bool = True,
    say: Callable[[str], None] = lambda sentence: None,
) -> DemoResult:
    """Make a scene, train on it, compress, decompress, render, score, export, and draw one picture of it.

    Leaves in `folder`: `scene/` (photos and poses), `run/` (the training), `paper.hyrf`, `compact.hyrf`, `back.hyrf`
    (compact.hyrf decompressed), `renders/` (held-out views from compact.hyrf), `demo.html` (compact.hyrf in a page that
    plays it) and `demo.png`.

    Args:
        folder: made if missing.
        steps: of the training.
        views, size: how many photos, and their width and height in pixels.
        overwrite: replace files that are there; without it, they are an error.
        say: told what is going on, a sentence before each part.

    Raises:
        HyrfError: something cannot be written, or another call is at work in the folder.
    """
    folder = Path(folder)
    Outputs(overwrite=True).folder(folder, FILES)
    with exclusive_folder(folder):
        Outputs(overwrite=overwrite).folder(folder, FILES)
        return _run_demo(folder, steps, views, size, overwrite, say)


def _run_demo(
    folder: Path, steps: int, views: int, size: int, overwrite: bool, say: Callable[[str], None]
) -> DemoResult:
    """As `run_demo`, in a folder that this call holds."""
    say(f"making a scene of {views} photos")
    write_demo_scene(folder / SCENE, views=views, size=size, overwrite=overwrite)
    scene = load_scene(folder / SCENE)
    say(f"training {steps:,} steps on {len(scene.train)} photos, {len(scene.test)} held out")
    trained = train(scene, folder / RUN, TrainConfig(steps=steps), overwrite=overwrite)
    if trained.model is None:
        raise KeyboardInterrupt

    say("compressing, decompressing and scoring")
    back, profiles, replace = folder / BACK, [], overwrite
    for profile in ("raw", *PACKED):
        path, compress_seconds = trained.model, None
        if profile != "raw":
            packed, compress_seconds = _timed(
                partial(compress, trained.model, folder / PACKED[profile], profile, overwrite=overwrite)
            )
            path = Path(packed.file)
        unpacked, decompress_seconds = _timed(partial(repack, path, back, overwrite=replace))
        back, replace = Path(unpacked.file), True  # from now on it is of this call
        scores = evaluate(load(back), scene.test)
        stored = path.stat().st_size
        profiles.append(ProfileResult(profile, scores.psnr, scores.ssim, stored, compress_seconds, decompress_seconds))

    say("rendering held-out views")
    model = load(path)
    held_out = [(view.name, view.camera) for view in scene.test]
    for _ in render_files(model, held_out, folder / RENDERS, overwrite=overwrite):
        pass
    say("making a page for the browser")
    page = export(path, folder / PAGE, data=scene, overwrite=overwrite)
    result = DemoResult(
        steps=steps,
        gaussians=len(model),
        train_seconds=trained.metrics["seconds"],
        frames_per_second=1 / scores.seconds_per_frame,
        profiles=profiles,
        picture=folder / PICTURE,
        page=page,
    )
    picture = save_picture(result.picture, _draw(model, scene, result), overwrite=overwrite)
    return dataclasses.replace(result, picture=picture)


@torch.no_grad()
def _draw(model: HybridModel, scene: Scene, result: DemoResult) -> Image.Image:
    """The demo's picture: held-out views of the compact file under the table."""
    decoded = model.decode()
    solid = np.array(model.config.solid, np.float32)
    rows = []
    for view in evenly_spaced(scene.test, DRAWN_VIEWS):
        photo = torch.from_numpy(view.load().composite(solid))
        image = to_8bit(render(model, view.camera, decoded=decoded).rgb)
        rows.append(draw_comparison(photo, image, caption=f"{view.name}   {psnr(image, photo):.2f} dB"))
    title = f"hyrfpack demo: {result.gaussians:,} Gaussians, {result.steps:,} steps in {result.train_seconds:.0f} s"
    return draw_contact_sheet(rows, title, result.table())


def _timed(action: Callable[[], CompressionReport]) -> tuple[CompressionReport, float]:
    """What an action returns, and the seconds that it took."""
    start = time.perf_counter()
    report = action()
    return report, time.perf_counter() - start
