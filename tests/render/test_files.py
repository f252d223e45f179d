from __future__ import annotations

import os
import stat
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import ball_points, ring, small_model

from hyrfpack.errors import HyrfError
from hyrfpack.render import render_view
from hyrfpack.render.files import render_files, save_picture, unique_stems
from hyrfpack.render.video import has_ffmpeg, write_video


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["b.JPG", "left/0001.png"], ["b", "left/0001"]),
        (["a.jpg", "a.png"], ["a.jpg", "a.png"]),
        (["a.jpg", "A.png"], ["a.jpg", "A.png"]),
        (["a.jpg", "A.jpg"], ["0000_a.jpg", "0001_A.jpg"]),
        (["frame.0001", "frame.0002"], ["frame.0001", "frame.0002"]),
        (["../../etc/passwd", "/abs/x.png", "..\\y.png"], ["etc/passwd", "abs/x", "y"]),
        (["", ".."], ["0000_view", "0001_view"]),
        (["same", "same"], ["0000_same", "0001_same"]),
        (["a\0b:c"], ["a_b_c"]),
    ],
)
def test_pictures_are_named_after_photos_and_written_only_into_the_folder(names, files):
    assert unique_stems(names) == files


def test_rendered_files_hold_the_rounded_render(tmp_path):
    points, _ = ball_points(60)
    model, camera = small_model(points, scale_logits=-2.0), ring(1)[0]
    (path,) = render_files(model, [("deep/down/a.jpg", camera)], tmp_path / "out")
    with torch.no_grad():
        expected = render_view(model, camera)
    assert path == tmp_path / "out" / "deep" / "down" / "a.png"
    saved = np.asarray(Image.open(path)).astype(np.float64)
    np.testing.assert_allclose(saved, 255 * expected.rgb.clamp(0, 1).numpy(), atol=0.501)


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(HyrfError, match="cannot be made"):
        save_picture(tmp_path / "file" / "a.png", Image.new("RGB", (2, 2)))


# -- video ------------------------------------------------------------------------------------------------------------


def install_fake_ffmpeg(folder, monkeypatch, body: str) -> None:
    """Put a Python program named ffmpeg first on the PATH."""
    script = folder / "bin" / "ffmpeg"
    script.parent.mkdir()
    (folder / "bin" / "program.py").write_text(f"import sys\n{body}\n")
    # A shebang line cannot name Python, whose folder may have a space in its name.
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script.parent}/program.py" "$@"\n')
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{script.parent}{os.pathsep}{os.environ['PATH']}")


@pytest.mark.integration
@pytest.mark.skipif(os.name == "nt", reason="needs executable scripts")
def test_video_gets_all_frames_in_order(tmp_path, monkeypatch):
    install_fake_ffmpeg(tmp_path, monkeypatch, "open(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())")
    frames = [tmp_path / name for name in ("b.png", "a.png")]
    for frame in frames:
        frame.write_bytes(frame.name.encode() * 40_000)
    write_video(frames, tmp_path / "video.mp4")
    assert (tmp_path / "video.mp4").read_bytes() == b"b.png" * 40_000 + b"a.png" * 40_000
    assert not list(tmp_path.glob(".*"))


@pytest.mark.integration
@pytest.mark.skipif(os.name == "nt", reason="needs executable scripts")
def test_an_error_of_ffmpeg_is_quoted_and_keeps_the_old_video(tmp_path, monkeypatch):
    body = "open(sys.argv[-1], 'wb').write(b'half')\nprint('no such encoder', file=sys.stderr)\nsys.exit(1)"
    install_fake_ffmpeg(tmp_path, monkeypatch, body)
    (tmp_path / "frame.png").write_bytes(bytes(3_000_000))
    (tmp_path / "video.mp4").write_bytes(b"old")
    with pytest.raises(HyrfError, match="no such encoder"):
        write_video([tmp_path / "frame.png"], tmp_path / "video.mp4")
    assert (tmp_path / "video.mp4").read_bytes() == b"old"
    assert not list(tmp_path.glob(".*"))


