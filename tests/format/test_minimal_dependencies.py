"""Files can be read and rendered after `pip install --no-deps hyrfpack`, with torch, numpy and their dependencies."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from distributions import build_distribution, copy_repository, make_environment, run_in_environment

import hyrfpack

pytestmark = [
    pytest.mark.acceptance,
    pytest.mark.skipif(sys.platform == "win32", reason="links to packages need administrator rights"),
]

GOLDEN_PATHS = sorted((Path(__file__).parents[1] / "golden").glob("*.hyrf"))

# This code runs in this process and in the minimal environment.
RENDER_CODE = """
import numpy as np
import hyrfpack
from hyrfpack.format import decode_model

def picture(path):
    facts = hyrfpack.describe_file(path)
    pose = np.eye(4)
    pose[:3, 3] = -np.array(facts["config"]["frame"]["center"])
    pose[2, 3] += 2 * facts["config"]["frame"]["scale"]
    model, data = hyrfpack.load_model(path), open(path, "rb").read()
    assert len(model) == len(decode_model(data)) == facts["gaussians"]
    return hyrfpack.render_view(model, hyrfpack.Camera(16, 12, 20.0, 20.0, 8.0, 6.0, pose)).rgb.numpy()
"""
MINIMAL_SCRIPT = """
import sys
{pictures}
hyrfpack.load_model({files!r}[0])
print(*sys.modules)
np.savez({out!r}, **{{path: picture(path) for path in {files!r}}})
"""
PUBLIC_NAMES_SCRIPT = """
import hyrfpack
for name in hyrfpack.__all__:
    try:
        getattr(hyrfpack, name)
    except hyrfpack.HyrfError as error:
        print(error)
    else:
        print(name)
"""


@pytest.fixture(scope="module")
def minimal_python(tmp_path_factory) -> Path:
    """The Python of an environment with torch, numpy and the wheel of hyrfpack without what it requires."""
    folder = tmp_path_factory.mktemp("minimal")
    wheel = build_distribution("wheel", copy_repository(folder / "source"), folder)
    return make_environment(folder / "environment", wheel, "torch", "numpy")


@pytest.fixture(scope="module")
def minimal_run(minimal_python, tmp_path_factory) -> tuple[dict[str, np.ndarray], set[str]]:
    """Render golden files in that environment; return the pictures and the modules that reading a file imports."""
    out, files = str(tmp_path_factory.mktemp("alone") / "pictures.npz"), [str(path) for path in GOLDEN_PATHS]

    done = run_in_environment(minimal_python, "-c", MINIMAL_SCRIPT.format(pictures=RENDER_CODE, out=out, files=files))

    assert done.returncode == 0, done.stderr
    with np.load(out) as pictures:
        return dict(pictures), set(done.stdout.split())


def test_the_environment_lacks_the_other_packages(minimal_python):
    installed = run_in_environment(
        minimal_python, "-c", "import importlib.metadata as m; print(*m.packages_distributions())"
    )
    assert not set(installed.stdout.split()) & {"scipy", "PIL", "numba", "dahuffman", "click", "rich", "pytest"}


@pytest.mark.parametrize("path", GOLDEN_PATHS, ids=lambda path: path.stem)
def test_golden_files_render_the_same_with_torch_and_numpy_alone(path, minimal_run):
    here: dict = {}
    exec(RENDER_CODE, here)

    expected = here["picture"](str(path))

    assert np.ptp(expected) > 0.05  # the picture is not uniform
    np.testing.assert_allclose(minimal_run[0][str(path)], expected, rtol=0, atol=2e-3)


def test_loading_a_file_does_not_import_the_compiler_of_torch(minimal_run):
    assert "torch" in minimal_run[1] and "torch._dynamo" not in minimal_run[1]


def test_every_public_name_is_there_or_says_what_to_install(minimal_python):
    done = run_in_environment(minimal_python, "-c", PUBLIC_NAMES_SCRIPT)
    lines = dict(zip(hyrfpack.__all__, done.stdout.splitlines(), strict=True))
    available = {"load_model", "save_model", "describe_file", "render_view", "load_scene", "HybridModel", "Camera"}
    assert available <= {name for name, line in lines.items() if line == name}
    for name, line in lines.items():
        assert line == name or line.startswith(f"hyrfpack.{name} needs ") and "; run 'pip install " in line


@pytest.mark.parametrize("command", [["-m", "hyrfpack"], ["../bin/hyrfpack"]], ids=["module", "script"])
def test_the_command_line_says_what_to_install(minimal_python, command):
    done = run_in_environment(minimal_python, *command, "info", GOLDEN_PATHS[0])
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "Error: the command line needs click; run 'pip install click'\n"
