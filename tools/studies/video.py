"""Makes a video from a set's photos, with blurred and repeated frames put in, and looks at which of them are chosen.

    python -m tools.studies.video                                     choosing alone, on three sets
    python -m tools.studies.video --sets ngp_fox --train              poses and training as well, beside the photos

Photos are shown in the order of their names. After every photo comes a copy of it, blurred by motion of a random
direction and length, or a repeated one, or neither. With --train the poses of the photos and of the frames are both
estimated (`hyrfpack.estimate_poses`), and both trained; both are scored on held-out photos, as they were before they
were frames.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

import hyrfpack
from hyrfpack.data.pictures import PhotoFile
from hyrfpack.data.undistort import undistort
from hyrfpack.poses.frames import RECORD_NAME, FrameReport, choose_frames
from hyrfpack.scene import Picture, View
from hyrfpack.train import TrainConfig
from tools.studies.train_sets import DATA
from tools.tables import markdown_table

SETS = ("ngp_fox", "drone_caliterra", "gerrard_hall")
RATE = 10  # frames a second


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="*", default=list(SETS), help=f"folders below --data ({' '.join(SETS)})")
    parser.add_argument("--data", type=Path, default=DATA, help="where the sets are")
    parser.add_argument("--out", type=Path, default=Path("runs/video"), help="folder for results (runs/video)")
    parser.add_argument("--lengths", type=float, nargs=2, default=(3.0, 10.0), help="of the blur, in pixels (3 10)")
    parser.add_argument("--quality", type=int, default=18, help="H.264's constant rate factor (18)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--train", action="store_true", help="go on to poses and training")
    parser.add_argument("--steps", type=int, default=1000, help="of training (1,000)")
    args = parser.parse_args()
    rows = []
    for name in args.sets:
        out = args.out / name
        photos = sorted((args.data / name / "images").iterdir())
        kinds = write_video(out / "clip.mp4", photos, args.lengths, args.quality, args.seed)
        began = time.perf_counter()
        report = choose_frames(out / "clip.mp4", out / "frames")
        rows.append(row(name, kinds, out / "frames", report, time.perf_counter() - began))
        if args.train:
            given = score(args.data / name / "images", out / "photos", args.steps)
            shows = dict(enumerate(photos[number] for number in np.cumsum([kind == "photo" for kind in kinds]) - 1))
            taken = score(out / "clip.mp4", out / "video", args.steps, shows)
            rows[-1] += [f"{given:.2f}", f"{taken:.2f}", f"{taken - given:+.2f}"]
    header = ["set", "frames", "photos taken", "blurred taken", "repeated taken", "called blurred", "repeated", "s"]
    print(markdown_table(header + (["dB, photos", "dB, video", "difference"] if args.train else []), rows))


def write_video(path: Path, photos: list[Path], lengths: tuple[float, float], quality: int, seed: int) -> list[str]:
    """Encode the photos with frames put in; returns the kind of each frame: photo, blurred or repeated."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    first = Image.open(photos[0])
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE)
        stream.width, stream.height = (side // 2 * 2 for side in first.size)
        stream.pix_fmt, stream.options = "yuv420p", {"crf": str(quality)}
        kinds = []
        for kind, pixels in shown(photos, lengths, np.random.default_rng(seed)):
            kinds.append(kind)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels[: stream.height, : stream.width]), "rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return kinds


def shown(
    photos: list[Path], lengths: tuple[float, float], generator: np.random.Generator
) -> Iterator[tuple[str, np.ndarray]]:
    """What the video shows, frame by frame."""
    for photo in photos:
        pixels = np.asarray(Image.open(photo).convert("RGB"))
        yield "photo", pixels
        chance = generator.random()
        if chance < 1 / 3:
            yield "blurred", moved(pixels, generator.uniform(*lengths), generator.uniform(0, np.pi))
        elif chance < 2 / 3:
            for _ in range(generator.integers(1, 3)):
                yield "repeated", pixels


def moved(pixels: np.ndarray, length: float, angle: float) -> np.ndarray:
    """A picture blurred along a line, its middle where it was."""
    blurred = np.zeros(pixels.shape, np.float32)
    places = np.linspace(-(length - 1) / 2, (length - 1) / 2, max(2, round(2 * length)))
    for place in places:
        offset = (place * np.sin(angle), place * np.cos(angle), 0)
        blurred += ndimage.shift(pixels.astype(np.float32), offset, order=1, mode="nearest")
    return (blurred / len(places)).round().astype(np.uint8)


def row(name: str, kinds: list[str], folder: Path, report: FrameReport, seconds: float) -> list[str]:
    """One line of the table: a repeated frame taken instead of its photo counts as the photo."""
    taken = json.loads((folder / RECORD_NAME).read_text())["frames"]
    numbers = np.cumsum([kind == "photo" for kind in kinds])  # of the photo that each frame shows
    blurred = [number for number in taken if kinds[number] == "blurred"]
    seen = [numbers[number] for number in taken if kinds[number] != "blurred"]
    counts = {kind: kinds.count(kind) for kind in ("photo", "blurred", "repeated")}
    return [
        name,
        f"{report.of}",
        f"{len(set(seen))} of {counts['photo']}",
        f"{len(blurred)} of {counts['blurred']}",
        f"{len(seen) - len(set(seen))} of {counts['repeated']}",
        f"{report.blurred}",
        f"{report.repeated}",
        f"{seconds:.1f}",
    ]


def score(source: Path, out: Path, steps: int, shows: dict[int, Path] | None = None) -> float:
    """Held-out PSNR of a training run on estimated poses; `shows` has the photo that each frame of a video was."""
    hyrfpack.estimate_poses(source, out / "scene", overwrite=True, say=print)
    scene = hyrfpack.load_scene(out / "scene")
    if shows is not None:
        scene = dataclasses.replace(scene, test=[_of_photo(view, shows) for view in scene.test])
    result = hyrfpack.train_model(scene, out / "run", TrainConfig(steps=steps, budget_factor=1.0), overwrite=True)
    return result.metrics["evaluation"]["psnr"]


def _of_photo(view: View, shows: dict[int, Path]) -> View:
    """A view of a frame with the pixels of its photo, which has a row or a column more where its size is odd."""
    photo = shows[int(Path(view.name).stem.rpartition("_")[2])]

    def load() -> Picture:
        frame = view.load
        assert isinstance(frame, PhotoFile)
        width, height = frame.stored
        rgb = np.asarray(Image.open(photo).convert("RGB"))[:height, :width]
        picture = Picture(np.ascontiguousarray(rgb))
        return undistort(picture, frame.lens) if frame.lens.is_distorted else picture

    return dataclasses.replace(view, load=load)


if __name__ == "__main__":
    main()
