"""What worked before a fork works in the child; multiprocessing and PyTorch's DataLoader fork on Linux."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")

# The parent calls every function. Then a new child calls each of them, and is killed if it hangs.
FORK_SCRIPT = """
import json, sys, warnings
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
import numpy as np, torch
import hyrfpack
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.cameras.capture import provenance_cameras
from scenes import ball_scene, small_model

warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
torch.set_num_threads(4)  # as on a machine with cores to spare
scene = ball_scene(8, side=24)
scene = replace(scene, test=scene.train[:2])
model = small_model(np.random.default_rng(0).normal(size=(6_000, 3)) * 0.3, fields=1.0, scale_logits=-6.0)
cameras = provenance_cameras([view.camera for view in scene.train])
hyrfpack.save_model(model, "model.hyrf", provenance={"cameras": cameras})
write_demo_scene(Path("demo"), views=4, size=16)

def load_scene():
    return hyrfpack.load_scene("demo").train[0].load().rgb.tobytes()

def load():
    return hyrfpack.load_model("model.hyrf").gaussians.positions.detach().numpy().tobytes()

def save():
    hyrfpack.save_model(hyrfpack.load_model("model.hyrf"), "saved.hyrf", "raw")
    return Path("saved.hyrf").read_bytes()

def render():
    with torch.no_grad():
        return hyrfpack.render_view(model, scene.test[0].camera, decoded=model.decode()).rgb.numpy().tobytes()

def evaluate():
    return str(hyrfpack.evaluate_model(model, scene.test, pictures="views").psnr).encode()

def train():
    return hyrfpack.train_model(scene, "run", hyrfpack.TrainConfig(steps=3), overwrite=True).model.read_bytes()

def compress():
    hyrfpack.compress_model("model.hyrf", "compact.hyrf", hyrfpack.CompressConfig(finetune_steps=2), data=scene)
    return Path("compact.hyrf").read_bytes()

def export():
    hyrfpack.export_model("model.hyrf", "model.spz", hyrfpack.ExportConfig(degree=1))
    return Path("model.spz").read_bytes()

def send_result(function, sender):
    sender.send(function())

fork, outcome = get_context("fork"), {}
functions = [load_scene, load, save, render, evaluate, train, compress, export]
before = [function() for function in functions]
for function, expected in zip(functions, before):
    receiver, sender = fork.Pipe(duplex=False)
    child = fork.Process(target=send_result, args=(function, sender))
    child.start()
    sender.close()
    receiver.poll(60) or child.kill()
    try:
        outcome[function.__name__] = receiver.recv() == expected
    except EOFError:
        outcome[function.__name__] = False
    child.join()
print(json.dumps(outcome))
"""


@pytest.fixture(scope="module")
def outcome(tmp_path_factory) -> dict[str, bool]:
    """For each function, whether a forked child returned the same as its parent."""
    tests = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (tests.parent, tests)))}
    command, folder = [sys.executable, "-c", FORK_SCRIPT], tmp_path_factory.mktemp("fork")
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    "function", ["load_scene", "load", "save", "render", "evaluate", "train", "compress", "export"]
)
def test_a_forked_child_gets_what_its_parent_got(function, outcome):
    assert outcome[function]
