"""Compare hyrfpack's player with other viewers in a browser, on the same models.

    npm install --prefix viewers three @sparkjsdev/spark @mkkellogg/gaussian-splats-3d @playcanvas/supersplat-viewer
    python -m tools.studies.viewer_comparison MODEL.hyrf --viewers viewers --repeats 3

The player gets the `.hyrf` file and each other viewer the format that suits it, all written by `hyrfpack export` from
the same model: Spark .spz, SuperSplat .sog and GaussianSplats3D .ply. The file is also drawn inside three.js by
`examples/three`. All start at the same camera, in the same window, in a new Chromium each time, and take turns. A row
has:

- script: bytes of scripts, styles and pages that the viewer fetches, each compressed by gzip
- scene: bytes of the file of the scene
- first, complete: seconds from opening the page to the first frame on the screen that has FIRST_PICTURE_DETAIL of the
  final picture's detail, and to the frame after which the screen does not change by more than noise
- frame: CPU milliseconds of all processes of the browser for each drawn frame, while a mouse orbits at full resolution
- long tasks: number of tasks of the page's main thread above 50 ms until the picture is complete, and the longest, ms
- heap: megabytes of JavaScript objects and buffers in the page, after a garbage collection; workers are not included
- psnr: PSNR in dB of the screen's picture against `render_view` without approximations, at the same camera

Values are medians over the repeats. Times need an otherwise idle machine. Without a GPU the browser draws in software.

The results are in docs/research/browser.md.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import math
import os
import statistics
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from PIL import Image

import hyrfpack
from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.files import camera_to_json
from hyrfpack.cameras.paths import look_at
from hyrfpack.errors import HyrfError
from hyrfpack.scene import Camera
from tools.browser.chromium import Chromium
from tools.command import positive_integer, run_command
from tools.studies.web_player import EXACT_SETTINGS, orbit_with_mouse, psnr
from tools.tables import format_cell, markdown_row, markdown_table

WINDOW_SIZE = (1280, 800)
VERTICAL_FOV_DEGREES = 50.0
FILE_UP = np.array([0.0, -1.0, 0.0])  # the up direction that viewers expect in files of splats
FIRST_PICTURE_DETAIL = 0.5  # share of the standard deviation of the final picture's pixels
SAME_PICTURE_DB = 40.0  # of two frames of the screen recording, whose pictures are scaled down
STILL_SECONDS = 8.0  # a page whose screen has not changed for this long is complete
PAGE_TIMEOUT_SECONDS = 300.0
REPOSITORY_ROOT = Path(__file__).parents[2]
DECODER_FOLDER = REPOSITORY_ROOT / "hyrfpack" / "web" / "hyrf"
ESBUILD_PROGRAM = REPOSITORY_ROOT / "tests" / "node" / "node_modules" / ".bin" / "esbuild"  # after `make player`
SCRIPT_SUFFIXES = (".js", ".mjs", ".css", ".html", ".wasm")

# Counts frames in which a WebGL draw call was made, and records tasks of the main thread above 50 ms.
OBSERVER_SCRIPT = """
  window.drawnFrames = 0;
  window.longTasks = [];
  new PerformanceObserver((list) => {
    for (const { startTime, duration } of list.getEntries())
      window.longTasks.push([(performance.timeOrigin + startTime) / 1000, duration]);
  }).observe({ type: "longtask", buffered: true });
  let hasDrawn = false;
  for (const name of ["drawArrays", "drawElements", "drawArraysInstanced", "drawElementsInstanced"]) {
    const draw = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...values) { hasDrawn = true; return draw.apply(this, values); };
  }
  const count = () => {
    window.drawnFrames += hasDrawn;
    hasDrawn = false;
    requestAnimationFrame(count);
  };
  requestAnimationFrame(count);
"""
BUNDLED_PAGE = """<!DOCTYPE html><meta charset="utf-8">
<style>html, body { margin: 0; height: 100%%; overflow: hidden; background: black; }</style>
<body><script type="module" src="%s.js"></script>"""
# All scripts get the position, the target and the field of view of the camera. Three's world has y up: the first two
# scripts turn the camera about x, and the object or the file likewise; the last one turns the camera's up direction.
THREE_SCRIPT = """
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
const camera = new THREE.PerspectiveCamera(%(fov)s, innerWidth / innerHeight, 0.01, 1e5);
camera.position.set(%(x)s, -(%(y)s), -(%(z)s));
const renderer = new THREE.WebGLRenderer({ antialias: false });
renderer.setSize(innerWidth, innerHeight);
document.body.append(renderer.domElement);
const scene = new THREE.Scene(), controls = new OrbitControls(camera, renderer.domElement);
controls.target.set(%(tx)s, -(%(ty)s), -(%(tz)s));
renderer.setAnimationLoop(() => { controls.update(); renderer.render(scene, camera); });
"""
OBJECT_SCRIPT = (
    'import { HyrfObject } from "%(examples)s/three/hyrf-object.js";'
    + THREE_SCRIPT
    + """
