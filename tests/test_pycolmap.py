"""hyrfpack loads zlib before pycolmap, and SIGTERM ends the process as before.

pycolmap contains its own zlib. If the system's zlib is loaded after it, memory is corrupted and the process aborts.
All of these tests run in fresh interpreters, because an earlier import of zlib (as by some versions of numpy) would
hide the fault.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from scenes import BALL_CENTERS, ball_scene, small_model

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.format import save_model
from hyrfpack.rotations import quaternion_from_matrix

CHECK_IMPORT_ORDER_CODE = """
import sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "pycolmap":
            assert "zlib" in sys.modules, "zlib is imported after pycolmap"
            print("in order")
sys.meta_path.insert(0, Watch())
"""
# Loading a scene imports pycolmap.
READ_SCENE_CODE = "import hyrfpack\nscene = hyrfpack.load_scene('scene')\n"
CODE_BY_CALL = {
    "load_scene": "import zlib\nassert zlib.decompress(zlib.compress(bytes(10**6))) == bytes(10**6)",
    "train": "quiet = hyrfpack.RunContext(progress=None)\n"
    "assert hyrfpack.train_model(scene, 'run', hyrfpack.TrainConfig(steps=3), context=quiet).complete",
    "compress": "hyrfpack.compress_model('model.hyrf', 'a.hyrf', data=scene)",
    "evaluate, render, save": "model = hyrfpack.load_model('model.hyrf')\n"
    "hyrfpack.evaluate_model(model, scene.test, pictures='views')\n"
    "from hyrfpack.render.files import save_picture, to_image\nimport torch\nwith torch.no_grad():\n"
    "    picture = hyrfpack.render_view(model, scene.test[0].camera).rgb\n"
    "save_picture('a.png', to_image(picture))\n"
    "hyrfpack.save_model(hyrfpack.load_model('model.hyrf'), 'a.hyrf', provenance=hyrfpack.describe_file('model.hyrf'))",
    "export": "for name in ('a.spz', 'a.ply', 'a.sog', 'a.html'):\n"
    "    hyrfpack.export_model('model.hyrf', name, data=scene)\n"
    "hyrfpack.export_model('model.hyrf', 'colmap', hyrfpack.ExportConfig(colmap=True), data=scene)",
    "bench": "from hyrfpack.measure import timing\ntiming.WARM_UP_SECONDS = 0\n"
    "hyrfpack.benchmark_model('model.hyrf', scene, repeats=1, only=['codec'])",
    "imports": "hyrfpack.export_model('model.hyrf', 'a.ply', hyrfpack.ExportConfig(background=False), data=scene)\n"
    "hyrfpack.import_splats('a.ply', 'a.hyrf', hyrfpack.ImportConfig(10, size=16, views=4, test_views=2))",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a COLMAP set in text form and a model of it."""
    folder = tmp_path_factory.mktemp("colmap")
    scene = ball_scene(8, side=24)
    (folder / "scene" / "images").mkdir(parents=True)
    tables = folder / "scene" / "sparse" / "0"
    tables.mkdir(parents=True)
    images = []
    for number, view in enumerate(scene.train, start=1):
        quat, shift = quaternion_from_matrix(view.camera.rotation), view.camera.camera_from_world[:3, 3]
        images.append(" ".join(map(str, (number, *quat, *shift, 1, view.name))) + "\n\n")
        Image.fromarray(view.load().rgb).save(folder / "scene" / "images" / view.name)
    (tables / "cameras.txt").write_text("1 PINHOLE 24 24 24 24 12 12\n")
    (tables / "images.txt").write_text("".join(images))
    points = [(number, *point, 255, 128, 0, 0) for number, point in enumerate(scene.points, start=1)]
    (tables / "points3D.txt").write_text("".join(" ".join(map(str, point)) + "\n" for point in points))
    cameras = provenance_cameras([view.camera for view in scene.train])
    save_model(small_model(BALL_CENTERS, scale_logits=0.0), folder / "model.hyrf", provenance={"cameras": cameras})
    return folder


def run_in_new_interpreter(code: str, folder: Path) -> subprocess.CompletedProcess:
    """Run code in a new interpreter. The timeout is for one that aborts and hangs while doing so."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "TRITON_INTERPRET": "0"}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


def test_importing_hyrfpack_alone_loads_zlib(tmp_path):
    done = run_in_new_interpreter(
        "import sys; before = 'zlib' in sys.modules; import hyrfpack; print(before, 'zlib' in sys.modules)", tmp_path
    )
    assert done.stdout.split() == ["False", "True"], done.stderr


@pytest.fixture(scope="module")
def calls_outcome(folder) -> subprocess.CompletedProcess:
    """Run all calls in one interpreter; the first call that aborts ends it."""
    calls = "".join(f"{code}\nprint({name!r}, 'done', flush=True)\n" for name, code in CODE_BY_CALL.items())
    return run_in_new_interpreter(CHECK_IMPORT_ORDER_CODE + READ_SCENE_CODE + calls, folder)


@pytest.mark.parametrize("call", CODE_BY_CALL)
def test_zlib_is_loaded_before_pycolmap_and_no_call_aborts(call, calls_outcome):
    assert f"{call} done" in calls_outcome.stdout.splitlines(), calls_outcome.stderr
    assert "in order" in calls_outcome.stdout
    assert calls_outcome.returncode == 0 or call != list(CODE_BY_CALL)[-1], (
        calls_outcome.stderr
    )  # the interpreter does not abort at its exit either


def test_importing_pycolmap_before_hyrfpack_gives_a_warning(tmp_path):
    done = run_in_new_interpreter("import pycolmap, hyrfpack", tmp_path)
    assert ("import hyrfpack (or zlib) first" in done.stderr) == (sys.platform == "linux")
    assert "Warning" not in run_in_new_interpreter("import zlib, pycolmap, hyrfpack", tmp_path).stderr


@pytest.mark.skipif(os.name == "nt", reason="Windows has no handlers of SIGTERM")
@pytest.mark.parametrize("handler", ["", "signal.signal(signal.SIGTERM, lambda *_: print('asked to stop'))\n"])
def test_sigterm_has_no_handler_of_pycolmap(handler, folder):
    code = "import os, signal, sys\n" + handler + READ_SCENE_CODE
    code += "assert 'pycolmap' in sys.modules\nos.kill(os.getpid(), signal.SIGTERM)\n"
    done = run_in_new_interpreter(code, folder)
    assert done.stderr == ""
    expected = (0, "asked to stop\n") if handler else (-signal.SIGTERM, "")
    assert (done.returncode, done.stdout) == expected


@pytest.mark.skipif(os.name == "nt", reason="Windows has no handlers of SIGTERM")
def test_the_report_of_a_machine_leaves_no_handler_of_pycolmap(tmp_path):
    code = "import os, signal, sys, hyrfpack\nhyrfpack.diagnose_machine('cpu', self_test=False)\n"
    code += "assert 'pycolmap' in sys.modules\nos.kill(os.getpid(), signal.SIGTERM)\n"
    done = run_in_new_interpreter(code, tmp_path)
    assert (done.stderr, done.returncode) == ("", -signal.SIGTERM)
