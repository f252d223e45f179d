"""`hyrfpack export` and `hyrfpack view`, called as a person would."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from click.testing import CliRunner
from commands import hyrfpack, refused, succeeded
from scenes import ring, small_model

from hyrfpack.cameras.capture import kept_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.cli import main
from hyrfpack.format import save
from hyrfpack.splats.files import read_splats

POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Forty Gaussians before a background sphere, and four cameras around them."""
    path, cameras = tmp_path_factory.mktemp("models") / "model.hyrf", ring(4)
    kept = {"cameras": kept_cameras(cameras), "viewpoint": Viewpoint.of(cameras).to_json()}
    save(small_model(POSITIONS, fields=2.0, background=True), path, provenance=kept)
    return path


def test_export_says_what_it_does_and_prints_what_was_lost(model, tmp_path):
    result = succeeded("export", model, "-o", tmp_path / "a.ply")
    size, splats = (tmp_path / "a.ply").stat().st_size, read_splats(tmp_path / "a.ply")
    rows = re.findall(r"^(degree \d|the file, degree \d) +(\d+\.\d\d)$", result.stdout, re.MULTILINE)
    assert [name for name, _ in rows] == ["degree 0", "degree 1", "degree 2", "degree 3", "the file, degree 3"]
    assert result.stdout.splitlines()[0].split("  ")[0] == "against the model, 4 views"
    last = f"{tmp_path / 'a.ply'}: {size:,} bytes, {len(splats):,} Gaussians, {len(splats) - 40:,} of them for the"
    assert result.stdout.splitlines()[-1] == f"{last} background"
    assert [line.split()[0] for line in result.stderr.splitlines()] == ["fitting", "writing", "measuring"]