const createWorker = () => new Worker("remote_worker.js", { type: "module" });
const object = await HyrfObject.load("player/scene.hyrf", { createWorker });
object.quaternion.set(1, 0, 0, 0);
scene.add(object);
"""
)
SPARK_SCRIPT = (
    'import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";'
    + THREE_SCRIPT
    + """
scene.add(new SparkRenderer({ renderer }), new SplatMesh({ url: "scene.spz" }));
"""
)
SPLATS3D_SCRIPT = """
import * as GaussianSplats3D from "@mkkellogg/gaussian-splats-3d";
const viewer = new GaussianSplats3D.Viewer({
  cameraUp: [0, -1, 0], initialCameraPosition: [%(x)s, %(y)s, %(z)s], initialCameraLookAt: [%(tx)s, %(ty)s, %(tz)s],
  sharedMemoryForWorkers: false, sphericalHarmonicsDegree: 2,
});
Object.assign(viewer.camera, { fov: %(fov)s, far: 1e5 });
viewer.camera.updateProjectionMatrix();
viewer.addSplatScene("scene.ply", { showLoadingUI: false, progressiveLoad: true }).then(() => viewer.start());
"""


@dataclass(frozen=True)
class Pose:
    """A camera whose right axis is horizontal in the file's axes. Positions are (3,) in world units."""

    position: np.ndarray
    target: np.ndarray

    def to_camera(self, width: int, height: int) -> Camera:
        """Return the camera of a window."""
        focal = height / 2 / math.tan(math.radians(VERTICAL_FOV_DEGREES) / 2)
        pose = look_at(self.position, self.target, FILE_UP)
        return Camera(width, height, focal, focal, width / 2, height / 2, pose)

    def to_page_values(self) -> dict[str, float]:
        """Return the values that the pages of other viewers take."""
        names = ("x", "y", "z", "tx", "ty", "tz")
        return {"fov": VERTICAL_FOV_DEGREES, **dict(zip(names, [*self.position, *self.target], strict=True))}


@dataclass(frozen=True)
class Measurement:
    """What one visit of a viewer's page has measured; see the columns in the module's docstring."""

    script_bytes: float
    scene_bytes: float
    first_seconds: float
    complete_seconds: float
    frame_cpu_ms: float
    long_tasks: float
    longest_task_ms: float
    heap_mb: float
    psnr_db: float


@dataclass(frozen=True)
class Viewer:
    """A viewer to measure.

    Attributes:
        name: its name in the table.
        address: path and query of its page on the server, with the camera.
        scene_file: name of the file of the scene that the page fetches.
        is_final: JavaScript that is true when the picture is final; the screen has to be still, too.
        prepare: JavaScript that runs in the complete page before frames are counted.
    """

    name: str
    address: str
    scene_file: str
    is_final: str = "true"
    prepare: str = "0"


class Site:
    """A web server of a folder on this machine. `fetched` has the paths of the files that were requested."""

    def __init__(self, folder: Path) -> None:
        self.fetched: list[Path] = []
        fetched = self.fetched

        class Handler(SimpleHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                fetched.append(Path(self.translate_path(self.path)).resolve())
                super().do_GET()

            def log_message(self, format: str, *values: object) -> None:
                """Print nothing."""

        handler = partial(Handler, directory=str(folder))
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}"

    @contextmanager
    def run(self) -> Iterator[None]:
        """Serve within this context."""
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        try:
            yield
        finally:
            self._server.shutdown()
            self._server.server_close()


