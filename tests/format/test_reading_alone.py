"""Files are read and rendered where nothing is installed but torch, numpy and what these ask for."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "tests" / "golden").glob("*.hyrf"))

# Run here and in an interpreter of its own.
PICTURES = """
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
ALONE = """
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


def required(*roots: str) -> set[str]:
    """The distributions, and all that they ask for."""
    found, waiting = set(), list(roots)
    while waiting:
        name = re.match(r"[\w.-]+", waiting.pop())[0].lower().replace("_", "-")
        if name not in found:
            found.add(name)
            try:
                waiting += [line for line in metadata.requires(name) or () if "extra ==" not in line]
            except metadata.PackageNotFoundError:
                continue  # for another platform
    return found


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> tuple[dict[str, np.ndarray], set[str]]:
    """Pictures of the golden files, drawn where all other packages are missing, and the modules that reading loads."""
    allowed = {*required("torch", "numpy"), "hyrfpack"}
    refused = {
        module
        for module, names in metadata.packages_distributions().items()
        if not allowed & {name.lower().replace("_", "-") for name in names}
    }
    assert refused >= {"scipy", "PIL", "numba", "dahuffman", "click", "rich", "pytest"}
    out, files = str(tmp_path_factory.mktemp("alone") / "pictures.npz"), [str(path) for path in FILES]
    script = ALONE.format(refused=refused, root=str(ROOT), pictures=PICTURES, out=out, files=files)

    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr
    to_read, to_draw = (set(line.split()) for line in done.stdout.splitlines())
    assert not refused & {name.partition(".")[0] for name in to_draw}
    with np.load(out) as pictures:
        return dict(pictures), to_read


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_golden_files_look_the_same_with_torch_and_numpy_alone(path, alone):
    here: dict = {}
    exec(PICTURES, here)

    expected = here["picture"](str(path))

    assert np.ptp(expected) > 0.05  # there is something to see
    np.testing.assert_allclose(alone[0][str(path)], expected, rtol=0, atol=2e-3)


def test_torchs_compiler_is_not_loaded_which_takes_longer_than_a_file(alone):
    assert "torch" in alone[1] and "torch._dynamo" not in alone[1]
