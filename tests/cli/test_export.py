"""`hyrfpack export` and `hyrfpack view` on the command line."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from commands import hyrfpack, refused, succeeded
from explicit_balls import ball_splats
from exposures import random_map
from scenes import ring, small_model

from hyrfpack.cameras.capture import provenance_cameras, scene_provenance
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.cli import main
from hyrfpack.data import load_scene
from hyrfpack.format import save_model
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.formats import ply, sog
from hyrfpack.web import view as web_view

GOLDEN_SCENE_FOLDER = Path(__file__).parents[1] / "golden" / "scene"
GAUSSIAN_POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Forty Gaussians in front of a background sphere, and four cameras around them."""
    path, cameras = tmp_path_factory.mktemp("models") / "model.hyrf", ring(4)
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(small_model(GAUSSIAN_POSITIONS, fields=2.0, background=True), path, provenance=kept)
    return path


@pytest.fixture
def photographed_model(data, tmp_path):
    """The same Gaussians, with the cameras of the photos of `data`."""
    path = tmp_path / "photographed.hyrf"
    trained_on = scene_provenance(load_scene(data))
    save_model(small_model(GAUSSIAN_POSITIONS, fields=2.0, background=True), path, provenance=trained_on)
    return path


def test_export_reports_its_steps_and_the_loss(model, tmp_path):
    result = succeeded("export", model, "-o", tmp_path / "a.ply", "--sh-degree", 3)
    size, splats = (tmp_path / "a.ply").stat().st_size, read_splats(tmp_path / "a.ply")
    rows = re.findall(r"^(baked to .*|read back from .*?) +(\d+\.\d\d)$", result.stdout, re.MULTILINE)
    names = ["baked to harmonics of degree 3, before writing", "read back from the .ply file"]
    assert [name.rstrip() for name, _ in rows] == names
    assert result.stdout.splitlines()[0].split("  ")[0] == "against renders of the model, 4 views"
    assert "colours were fitted at these views" in result.stdout
    last = f"{tmp_path / 'a.ply'}: {size:,} bytes, {len(splats):,} Gaussians, {len(splats) - 40:,} of them for the"
    assert result.stdout.splitlines()[-1] == f"{last} background"
    notes = [line for line in result.stderr.splitlines() if not line.startswith("export | ")]  # progress of a slow call
    assert [line.split()[0] for line in notes] == ["fitting", "writing", "measuring"]