@pytest.mark.integration
@pytest.mark.skipif(os.name == "nt", reason="needs executable scripts")
def test_many_messages_of_ffmpeg_do_not_block_the_video(tmp_path, monkeypatch):
    body = "sys.stderr.write('message\\n' * 100_000)\nopen(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())"
    install_fake_ffmpeg(tmp_path, monkeypatch, body)
    (tmp_path / "frame.png").write_bytes(b"frame" * 100_000)
    write_video([tmp_path / "frame.png"], tmp_path / "video.mp4")
    assert (tmp_path / "video.mp4").read_bytes() == b"frame" * 100_000


@pytest.mark.integration
@pytest.mark.skipif(os.name == "nt", reason="needs executable scripts")
def test_without_overwrite_a_video_that_appears_meanwhile_is_kept(tmp_path, monkeypatch):
    video = tmp_path / "video.mp4"
    body = f"open({str(video)!r}, 'wb').write(b'foreign')\nopen(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())"
    install_fake_ffmpeg(tmp_path, monkeypatch, body)
    (tmp_path / "frame.png").write_bytes(b"frame")
    assert write_video([tmp_path / "frame.png"], video, overwrite=False) == tmp_path / "video-2.mp4"
    assert video.read_bytes() == b"foreign" and (tmp_path / "video-2.mp4").read_bytes() == b"frame"


@pytest.mark.integration
@pytest.mark.skipif(os.name == "nt", reason="needs executable scripts")
def test_colours_of_videos_are_converted_and_tagged_alike(tmp_path, monkeypatch):
    install_fake_ffmpeg(tmp_path, monkeypatch, "open(sys.argv[-1], 'w').write(' '.join(sys.argv))")
    (tmp_path / "frame.png").write_bytes(b"frame")
    words = write_video([tmp_path / "frame.png"], tmp_path / "video.mp4").read_text()
    assert "out_color_matrix=bt709" in words and "-colorspace bt709" in words


@pytest.mark.integration
@pytest.mark.skipif(not has_ffmpeg(), reason="needs ffmpeg")
def test_videos_show_the_colours_of_their_pictures(tmp_path):
    av = pytest.importorskip("av")
    colors = np.array([(200, 40, 40), (40, 180, 60), (50, 60, 200), (230, 200, 60)], np.uint8)
    picture = colors.repeat(320, axis=0)[None].repeat(720, axis=0)
    Image.fromarray(picture).save(tmp_path / "frame.png")
    with av.open(str(write_video([tmp_path / "frame.png"] * 3, tmp_path / "video.mp4"))) as video:
        shown = next(video.decode(video=0)).to_ndarray(format="rgb24")  # by the tags of the video
    assert np.abs(shown[360, 160::320].astype(int) - colors).max() <= 3


def test_a_video_without_ffmpeg_is_a_clear_error(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(HyrfError, match="no ffmpeg program"):
        write_video([tmp_path / "frame.png"], tmp_path / "video.mp4")


def test_a_video_without_frames_is_a_clear_error(tmp_path):
    with pytest.raises(HyrfError, match="there are no frames to make a video of; render at least one"):
        write_video([], tmp_path / "video.mp4")


@pytest.mark.integration
@pytest.mark.skipif(not has_ffmpeg(), reason="needs ffmpeg")
def test_frames_of_another_shape_are_fitted_into_a_video_without_distortion(tmp_path):
    av = pytest.importorskip("av")
    for name, width, height in (("wide", 201, 100), ("high", 100, 200)):
        Image.new("RGB", (width, height), "white").save(tmp_path / f"{name}.png")
    frames = [tmp_path / "wide.png", tmp_path / "high.png"]
    with av.open(str(write_video(frames, tmp_path / "video.mp4"))) as video:
        wide, high = (frame.to_ndarray(format="gray") > 128 for frame in video.decode(video=0))
    assert wide.shape == high.shape == (100, 202)
    assert wide[:, :201].mean() > 0.99 and wide[:, 201].mean() < 0.1
    columns = np.flatnonzero(high.mean(0) > 0.5)
    assert abs(len(columns) - 50) <= 2 and abs(columns.mean() - 100.5) <= 2 and high[:, columns[2:-2]].all()