def test_the_report_is_one_json_object(model, tmp_path):
    arguments = ("export", model, "-o", tmp_path / "a.splat", "--no-background", "--json")
    report = json.loads(succeeded(*arguments).stdout, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert report["file"] == str(tmp_path / "a.splat") and report["bytes"] == (tmp_path / "a.splat").stat().st_size
    assert (report["gaussians"], report["background"], report["degree"], report["views"]) == (40, 0, 0, 4)
    assert report["by_degree"].keys() == {"0"} and report["psnr"] > 20
    assert report["photos_model"] is report["photos_file"] is None


def test_identical_pictures_are_json_too(tmp_path):
    provenance = {"cameras": kept_cameras(ring(1))}
    save(small_model([[0, 0, 0]], opacity_logits=-80.0), tmp_path / "unseen.hyrf", provenance=provenance)
    report = json.loads(succeeded("export", tmp_path / "unseen.hyrf", "-o", tmp_path / "a.ply", "--json").stdout)
    assert report["psnr"] == report["by_degree"]["3"] == 100


def test_photos_are_scored_if_given(model, data, tmp_path):
    arguments = ("export", model, "-o", tmp_path / "a.ply", "--overwrite", "--sh-degree", 0, "--data", data)
    last = succeeded(*arguments).stdout.splitlines()[-1]
    assert re.fullmatch(r"held-out photos: PSNR \d+\.\d{3} to \d+\.\d{3} dB", last)
    assert json.loads(succeeded(*arguments, "--test-every", 0, "--json").stdout)["photos_model"] is None


def test_options_choose_what_is_written(model, tmp_path):
    arguments = ("export", model, "--crop", "-10,-10,-10,10,10,0", "--sh-degree", 1, "--min-opacity", "0.01")
    result = succeeded(*arguments, "-o", tmp_path / "a.spz")
    back = read_splats(tmp_path / "a.spz")
    assert len(back) == (POSITIONS[:, 2] <= 0).sum() and back.degree == 1
    assert result.stdout.count("\n") == 1 and "nothing is measured" in result.stderr


def test_cameras_and_points_are_counted(model, tmp_path):
    assert succeeded("export", model, "-o", tmp_path / "a.json").stdout.endswith(" bytes, 4 cameras\n")
    assert succeeded("export", model, "-o", tmp_path / "a.points.ply").stdout.endswith(" 40 Gaussians, 4 cameras\n")
    assert succeeded("export", model, "-o", tmp_path / "colmap").stdout.endswith(" bytes, 4 cameras\n")


WRONG = {
    "no output": ((), "Missing option '-o'"),
    "ending": (("-o", "a.xyz"), "the ending names the format"),
    "no name": (("-o", ""), "names no file"),
    "standard output": (("-o", "-"), "names no file"),
    "too long a name": (("-o", "a" * 260 + ".ply"), "longer than 255 bytes"),
    "degree": (("-o", "a.ply", "--sh-degree", "4"), "'--sh-degree'"),
    "NaN": (("-o", "a.ply", "--crop", "0,0,0,1,nan,1"), "is not a box"),
    "few numbers": (("-o", "a.ply", "--crop", "0,0,0,1"), "is not a box"),
    "words": (("-o", "a.ply", "--crop", "a,b,c,d,e,f"), "is not a box"),
    "inside out": (("-o", "a.ply", "--crop", "1,0,0,0,1,1"), "turned inside out"),
    "nothing inside": (("-o", "a.ply", "--crop", "7,7,7,8,8,8"), "no Gaussian is left"),
    "too faint": (("-o", "a.ply", "--min-opacity", "1"), "no Gaussian is left"),
    "opacity": (("-o", "a.ply", "--min-opacity", "2"), "'--min-opacity'"),
    "NaN opacity": (("-o", "a.ply", "--min-opacity", "nan"), "opacity of nan"),
    "crop of cameras": (("-o", "a.json", "--crop", "0,0,0,1,1,1"), "cameras only"),
    "no photos": (("-o", "a.ply", "--data", "none"), "none"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_requests_are_one_sentence_and_leave_no_file(what, model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, words = WRONG[what]
    assert words in refused("export", model, *arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["export", "view"])
def test_models_that_cannot_be_read_are_one_sentence(command, model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = bytearray(model.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged.hyrf").write_bytes(data)
    (tmp_path / "short.hyrf").write_bytes(data[:100])
    (tmp_path / "photo.hyrf").write_bytes(b"\x89PNG")
    options = ("-o", "a.ply") if command == "export" else ("--no-browser",)
    for name in ("damaged.hyrf", "short.hyrf", "photo.hyrf", "none.hyrf", "."):
        assert name in refused(command, name, *options)
    assert not (tmp_path / "a.ply").exists()


def test_help_names_every_ending():
    from hyrfpack.export.kinds import ENDINGS

    printed = succeeded("export", "--help").stdout
    assert all(re.search(rf"{re.escape(ending)}\b", printed) for ending in ENDINGS)
    assert "export" in succeeded("--help").stdout and "view" in succeeded("--help").stdout


# -- view ------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("signals")
def test_view_serves_the_page_at_a_free_port_until_ctrl_c(model):
    command = [sys.executable, "-m", "hyrfpack", "view", str(model), "--sh-degree", "0", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().strip()
            assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", address)
            with urllib.request.urlopen(address, timeout=10) as answer:
                page = answer.read()
        finally:
            os.kill(process.pid, signal.SIGINT)
        said, told = process.communicate(timeout=20)
    assert page.startswith(b"<!DOCTYPE html>") and b"<title>model" in page
    assert (process.returncode, said) == (0, "") and "Traceback" not in told


def test_view_refuses_a_port_in_use_and_no_port(model):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"port {port} of 127.0.0.1 is taken" in refused("view", model, "--port", port, "--no-browser")
    assert hyrfpack("view", model, "--port", 70000).exit_code == 2


def test_view_refuses_an_address_that_is_none(model):
    assert "not an address to listen at" in refused("view", model, "--host", "", "--no-browser")


def test_view_opens_the_browser_where_it_says(model, monkeypatch):
    opened = []
    monkeypatch.setattr("hyrfpack.web.serve.webbrowser.open", opened.append)
    monkeypatch.setattr("hyrfpack.web.serve.ThreadingHTTPServer.serve_forever", lambda server: None)
    result = CliRunner().invoke(main, ["view", str(model), "--sh-degree", "0"])
    assert result.exit_code == 0 and opened == [result.stdout.strip()]
