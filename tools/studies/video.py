"""Measure the choice of video frames: make a video of photos with blurred and repeated frames, and choose from it.

    python -m tools.studies.video                                     only the choice, on three data sets
    python -m tools.studies.video --sets ngp_fox --train              also poses and training, compared with the photos

The photos are in the order of their names. After a photo come a motion-blurred copy of random direction and length, or
one or two repeated frames, or neither. The table has the numbers of chosen frames of each kind and seconds. With
--train it also estimates poses (`hyrfpack.estimate_poses`) and trains, on the photos and on the frames. The table then
has PSNR in dB on the same held-out photos with their original pixels: every 8th photo that has a pose in both cases.

The results are in docs/research/sharpness.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

import hyrfpack
from hyrfpack.data.pictures import PhotoFile
from hyrfpack.data.undistort import undistort
from hyrfpack.errors import HyrfError
from hyrfpack.poses.frames import RECORD_NAME, FrameReport, choose_frames
from hyrfpack.scene import Picture, Scene, View
from hyrfpack.train import TrainConfig
from tools.command import positive_integer, run_command
from tools.studies.complete_run import train_completely
from tools.studies.train_sets import DATA_FOLDER
from tools.tables import print_measured_table

DEFAULT_SETS = ("ngp_fox", "drone_caliterra", "gerrard_hall")
FRAMES_PER_SECOND = 10
HELD_OUT_EVERY = 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--sets",
        nargs="*",
        default=list(DEFAULT_SETS),
        help=f"data sets: folders below --data ({' '.join(DEFAULT_SETS)})",
    )
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument("--out", type=Path, default=Path("runs/video"), help="folder for results (runs/video)")
    parser.add_argument(
        "--lengths", type=float, nargs=2, default=(3.0, 10.0), help="shortest and longest blur in pixels (3 10)"
    )
    parser.add_argument("--quality", type=int, default=18, help="H.264's constant rate factor (18)")
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    parser.add_argument("--train", action="store_true", help="also estimate poses and train")
    parser.add_argument("--steps", type=positive_integer, default=1000, help="training steps (1,000)")
    args = parser.parse_args()
    header = ["set", "frames", "photos taken", "blurred taken", "repeated taken", "called blurred", "repeated", "s"]
    header += ["dB, photos", "dB, video", "difference"] if args.train else []

    def measure(name: str) -> Iterator[list[str]]:
        out = args.out / name
        if not (args.data / name / "images").is_dir():
            raise HyrfError(f"{args.data / name}: there is no folder images", fix="name the data sets with `data`")
        photos = sorted((args.data / name / "images").iterdir())
        kinds = write_video(out / "clip.mp4", photos, args.lengths, args.quality, args.seed)
        started = time.perf_counter()
        report = choose_frames(out / "clip.mp4", out / "frames")
        row = format_row(name, kinds, out / "frames", report, time.perf_counter() - started)
        if args.train:
            photo_by_frame = dict(
                enumerate(photos[number] for number in np.cumsum([kind == "photo" for kind in kinds]) - 1)
            )
            images, clip = args.data / name / "images", out / "clip.mp4"
            row += compare_training(images, clip, out, args.steps, photo_by_frame)
        yield row

    print_measured_table(header, args.sets, measure)


def write_video(path: Path, photos: list[Path], lengths: tuple[float, float], quality: int, seed: int) -> list[str]:
    """Encode the photos and the inserted frames; return the kind of each frame: photo, blurred or repeated."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    first = Image.open(photos[0])
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FRAMES_PER_SECOND)
        stream.width, stream.height = (side // 2 * 2 for side in first.size)
        stream.pix_fmt, stream.options = "yuv420p", {"crf": str(quality)}
        kinds = []
        for kind, pixels in make_frames(photos, lengths, np.random.default_rng(seed)):
            kinds.append(kind)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels[: stream.height, : stream.width]), "rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return kinds