def write_site(folder: Path, model: Path, viewers: Path, pose: Pose) -> list[Viewer]:
    """Write the pages and the files of a scene into a folder, and return the viewers that show them there.

    Raises:
        HyrfError: esbuild or the other viewers are not installed.
    """
    if not ESBUILD_PROGRAM.exists():
        raise HyrfError(f"{ESBUILD_PROGRAM}: esbuild is not installed", fix="run npm ci --prefix tests/node")
    if not (viewers / "node_modules").is_dir():
        raise HyrfError(f"{viewers}: no viewers are installed here", fix="install them with npm as the help shows")
    (folder / "viewers").symlink_to((viewers / "node_modules").resolve())
    hyrfpack.export_model(model, folder / "player")
    Image.new("RGB", (1, 1)).save(folder / "player" / "poster.jpg")  # the picture has to come from the scene
    for name, spz_version in (("scene.spz", 3), ("scene.ply", 4), ("scene.sog", 4)):
        hyrfpack.export_model(model, folder / name, hyrfpack.ExportConfig(spz_version=spz_version))
    values: dict[str, Any] = {**pose.to_page_values(), "examples": REPOSITORY_ROOT / "examples"}
    bundle_script(f'import "{DECODER_FOLDER / "remote_worker.js"}";', folder / "remote_worker.js", viewers)
    for name, script in (("three", OBJECT_SCRIPT), ("spark", SPARK_SCRIPT), ("splats3d", SPLATS3D_SCRIPT)):
        bundle_script(script % values, folder / f"{name}.js", viewers)
        (folder / f"{name}.html").write_text(BUNDLED_PAGE % name)
    (folder / "favicon.ico").touch()
    # SuperSplat turns the file about z, so that y points up. Its field of view is that of the longer side.
    turn = np.array([-1.0, -1.0, 1.0])
    aspect = WINDOW_SIZE[0] / WINDOW_SIZE[1]
    fov = math.degrees(2 * math.atan(aspect * math.tan(math.radians(VERTICAL_FOV_DEGREES) / 2)))
    camera = {"position": list(turn * pose.position), "target": list(turn * pose.target), "fov": fov}
    (folder / "settings.json").write_text(json.dumps(SUPERSPLAT_SETTINGS | {"cameras": [{"initial": camera}]}))
    own_camera = quote(json.dumps(camera_to_json(pose.to_camera(*WINDOW_SIZE))))
    supersplat = "viewers/@playcanvas/supersplat-viewer/public/index.html"
    return [
        Viewer(
            "hyrfpack",
            f"player/index.html?noui#camera={own_camera}",
            "player/scene.hyrf",
            FINAL_PICTURE_SCRIPT,
            FULL_RESOLUTION_SCRIPT,
        ),
        Viewer("hyrfpack in three.js", "three.html", "player/scene.hyrf"),
        Viewer("Spark", "spark.html", "scene.spz"),
        Viewer("GaussianSplats3D", "splats3d.html", "scene.ply"),
        Viewer("SuperSplat", f"{supersplat}?content=/scene.sog&settings=/settings.json&noui&webgl&noanim", "scene.sog"),
    ]


FINAL_PICTURE_SCRIPT = "hyrfpack.player.idle"
FULL_RESOLUTION_SCRIPT = "hyrfpack.player.automatic = false"
SUPERSPLAT_SETTINGS = {
    "version": 2,
    "tonemapping": "none",
    "highPrecisionRendering": False,
    "background": {"color": [0, 0, 0]},
    "postEffectSettings": {
        "sharpness": {"enabled": False, "amount": 0},
        "bloom": {"enabled": False, "intensity": 0.1, "blurLevel": 2},
        "grading": {"enabled": False, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
        "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
        "fringing": {"enabled": False, "intensity": 0.5},
    },
    "animTracks": [],
    "annotations": [],
    "startMode": "default",
}


def bundle_script(script: str, path: Path, viewers: Path) -> None:
    """Write a script with all that it imports, minified."""
    entry = path.with_suffix(".entry.js")
    entry.write_text(script)
    command = [ESBUILD_PROGRAM, entry, "--bundle", "--minify", "--format=esm", f"--outfile={path}"]
    command.append(f"--alias:hyrf.js={DECODER_FOLDER}")
    subprocess.run(
        [str(word) for word in [*command, "--log-level=error"]],
        env={**os.environ, "NODE_PATH": str((viewers / "node_modules").resolve())},
        check=True,
    )


def decode_png(data: bytes) -> np.ndarray:
    """Return (H, W, 3) in [0, 1]."""
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float32) / 255


def find_times(frames: list[tuple[float, bytes]], opened: float) -> tuple[float, float]:
    """Return the seconds from `opened` to the first picture and to the complete one, from a recording of the screen."""
    pictures = [(moment - opened, decode_png(data)) for moment, data in frames if moment > opened]
    final = pictures[-1][1]
    if not final.std():
        raise HyrfError("the page stayed blank", fix="look for errors in the console of a browser")
    detail = FIRST_PICTURE_DETAIL * final.std()
    first = next(moment for moment, picture in pictures if picture.std() >= detail)
    complete = pictures[-1][0]
    for moment, picture in reversed(pictures):
        if psnr(picture, final) < SAME_PICTURE_DB:
            break
        complete = moment
    return first, complete


