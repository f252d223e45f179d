"""Finds the poses of sets whose poses are known, and prints one table: how many are right, and by which mapper.

    python -m tools.studies.poses                                   every COLMAP set below ../shared/data
    python -m tools.studies.poses --sets ngp_fox llff_fern --out runs/fox

Only the photos are given to the estimation. A photo is right if, after a robust similarity, it is within 2 % of the
extent of the set's own cameras and 5 degrees of its own pose there. The scenes stay in --out, to be trained on.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pycolmap

import hyrfpack
from hyrfpack.poses.alignment import Poses, align_poses
from hyrfpack.poses.job import Job
from hyrfpack.poses.mapping import read_pieces
from tools.tables import markdown_table

DATA = Path(os.environ.get("HYRFPACK_DATA") or Path(__file__).parents[3] / "shared" / "data")


def read_poses(model: pycolmap.Reconstruction, job: Job | None = None) -> Poses:
    """(3, 4) camera_from_world by the photo's name, its ending left out; of a mapper's own model, as `job` names it."""
    posed = (image for image in model.images.values() if image.has_pose)
    poses = {}
    for image in posed:
        name = image.name if job is None else job.names[image.image_id - 1]
        poses[name.rpartition(".")[0]] = np.asarray(image.cam_from_world().matrix())
    return poses


def measure(folder: Path, out: Path, seed: int) -> dict:
    """Estimate the poses of one set, and hold them and each mapper's own to the known ones."""
    known = read_poses(pycolmap.Reconstruction(folder / "sparse" / "0"))
    alone: dict[str, str] = {}
    remove = shutil.rmtree

    def look_first(path: Path, **options: bool) -> None:
        """What the mappers made is gone with the products in progress."""
        if Path(path) == out / ".poses" and (out / "poses.json").exists():
            job = Job.load(out / ".poses" / "job.json")
            for mapper in ("global", "incremental"):
                runs = []
                for model in sorted(Path(path).glob(f"{mapper}*/")):
                    pieces = [read_poses(piece, job) for piece in read_pieces(model)]
                    right = [
                        f"{len(align_poses(piece, known).agreeing)} of {len(piece)}"
                        for piece in pieces
                        if len(piece) > 2
                    ]
                    runs.append(" + ".join(right) or "none")
                alone[mapper] = "; ".join(runs)
        remove(path, **options)

    shutil.rmtree = look_first  # type: ignore[assignment]
    try:
        report = hyrfpack.estimate_poses(folder / "images", out, seed=seed, overwrite=True)
    finally:
        shutil.rmtree = remove
    found = read_poses(pycolmap.Reconstruction(out / "sparse" / "0"))
    return {
        "set": folder.name,
        "photos": len(known),
        "registered": report.registered,
        "right": len(align_poses(found, known).agreeing),
        "sure": report.sure,
        "seconds": sum(report.seconds.values()),
        "mapper": report.mapper,
        "why": report.why.rpartition(": ")[2],
        "alone": alone,
        "notes": report.notes,
    }


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    header = ["set", "photos", "registered", "right", "sure", "s", "mapper", "why"]
    header += ["right of registered, by run and piece: global", "incremental"]
    lines = []
    for row in rows:
        if "error" in row:
            lines.append([row["set"], row["photos"], "0", "0", "0", "", "none", row["error"], "", ""])
            continue
        cells = [row[key] for key in ("set", "photos", "registered", "right", "sure")]
        cells += [f"{row['seconds']:.0f}", row["mapper"], row["why"], row["alone"].get("global", "none")]
        lines.append([*cells, row["alone"].get("incremental", "none")])
    return markdown_table(header, [[str(cell) for cell in line] for line in lines])


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="*")
    parser.add_argument("--out", type=Path, default=Path("runs/poses"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    names = arguments.sets or sorted(path.parent.parent.name for path in DATA.glob("*/sparse/0"))
    rows = []
    for name in names:
        try:
            rows.append(measure(DATA / name, arguments.out / name, arguments.seed))
        except hyrfpack.HyrfError as error:
            known = read_poses(pycolmap.Reconstruction(DATA / name / "sparse" / "0"))
            rows.append({"set": name, "photos": len(known), "error": str(error)})
        print(json.dumps(rows[-1]), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