def make_frames(
    photos: list[Path], lengths: tuple[float, float], generator: np.random.Generator
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the kind and the pixels of each frame of the video."""
    for photo in photos:
        pixels = np.asarray(Image.open(photo).convert("RGB"))
        yield "photo", pixels
        chance = generator.random()
        if chance < 1 / 3:
            yield "blurred", blur_by_motion(pixels, generator.uniform(*lengths), generator.uniform(0, np.pi))
        elif chance < 2 / 3:
            for _ in range(generator.integers(1, 3)):
                yield "repeated", pixels


def blur_by_motion(pixels: np.ndarray, length: float, angle: float) -> np.ndarray:
    """Blur a picture along a line that is `length` pixels long and centred on each pixel."""
    blurred = np.zeros(pixels.shape, np.float32)
    offsets = np.linspace(-(length - 1) / 2, (length - 1) / 2, max(2, round(2 * length)))
    for distance in offsets:
        offset = (distance * np.sin(angle), distance * np.cos(angle), 0)
        blurred += ndimage.shift(pixels.astype(np.float32), offset, order=1, mode="nearest")
    return (blurred / len(offsets)).round().astype(np.uint8)


def format_row(name: str, kinds: list[str], folder: Path, report: FrameReport, seconds: float) -> list[str]:
    """Format one row of the table; a repeated frame that is chosen instead of its photo counts as the photo."""
    chosen = json.loads((folder / RECORD_NAME).read_text())["frames"]
    numbers = np.cumsum([kind == "photo" for kind in kinds])  # the number of the photo that each frame shows
    blurred = [number for number in chosen if kinds[number] == "blurred"]
    chosen_photos = [numbers[number] for number in chosen if kinds[number] != "blurred"]
    counts = {kind: kinds.count(kind) for kind in ("photo", "blurred", "repeated")}
    return [
        name,
        f"{report.of}",
        f"{len(set(chosen_photos))} of {counts['photo']}",
        f"{len(blurred)} of {counts['blurred']}",
        f"{len(chosen_photos) - len(set(chosen_photos))} of {counts['repeated']}",
        f"{report.blurred}",
        f"{report.repeated}",
        f"{seconds:.1f}",
    ]


def find_photos(scene: Scene, photo_by_frame: Mapping[int, Path] | None = None) -> dict[str, str]:
    """Return the name without ending of the photo that each view shows, by the view's name.

    `photo_by_frame` has the photo of each frame if the scene comes from a video.
    """
    if photo_by_frame is None:
        return {view.name: Path(view.name).stem for view in scene.train + scene.test}
    return {view.name: photo_by_frame[_frame_number(view)].stem for view in scene.train + scene.test}


def hold_out(scene: Scene, photo_by_view: Mapping[str, str], held_out: Sequence[str]) -> Scene:
    """Return the scene with one test view of each held-out photo, and with no other view of these photos.

    Args:
        scene: the scene.
        photo_by_view: the photo that each view shows.
        held_out: the held-out photos.
    """
    views = sorted(scene.train + scene.test, key=lambda view: view.name)
    test = {photo_by_view[view.name]: view for view in reversed(views) if photo_by_view[view.name] in held_out}
    train = [view for view in views if photo_by_view[view.name] not in held_out]
    return dataclasses.replace(scene, train=train, test=sorted(test.values(), key=lambda view: view.name))


def train_and_score(scene: Scene, out: Path, steps: int) -> float:
    """Train on a scene; return PSNR in dB on its held-out photos."""
    result = train_completely(scene, out / "run", TrainConfig(steps=steps, budget_factor=1.0))
    return result.metrics["evaluation"]["psnr"]


def compare_training(photos: Path, video: Path, out: Path, steps: int, photo_by_frame: Mapping[int, Path]) -> list[str]:
    """Train on photos and on a video of them; return PSNR in dB of both on the same photos, and the difference.

    `photo_by_frame` has the photo of each frame of the video, whose pixels replace those of held-out frames.
    """
    scenes = {}
    for kind, source in (("photos", photos), ("video", video)):
        hyrfpack.estimate_poses(source, out / kind / "scene", overwrite=True)
        scenes[kind] = hyrfpack.load_scene(out / kind / "scene")
    photos_by_kind = {"photos": find_photos(scenes["photos"]), "video": find_photos(scenes["video"], photo_by_frame)}
    held_out = sorted(set(photos_by_kind["photos"].values()) & set(photos_by_kind["video"].values()))[::HELD_OUT_EVERY]
    split = {kind: hold_out(scene, photos_by_kind[kind], held_out) for kind, scene in scenes.items()}
    test = [_replace_by_photo(view, photo_by_frame[_frame_number(view)]) for view in split["video"].test]
    split["video"] = dataclasses.replace(split["video"], test=test)
    given, chosen = (train_and_score(scene, out / kind, steps) for kind, scene in split.items())
    return [f"{given:.2f}", f"{chosen:.2f}", f"{chosen - given:+.2f}"]


def _frame_number(view: View) -> int:
    return int(Path(view.name).stem.rpartition("_")[2])


def _replace_by_photo(view: View, photo: Path) -> View:
    """Return a frame's view with the pixels of its photo, cropped to the frame's even size."""

    def load() -> Picture:
        frame = view.load
        assert isinstance(frame, PhotoFile)
        width, height = frame.stored
        rgb = np.asarray(Image.open(photo).convert("RGB"))[:height, :width]
        picture = Picture(np.ascontiguousarray(rgb))
        return undistort(picture, frame.lens) if frame.lens.is_distorted else picture

    return dataclasses.replace(view, load=load)


if __name__ == "__main__":
    run_command(main)