def test_the_report_is_one_json_object(model, tmp_path):
    arguments = ("export", model, "-o", tmp_path / "a.splat", "--no-background", "--json")
    report = json.loads(succeeded(*arguments).stdout, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert report["file"] == str(tmp_path / "a.splat") and report["bytes"] == (tmp_path / "a.splat").stat().st_size
    assert (report["gaussians"], report["background"], report["degree"], report["views"]) == (40, 0, 0, 4)
    assert min(report["psnr_baked"], report["psnr"]) > 20
    assert report["photos_model"] is report["photos_file"] is None


def test_identical_pictures_are_json_too(tmp_path):
    provenance = {"cameras": provenance_cameras(ring(1))}
    save_model(small_model([[0, 0, 0]], opacity_logits=-80.0), tmp_path / "unseen.hyrf", provenance=provenance)
    report = json.loads(succeeded("export", tmp_path / "unseen.hyrf", "-o", tmp_path / "a.ply", "--json").stdout)
    assert report["psnr"] == report["psnr_baked"] == report["chosen_by"]["3"] == 100


def test_given_photos_are_scored(photographed_model, data, tmp_path):
    arguments = (
        "export",
        photographed_model,
        "-o",
        tmp_path / "a.ply",
        "--overwrite",
        "--sh-degree",
        0,
        "--data",
        data,
    )
    last = succeeded(*arguments).stdout.splitlines()[-1]
    form = r"PSNR against held-out photos: model \d+\.\d{3} dB, file \d+\.\d{3} dB"
    assert re.fullmatch(form, last)
    assert json.loads(succeeded(*arguments, "--test-every", 0, "--json").stdout)["photos_model"] is None


def test_both_exposures_are_printed_and_the_one_in_the_file_is_marked(data, tmp_path):
    mapped = small_model(GAUSSIAN_POSITIONS)
    mapped.exposure = random_map(0, centers=4)
    save_model(mapped, tmp_path / "mapped.hyrf", provenance=scene_provenance(load_scene(data)))
    arguments = ("export", tmp_path / "mapped.hyrf", "-o", tmp_path / "a.ply", "--overwrite", "--sh-degree", 1)
    printed = succeeded(*arguments, "--exposure", "consistent").stdout
    report = json.loads(succeeded(*arguments, "--json").stdout)
    assert report["exposure"] == "local" and report["photos_by_exposure"] == {}
    rows = dict(re.findall(r"^(local|consistent \(in the file\)) +(\d+\.\d\d)$", printed, re.MULTILINE))
    local, consistent = (f"{report['psnr_by_exposure'][word]:.2f}" for word in ("local", "consistent"))
    assert rows == {"local": local, "consistent (in the file)": consistent} and local != consistent
    scored = succeeded(*arguments, "--data", data).stdout
    assert re.search(r"^local \(in the file\) +\d+\.\d\d +\d+\.\d\d$", scored, re.MULTILINE)


def test_options_choose_what_is_written(model, tmp_path):
    arguments = ("export", model, "--crop", "-10,-10,-10,10,10,0", "--sh-degree", 1, "--min-opacity", "0.01")
    result = succeeded(*arguments, "-o", tmp_path / "a.spz")
    back = read_splats(tmp_path / "a.spz")
    assert len(back) == (GAUSSIAN_POSITIONS[:, 2] <= 0).sum() and back.degree == 1
    assert result.stdout.count("\n") == 1 and "quality is not measured" in result.stderr


def test_cameras_and_points_are_counted(model, tmp_path):
    assert succeeded("export", model, "-o", tmp_path / "a.json").stdout.endswith(" bytes, 4 cameras\n")
    assert succeeded("export", model, "-o", tmp_path / "a.points.ply").stdout.endswith(" 40 Gaussians, 4 cameras\n")
    assert succeeded("export", model, "-o", tmp_path / "colmap", "--colmap").stdout.endswith(" bytes, 4 cameras\n")


def test_a_note_says_that_held_out_cameras_are_not_written(data, tmp_path):
    scene = load_scene(data)
    model = tmp_path / "model.hyrf"
    save_model(small_model(GAUSSIAN_POSITIONS), model, provenance=scene_provenance(scene))
    result = succeeded("export", model, "-o", tmp_path / "a.json", "--data", data)
    written = len(json.loads((tmp_path / "a.json").read_text())["frames"])
    assert (written, len(scene.test)) == (len(scene.train), 2)
    assert f"the cameras of 2 held-out photos are not written, only those of {written} training photos" in result.stderr
    every = succeeded("export", model, "-o", tmp_path / "b.json", "--data", data, "--test-every", 0)
    assert "held-out" not in every.stderr


def test_one_thing_is_named_in_the_singular(tmp_path):
    kept = {"cameras": provenance_cameras(ring(1))}
    save_model(small_model(GAUSSIAN_POSITIONS[:1]), tmp_path / "one.hyrf", provenance=kept)
    exported = succeeded("export", tmp_path / "one.hyrf", "-o", tmp_path / "a.json").stdout
    assert exported.endswith(" bytes, 1 camera\n")
    rendered = succeeded("render", tmp_path / "one.hyrf", "-o", tmp_path / "out", "--orbit", 1).stdout
    assert ": 1 picture, " in rendered
    assert " bytes, 1 Gaussian\n" in succeeded("info", tmp_path / "one.hyrf").stdout


def test_the_degree_is_chosen_and_the_choice_is_reported(model, tmp_path):
    result = succeeded("export", model, "-o", tmp_path / "a.ply")
    assert [line.split()[0] for line in result.stderr.splitlines()] == [
        *("choosing", "chosen", "fitting", "writing", "measuring")
    ]
    (degree,) = re.findall(
        r"^chosen degree (\d): .* against the model for degrees 0 to 3$", result.stderr, re.MULTILINE
    )
    assert read_splats(tmp_path / "a.ply").degree == int(degree) and f"harmonics of degree {degree}," in result.stdout


def test_a_page_embeds_the_model_unless_it_is_baked(model, tmp_path):
    for name, options in (("a.html", ()), ("b.html", ("--baked", "--sh-degree", "0"))):
        succeeded("export", model, "-o", tmp_path / name, *options)
    native, baked = ((tmp_path / name).read_bytes() for name in ("a.html", "b.html"))
    assert base64.b64encode(model.read_bytes()[:300]) in native
    assert base64.b64encode(model.read_bytes()[:300]) not in baked and b'"kind": "splats"' in baked
    result = succeeded("export", model, "-o", tmp_path / "a.html", "--overwrite")
    size = (tmp_path / "a.html").stat().st_size
    assert result.stdout == f"{tmp_path / 'a.html'}: {size:,} bytes, 40 Gaussians, unchanged: nothing is baked\n"
    assert "is copied unchanged" in result.stderr


@pytest.mark.parametrize("command", ["decompress", "export"])
def test_a_chunk_of_the_scene_that_is_read_is_never_replaced(tmp_path, command):
    folder = Path(shutil.copytree(GOLDEN_SCENE_FOLDER, tmp_path / "scene"))
    name = {"decompress": "shared.hyrf", "export": "scene.json"}[command]

    assert "input itself" in refused(command, folder, "-o", folder / name, "--overwrite")
    assert (folder / name).read_bytes() == (GOLDEN_SCENE_FOLDER / name).read_bytes()


def test_folders_are_players_and_galleries(model, photographed_model, data, tmp_path):
    succeeded("export", "-o", tmp_path / "empty")
    succeeded("export", model, "-o", tmp_path / "player")
    report = json.loads(succeeded("export", model, model, "-o", tmp_path / "gallery", "--json").stdout)
    assert (report["gaussians"], report["native"]) == (80, True)
    assert {path.name for path in (tmp_path / "player").iterdir()} >= {"index.html", "scene.hyrf", "poster.jpg"}
    assert not (tmp_path / "empty" / "scene.hyrf").exists()
    assert {path.name for path in (tmp_path / "gallery").iterdir()} >= {"player.html", "model.hyrf", "model-2.hyrf"}
    options = ("-o", tmp_path / "scored", "--data", data, "--data", data)
    succeeded("export", photographed_model, photographed_model, *options)
    assert (tmp_path / "scored" / "index.html").read_text().count(" dB on ") == 2
    assert "--overwrite" in refused("export", model, "-o", tmp_path / "player")
    succeeded("export", model, "-o", tmp_path / "player", "--overwrite")


WRONG_REQUESTS = {
    "no output": ((), "Missing option '-o'"),
    "ending": (("-o", "a.xyz"), "the file extension does not name a known format"),
    "no name": (("-o", ""), "is not a file name"),
    "standard output": (("-o", "-"), "is not a file name"),
    "too long a name": (("-o", "a" * 260 + ".ply"), "longer than 255 bytes"),
    "degree": (("-o", "a.ply", "--sh-degree", "4"), "'--sh-degree'"),
    "NaN": (("-o", "a.ply", "--crop", "0,0,0,1,nan,1"), "is not a box"),
    "few numbers": (("-o", "a.ply", "--crop", "0,0,0,1"), "is not a box"),
    "words": (("-o", "a.ply", "--crop", "a,b,c,d,e,f"), "is not a box"),
    "inside out": (("-o", "a.ply", "--crop", "1,0,0,0,1,1"), "a minimum above its maximum"),
    "nothing inside": (("-o", "a.ply", "--crop", "7,7,7,8,8,8"), "; move or widen --crop, or lower --min-opacity"),
    "too faint": (("-o", "a.ply", "--min-opacity", "1"), "; lower --min-opacity"),
    "opacity": (("-o", "a.ply", "--min-opacity", "2"), "'--min-opacity'"),
    "NaN opacity": (("-o", "a.ply", "--min-opacity", "nan"), "nan is not allowed"),
    "crop of cameras": (("-o", "a.json", "--crop", "0,0,0,1,1,1"), "only cameras"),
    "degree of cameras": (("-o", "a.json", "--sh-degree", "0"), "no spherical harmonics; leave out --sh-degree"),
    "degree of COLMAP": (("-o", "out", "--colmap", "--sh-degree", "2"), "no spherical harmonics; leave out"),
    "degree of points": (("-o", "a.points.glb", "--sh-degree", "2"), "no spherical harmonics; leave out"),
    "degree of a mesh": (("-o", "a.obj", "--sh-degree", "2"), "no spherical harmonics; leave out"),
    "exposure of cameras": (("-o", "a.json", "--exposure", "consistent"), "leave out --exposure consistent"),
    "colours of physics": (("-o", "a.collision.glb", "--exposure", "consistent"), "leave out --exposure consistent"),
    "no photos": (("-o", "a.ply", "--data", "none"), "none"),
    "degree of a model": (("-o", "a.html", "--sh-degree", "1"), "--baked"),
    "crop of a player": (("-o", "player", "--crop", "0,0,0,1,1,1"), "--baked"),
    "exposure": (("-o", "a.ply", "--exposure", "even"), "'--exposure'"),
    "exposure of a model": (("-o", "a.html", "--exposure", "consistent"), "leave out --exposure consistent, or"),
    "baked player": (("-o", "player", "--baked"), "--baked"),
    "COLMAP file": (("-o", "a.ply", "--colmap"), "this format is a folder of files"),
    "levels of a file": (("-o", "out", "--streamed-sog"), "split it first with 'hyrfpack split"),
    "two folders": (("-o", "out", "--colmap", "--streamed-sog"), "give only one of --colmap and --streamed-sog"),
    "crop of levels": (("-o", "out", "--streamed-sog", "--min-opacity", "0.1"), "leave out --crop and --min-opacity"),
    "version of a PLY": (("-o", "a.ply", "--spz-version", "3"), "leave out --spz-version, or write an .spz"),
    "contents of no tiles": (("-o", "a.ply", "--tile-content", "gltf"), "leave out --tile-content, or write a folder"),
    "two models": (("second.hyrf", "-o", "a.ply"), "several models make a gallery"),
    "photos of two": (("-o", "player", "--data", "a", "--data", "b"), "given 2 times for 1 model;"),
}


@pytest.mark.parametrize("what", WRONG_REQUESTS)
def test_invalid_requests_are_a_clear_error_and_leave_no_file(what, model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, words = WRONG_REQUESTS[what]
    assert words in refused("export", model, *arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["export", "view"])
def test_models_that_cannot_be_read_are_a_clear_error(command, model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = bytearray(model.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged.hyrf").write_bytes(data)
    (tmp_path / "short.hyrf").write_bytes(data[:100])
    (tmp_path / "photo.hyrf").write_bytes(b"\x89PNG")
    (tmp_path / "empty.ply").touch()
    names = (
        ("damaged.hyrf",) if command == "export" else ("empty.ply", "none.ply")
    )  # the page itself reports a damaged model
    options = ("-o", "a.ply") if command == "export" else ("--no-browser",)
    for name in (*names, "short.hyrf", "photo.hyrf", "none.hyrf", "."):
        assert name in refused(command, name, *options)
    assert not (tmp_path / "a.ply").exists()


def test_a_file_without_a_model_is_a_clear_error(tmp_path):
    assert "no MODEL" in refused("export", "-o", tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_help_names_every_ending():
    from hyrfpack.export.kinds import EXPORT_ENDINGS

    printed = succeeded("export", "--help").stdout
    assert all(re.search(rf"{re.escape(ending)}\b", printed) for ending in EXPORT_ENDINGS)
    assert "export" in succeeded("--help").stdout and "view" in succeeded("--help").stdout


# -- view ------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("ending", [".hyrf", ".ply"])
def test_view_serves_the_player_and_the_file_at_a_free_port_until_ctrl_c(ending, model, tmp_path):
    file = model
    if ending != ".hyrf":
        file = tmp_path / "cloud.ply"
        succeeded("export", model, "-o", file, "--sh-degree", 0)
    command = [sys.executable, "-m", "hyrfpack", "view", str(file), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().strip()
            assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", address)
            with urllib.request.urlopen(address, timeout=10) as answer:
                page = answer.read()
            asked = urllib.request.Request(f"{address}scene{ending}", headers={"Range": "bytes=8-99"})
            with urllib.request.urlopen(asked, timeout=10) as answer:
                status, part = answer.status, answer.read()
        finally:
            os.kill(process.pid, signal.SIGINT)
        said, messages = process.communicate(timeout=20)
    assert page.startswith(b"<!DOCTYPE html>") and f"<title>{file.stem}</title>".encode() in page
    assert (status, part) == (206, file.read_bytes()[8:100])
    assert (process.returncode, said) == (0, "") and "Traceback" not in messages


@pytest.mark.parametrize("ending", [".hyrf", ".ply"])
def test_view_decodes_nothing_and_loads_no_torch(ending, model, tmp_path):
    file = model
    if ending != ".hyrf":
        file = tmp_path / "cloud.ply"
        file.write_bytes(ply.encode(ball_splats(20)))
    program = (
        "import sys, hyrfpack.web.view as v; v.serve = lambda page, files, **more: print(len(page), list(files));"
        f"v.view({str(file)!r}, open_browser=False, on_ready=print); print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.endswith(f"['scene{ending}']\nFalse\n")


POSITIONS_HEADER = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACES_HEADER = "element face 1\nproperty list uchar int vertex_indices\n"


@pytest.mark.parametrize("elements", ["", FACES_HEADER], ids=["points", "mesh"])
def test_view_rejects_a_ply_without_gaussians(elements, tmp_path, monkeypatch):
    monkeypatch.setattr(web_view, "serve", None)
    file = tmp_path / "points.ply"
    file.write_text(f"{POSITIONS_HEADER}{elements}end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    sentence = refused("view", file, "--no-browser")
    assert sentence.startswith(f"Error: {file}: this PLY file holds no Gaussians, because its vertices have no f_dc_0,")


@pytest.mark.parametrize("ending", ["", "/scene.json", ".zip"])
def test_view_serves_the_files_of_a_scene_folder_as_they_are(ending, tmp_path, monkeypatch):
    folder = tmp_path / "city"
    shutil.copytree(GOLDEN_SCENE_FOLDER, folder)
    shutil.make_archive(str(folder), "zip", folder)
    served = {}
    monkeypatch.setattr(web_view, "serve", lambda page, files, **more: served.update(page=page, files=files))

    web_view.view(f"{folder}{ending}", open_browser=False, on_ready=print)

    for name in (file.name for file in folder.iterdir()):
        found = served["files"].pop(f"scene/{name}")
        data = found.read_bytes() if isinstance(found, Path) else found.open()[0].read()
        expected = (folder / name).read_bytes()
        assert json.loads(data) == json.loads(expected) if name == "scene.json" else data == expected
    assert not served["files"] and b"scene/scene.json" in served["page"]


def test_view_of_a_zipped_scene_reads_a_file_when_it_is_requested(tmp_path, monkeypatch):
    shutil.make_archive(str(tmp_path / "city"), "zip", GOLDEN_SCENE_FOLDER)
    served, read = {}, []
    read_file = web_view.SceneFolder.read_file
    monkeypatch.setattr(web_view, "serve", lambda page, files, **more: served.update(files))
    monkeypatch.setattr(
        web_view.SceneFolder, "read_file", lambda scene, item: read.append(item.file) or read_file(scene, item)
    )

    web_view.view(tmp_path / "city.zip", open_browser=False, on_ready=print)

    assert read == []
    file, length, tag = served["scene/shared.hyrf"].open()
    assert read == ["shared.hyrf"] and len(file.read()) == length and tag.startswith('"')


def test_view_names_a_missing_file_of_a_scene_folder(tmp_path):
    folder = tmp_path / "city"
    shutil.copytree(GOLDEN_SCENE_FOLDER, folder)
    (folder / "shared.hyrf").unlink()
    assert "shared.hyrf: this file of the scene is missing" in refused("view", folder, "--no-browser")


def test_view_rejects_a_port_in_use_and_no_port(model):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"port {port} of 127.0.0.1 is taken" in refused("view", model, "--port", port, "--no-browser")
    assert hyrfpack("view", model, "--port", 70000).exit_code == 2


def test_view_rejects_an_invalid_address(model):
    assert "not an address to listen at" in refused("view", model, "--host", "", "--no-browser")


def test_view_opens_the_browser_where_it_says(model, monkeypatch):
    opened = []
    monkeypatch.setattr("hyrfpack.web.serve.webbrowser.open", opened.append)
    monkeypatch.setattr("hyrfpack.web.serve.ThreadingHTTPServer.serve_forever", lambda server: None)
    result = CliRunner().invoke(main, ["view", str(model)])
    assert result.exit_code == 0 and opened == [result.stdout.strip()]


def test_the_current_folder_of_a_sog_is_named_in_the_command_that_imports_it(tmp_path, monkeypatch):
    folder = tmp_path / "room"
    folder.mkdir()
    for name, data in sog.encode_files(ball_splats(20)).items():
        (folder / name).write_bytes(data)
    monkeypatch.chdir(folder)
    assert "hyrfpack import . -o room.hyrf" in refused("export", ".", "-o", tmp_path / "x.html")
    assert "hyrfpack import . -o room.hyrf" in refused("edit", ".", "--plan", "--min-opacity", 0.1)