def visit(site: Site, folder: Path, viewer: Viewer, reference: np.ndarray) -> tuple[Measurement, bytes]:
    """Measure one visit of a viewer's page in a new browser; return it and the picture as a PNG."""
    with Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS) as browser, browser.before_every_page(OBSERVER_SCRIPT):
        browser.resize(*WINDOW_SIZE)
        site.fetched.clear()
        with browser.record_screen() as frames:
            opened = time.time()
            browser.open(f"{site.address}/{viewer.address}")
            while (
                not frames
                or time.time() - max(opened, frames[-1][0]) < STILL_SECONDS
                or not browser.evaluate(viewer.is_final)
            ):
                if time.time() - opened > PAGE_TIMEOUT_SECONDS:
                    problem = f"{viewer.name}: the picture was not complete after {PAGE_TIMEOUT_SECONDS:.0f} s"
                    raise HyrfError(problem, fix="measure a smaller model")
                time.sleep(0.2)
            first, complete = find_times(list(frames), opened)
        if errors := browser.list_errors():
            raise HyrfError(f"{viewer.name}: the page reported {errors}", fix="check the version of the viewer")
        picture = browser.screenshot()
        starts_and_ms = browser.evaluate("window.longTasks")
        tasks = [ms for start, ms in starts_and_ms if start < opened + complete]
        heap = browser.collect_garbage()
        browser.evaluate(viewer.prepare)
        frame_ms = measure_frame_cpu_ms(browser)
    scripts = {path for path in site.fetched if path.suffix in SCRIPT_SUFFIXES and path.is_file()}
    return Measurement(
        script_bytes=sum(len(gzip.compress(path.read_bytes())) for path in scripts),
        scene_bytes=(folder / viewer.scene_file).stat().st_size,
        first_seconds=first,
        complete_seconds=complete,
        frame_cpu_ms=frame_ms,
        long_tasks=len(tasks),
        longest_task_ms=max(tasks, default=0.0),
        heap_mb=heap / 1e6,
        psnr_db=psnr(decode_png(picture), reference),
    ), picture


def measure_frame_cpu_ms(browser: Chromium) -> float:
    """Return the CPU milliseconds of the browser for each frame that is drawn while a mouse orbits."""
    x, y = WINDOW_SIZE[0] / 2, WINDOW_SIZE[1] / 2
    browser.button_down(x, y)
    first_frame, cpu = browser.evaluate("drawnFrames"), browser.cpu_seconds()
    orbit_with_mouse(browser, x, y)
    frames, cpu = browser.evaluate("drawnFrames") - first_frame, browser.cpu_seconds() - cpu
    browser.button_up(x, y)
    return 1000 * cpu / max(1, frames)


def choose_pose(model: Path) -> Pose:
    """Return the pose of the model's first camera, made level in the file's axes."""
    capture = Capture(hyrfpack.describe_file(model))
    camera = capture.cameras[0]
    depth = np.linalg.norm(camera.position - capture.viewpoint.center)
    return Pose(camera.position, camera.position + depth * camera.rotation[2])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", help=".hyrf files")
    parser.add_argument("--viewers", type=Path, required=True, help="folder in which npm has installed the viewers")
    parser.add_argument("--repeats", type=positive_integer, default=3, help="number of visits of each page (3)")
    parser.add_argument("--pictures", type=Path, help="folder for the pictures of the viewers")
    arguments = parser.parse_args()
    columns = [field.name.replace("_", " ") for field in fields(Measurement)]
    rows = []
    for model in arguments.models:
        pose = choose_pose(model)
        loaded = hyrfpack.load_model(model)
        reference = hyrfpack.render_view(loaded, pose.to_camera(*WINDOW_SIZE), EXACT_SETTINGS).rgb.clamp(0, 1).numpy()
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            viewers = write_site(folder, model, arguments.viewers, pose)
            visits: dict[str, list[Measurement]] = {viewer.name: [] for viewer in viewers}
            site = Site(folder)
            with site.run():
                for _ in range(arguments.repeats):
                    for viewer in viewers:
                        measured, picture = visit(site, folder, viewer, reference)
                        visits[viewer.name].append(measured)
                        if arguments.pictures:
                            arguments.pictures.mkdir(parents=True, exist_ok=True)
                            (arguments.pictures / f"{model.stem}-{viewer.name}.png").write_bytes(picture)
        for viewer_name, measurements in visits.items():
            medians = [
                statistics.median(getattr(measured, field.name) for measured in measurements)
                for field in fields(Measurement)
            ]
            rows.append([f"{len(loaded):,}", viewer_name, *(format_cell(value) for value in medians)])
            print(markdown_row(rows[-1]), flush=True)
    print(markdown_table(["Gaussians", "viewer", *columns], rows))


if __name__ == "__main__":
    run_command(main)
