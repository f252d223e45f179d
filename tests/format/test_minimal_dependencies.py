"""Files can be read and rendered with only torch, numpy and their dependencies installed."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.integration

PROJECT_FOLDER = Path(__file__).parents[2]
GOLDEN_PATHS = sorted((PROJECT_FOLDER / "tests" / "golden").glob("*.hyrf"))

# This code runs in this process and in an isolated one.
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
ISOLATED_SCRIPT = """
import sys
from importlib.machinery import PathFinder

class Bare:
    def find_spec(name, path=None, target=None):
        return None if name.partition(".")[0] in {refused!r} else PathFinder.find_spec(name, path, target)

sys.meta_path = [Bare if finder is PathFinder else finder for finder in sys.meta_path]
sys.path.insert(0, {root!r})
{pictures}
hyrfpack.load_model({files!r}[0])
print(*sys.modules)
np.savez({out!r}, **{{path: picture(path) for path in {files!r}}})
print(*sys.modules)
"""


def required_distributions(*roots: str) -> set[str]:
    """Return the names of distributions and of everything that they require."""
    found, waiting = set(), list(roots)
    while waiting:
        name = re.match(r"[\w.-]+", waiting.pop())[0].lower().replace("_", "-")
        if name not in found:
            found.add(name)
            try:
                waiting += [line for line in metadata.requires(name) or () if "extra ==" not in line]
            except metadata.PackageNotFoundError:
                continue  # is required on another platform only
    return found


@pytest.fixture(scope="module")
def isolated_run(tmp_path_factory) -> tuple[dict[str, np.ndarray], set[str]]:
    """Render golden files without all other packages; return the pictures and the modules that reading imports."""
    allowed = {*required_distributions("torch", "numpy"), "hyrfpack"}
    refused = {
        module
        for module, names in metadata.packages_distributions().items()
        if not allowed & {name.lower().replace("_", "-") for name in names}
    }
    assert refused >= {"scipy", "PIL", "numba", "dahuffman", "click", "rich", "pytest"}
    out, files = str(tmp_path_factory.mktemp("alone") / "pictures.npz"), [str(path) for path in GOLDEN_PATHS]
    script = ISOLATED_SCRIPT.format(
        refused=refused, root=str(PROJECT_FOLDER), pictures=RENDER_CODE, out=out, files=files
    )

    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr
    to_read, to_draw = (set(line.split()) for line in done.stdout.splitlines())
    assert not refused & {name.partition(".")[0] for name in to_draw}
    with np.load(out) as pictures:
        return dict(pictures), to_read


@pytest.mark.parametrize("path", GOLDEN_PATHS, ids=lambda path: path.stem)
def test_golden_files_render_the_same_with_torch_and_numpy_alone(path, isolated_run):
    here: dict = {}
    exec(RENDER_CODE, here)

    expected = here["picture"](str(path))

    assert np.ptp(expected) > 0.05  # the picture is not uniform
    np.testing.assert_allclose(isolated_run[0][str(path)], expected, rtol=0, atol=2e-3)


def test_loading_a_file_does_not_import_the_compiler_of_torch(isolated_run):
    assert "torch" in isolated_run[1] and "torch._dynamo" not in isolated_run[1]
