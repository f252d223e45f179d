"""Read NeRF-synthetic datasets: transforms_{train,val,test}.json beside folders of RGBA renders."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from hyrfpack.data.assemble import PosedPhoto, assemble_scene, missing_photos_notes
from hyrfpack.data.names import PictureIndex
from hyrfpack.data.pictures import read_header
from hyrfpack.data.transforms import frame_lens, pose_from_opengl, read_transforms
from hyrfpack.scene import Scene


def read_blender(path: Path, *, test_every: int, max_size: int) -> Scene:
    """Read a Blender-style dataset. World coordinates are those of the files (z up), and pictures keep straight alpha.

    The dataset's own split is used: train, and test (val if there is no test). `test_every` applies only if there is
    neither. `max_size` is that of `load_scene`.

    Raises:
        HyrfDataError: a file is missing or cannot be used.
    """
    notes: list[str] = []
    photos = _read_split(path, "train", notes)
    held_out = next((split for split in ("test", "val") if (path / f"transforms_{split}.json").is_file()), None)
    test_names = None
    if held_out is None:
        notes.append("there is no transforms_test.json or transforms_val.json")
    else:
        test = _read_split(path, held_out, notes)
        test_names = {photo.name for photo in test}
        photos += test
        if held_out == "val":
            notes.append("there is no transforms_test.json; the photos of transforms_val.json are held out")
    tables = [path / f"transforms_{split}.json" for split in ("train", held_out) if split is not None]
    return assemble_scene(
        path,
        "blender",
        photos,
        test_every=test_every,
        max_size=max_size,
        test_names=test_names,
        tables=tables,
        masks=path / "masks",
        notes=notes,
    )


def _read_split(path: Path, split: str, notes: list[str]) -> list[PosedPhoto]:
    """Read the photos of one transforms file."""
    file = path / f"transforms_{split}.json"
    content = read_transforms(file)
    photos: list[PosedPhoto] = []
    missing: list[str] = []
    index = PictureIndex(path)
    matches = index.match(frame["file_path"] for frame in content["frames"])
    for frame in content["frames"]:
        picture = matches.found.get(frame["file_path"])
        if picture is None:
            missing.append(str(PurePosixPath(frame["file_path"])))
            continue
        header = read_header(picture)
        lens = frame_lens(content, frame, header, file)
        name = index.photo_name(picture, frame["file_path"])
        photos.append(PosedPhoto(name, picture, header, lens, pose_from_opengl(frame, file)))
    notes += matches.notes
    notes += missing_photos_notes(path, photos, missing, file.name, matches.ambiguous)
    return photos
