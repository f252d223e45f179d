"""Estimate the poses of data sets with known poses, and print how many are correct for each mapper.

    python -m tools.studies.poses                                   every COLMAP set below ../shared/data
    python -m tools.studies.poses --sets ngp_fox llff_fern --out runs/fox
    python -m tools.studies.poses --data scenes/generated           every COLMAP set below another folder

The estimation only gets the photos. Both sets of poses are first aligned by a robust similarity transform. A pose is
correct if its position is then within 2 % of the cameras' extent from the known one, and its rotation within 5 degrees.
The first table has numbers of photos and the choice between the mappers. The second has errors of the poses (median and
largest, in degrees and in % of the cameras' extent), and CPU and wall seconds of each stage. The study prints each row
as JSON first. The scenes are kept in --out for training.

The results are in docs/research/poses.md.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pycolmap

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.poses import estimate
from hyrfpack.poses.alignment import Poses, align_poses
from hyrfpack.poses.job import Job
from hyrfpack.poses.mapping import read_pieces
from hyrfpack.poses.process import run_stage
from tools.command import run_command
from tools.cpu_time import children_cpu_seconds
from tools.studies.train_sets import DATA_FOLDER, choose_names
from tools.tables import markdown_table

STAGE_NAMES = ("features", "matches", "global", "incremental", "repeat", "finish")


def read_poses(model: pycolmap.Reconstruction, job: Job | None = None) -> Poses:
    """Return (3, 4) camera_from_world by the photo's name without ending; `job` has the names for a mapper's model."""
    posed = (image for image in model.images.values() if image.has_pose)
    poses = {}
    for image in posed:
        name = image.name if job is None else job.names[image.image_id - 1]
        poses[name.rpartition(".")[0]] = np.asarray(image.cam_from_world().matrix())
    return poses


def measure(folder: Path, out: Path, seed: int) -> dict:
    """Estimate the poses of one data set; compare them, and those of each mapper alone, with the known poses."""
    known = read_poses(pycolmap.Reconstruction(folder / "sparse" / "0"))
    mapper_results: dict[str, str] = {}
    cpu_seconds: dict[str, float] = {}
    remove_tree = shutil.rmtree

    def measure_stage(job: Path, stage: str, *arguments: Any) -> dict[str, Any]:
        """Run a stage and keep its CPU seconds."""
        before = children_cpu_seconds()
        try:
            return run_stage(job, stage, *arguments)
        finally:
            cpu_seconds[stage] = round(children_cpu_seconds() - before, 1)

    def inspect_before_removal(path: Path, **options: Any) -> None:
        """Read the mappers' models before the estimation removes its work folder."""
        if Path(path) == out / ".poses" and (out / "poses.json").exists() and Path(path).is_dir():
            job = Job.load(out / ".poses" / "job.json")
            for mapper in ("global", "incremental"):
                runs = []
                for model in sorted(Path(path).glob(f"{mapper}*/")):
                    pieces = [read_poses(piece, job) for piece in read_pieces(model)]
                    correct = [
                        f"{len(align_poses(piece, known).agreeing)} of {len(piece)}"
                        for piece in pieces
                        if len(piece) > 2
                    ]
                    runs.append(" + ".join(correct) or "none")
                mapper_results[mapper] = "; ".join(runs)
        remove_tree(path, **options)

    with mock.patch.object(shutil, "rmtree", inspect_before_removal):
        with mock.patch.object(estimate, "run_stage", measure_stage):
            report = hyrfpack.estimate_poses(folder / "images", out, hyrfpack.PosesConfig(seed=seed), overwrite=True)
    estimated = read_poses(pycolmap.Reconstruction(out / "sparse" / "0"))
    aligned = align_poses(estimated, known)
    return {
        "set": folder.name,
        "photos": len(known),
        "registered": report.registered,
        "right": len(aligned.agreeing),
        "sure": report.sure,
        "angles": [float(np.median(aligned.angle)), float(np.max(aligned.angle))],
        "distances": [float(np.median(aligned.distance)), float(np.max(aligned.distance))],
        "seconds": sum(report.seconds.values()),
        "stage_seconds": report.seconds,
        "cpu_seconds": cpu_seconds,
        "mapper": report.mapper,
        "why": report.why.rpartition(": ")[2],
        "alone": mapper_results,
        "notes": report.notes,
    }


def format_table(rows: list[dict]) -> str:
    """Format the rows as a Markdown table."""
    header = ["set", "photos", "registered", "right", "sure", "s", "mapper", "why"]
    header += ["right of registered, by run and piece: global", "incremental"]
    table_rows = []
    for row in rows:
        if "error" in row:
            table_rows.append([row["set"], row["photos"], "0", "0", "0", "", "none", row["error"], "", ""])
            continue
        cells = [row[key] for key in ("set", "photos", "registered", "right", "sure")]
        cells += [f"{row['seconds']:.0f}", row["mapper"], row["why"], row["alone"].get("global", "none")]
        table_rows.append([*cells, row["alone"].get("incremental", "none")])
    return markdown_table(header, [[str(cell) for cell in line] for line in table_rows])


def format_error_table(rows: list[dict]) -> str:
    """Format errors of the poses and the seconds of each stage as a Markdown table."""
    header = ["set", "rotation error, degrees", "position error, %", "CPU s", "wall s"]
    header += [f"{stage}: CPU s (wall s)" for stage in STAGE_NAMES]
    table_rows = []
    for row in rows:
        if "error" in row:
            continue
        cells = [row["set"], "{:.4f}, {:.4f}".format(*row["angles"])]
        cells += ["{:.4f}, {:.4f}".format(*(100 * distance for distance in row["distances"]))]
        cells += [f"{sum(row['cpu_seconds'].values()):.0f}", f"{row['seconds']:.0f}"]
        for stage in STAGE_NAMES:
            used, passed = row["cpu_seconds"].get(stage), row["stage_seconds"].get(stage)
            cells.append("" if used is None else f"{used:.0f} ({passed:.0f})")
        table_rows.append(cells)
    return markdown_table(header, table_rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="*", help="COLMAP sets below --data (all)")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument("--out", type=Path, default=Path("runs/poses"), help="folder for the scenes (runs/poses)")
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    arguments = parser.parse_args()
    posed = sorted(path.parent.parent.name for path in arguments.data.glob("*/sparse/0"))
    fix = "name COLMAP sets with `sets`, and their folder with `data`"
    names = choose_names(arguments.sets, posed, f"{arguments.data}: there are no known poses (sparse/0)", fix)
    rows = []
    for name in names:
        try:
            rows.append(measure(arguments.data / name, arguments.out / name, arguments.seed))
        except HyrfError as error:
            known = read_poses(pycolmap.Reconstruction(arguments.data / name / "sparse" / "0"))
            rows.append({"set": name, "photos": len(known), "error": str(error)})
        print(json.dumps(rows[-1]), flush=True)
    print(format_table(rows))
    print()
    print(format_error_table(rows))


if __name__ == "__main__":
    run_command(main)
