"""Poses from photos, whole: prepare, match, map twice, choose, and keep what is done on the way."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.atomic import check_writable, make_folder, write_atomic
from hyrfpack.checks import check_choice, check_int
from hyrfpack.data.archive import is_archive, unpacked
from hyrfpack.data.equirectangular import FACES
from hyrfpack.data.folder import list_photos, list_pictures
from hyrfpack.data.quality import is_blurred
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.outputs import MODELS, PICTURES, POSES, TABLES, VIDEOS, StrPath
from hyrfpack.poses.frames import FrameReport, choose_frames
from hyrfpack.poses.job import Job
from hyrfpack.poses.made import REPORT, Made, files_of, read_report, remove, still_there
from hyrfpack.poses.pairs import EXHAUSTIVE_UP_TO, choose_matching
from hyrfpack.poses.prepare import devices_of, find_masks, in_order, look_at, make_images, make_masks
from hyrfpack.poses.process import Crashed, run_stage

MATCHING = ("auto", "exhaustive", "sequential", "retrieval")
LEAST = 3  # photos that poses can be found for
_VERSION = 2  # of what is kept on the way; older products are made anew
_SHARES = {"photos": 0.05, "features": 0.15, "matches": 0.45, "global": 0.1, "incremental": 0.2, "finish": 0.05}
_FEATURELESS = 60  # features of a typical photo, below which there is nothing to match
_BLANK = 0.1  # sharpness: what is blurred and shows something has more
_TURNED = 0.8  # of all pairs: a panorama
_FLAT = 2.0  # degrees between rays: less says that the camera hardly moved

Say = Callable[[str], None]
Report = Callable[[str, float], None]


@dataclass(frozen=True)
class PosesReport:
    """What came of an estimation.

    Attributes:
        scene: the folder, which `load_scene` reads.
        photos: how many there were.
        registered: how many have a pose.
        sure: how many of these both mappers pose the same, within 2 % of the scene's extent and 5 degrees.
        left_out: the reason for each photo without a pose.
        mapper: whose result was taken, "incremental" or "global".
        why: it was, in a sentence with the figures of both.
        notes: sentences on what is in doubt and what was done with the photos.
        seconds: by stage, of this call.
    """

    scene: Path
    photos: int
    registered: int
    sure: int
    left_out: dict[str, str]
    mapper: str
    why: str
    notes: tuple[str, ...]
    seconds: dict[str, float]


def estimate_poses(
    photos: StrPath,
    out: StrPath,
    *,
    matching: str = "auto",
    masks: StrPath | None = None,
    seed: int = 0,
    overwrite: bool = False,
    report: Report | None = None,
    say: Say | None = None,
) -> PosesReport:
    """Find where photos were taken, and make a scene of them that `load_scene` reads.

    Features are matched between photos and held to geometry; two mappers (incremental and global structure from motion)
    pose them, and the result that explains more of the matches is taken. The work is done in a process of its own. What
    is done is kept in `out`/.poses until all is, so that the same call goes on where an interrupted one was.

    Args:
        photos: a folder of photos (sub-folders are cameras of their own), a .zip of one, or a video.
        out: the scene's folder. It gets images/ (links to the photos, upright copies of those that a camera stored on
            their side), sparse/0 and poses.json. A folder whose photos are in images/ may be `photos` and `out` at
            once; its photos stay as they are.
        matching: "exhaustive" (all pairs), "sequential" (photos follow each other, and loops are looked for),
            "retrieval" (those that look alike); "auto" takes the first for up to 200 photos, the second for videos and
            larger numbered bursts, the third for other large sets.
        masks: a folder of masks named as the photos are, black where a photo is to be ignored; None looks for masks/
            in or beside the folder of photos.
        seed: of everything random.
        overwrite: replace poses that an earlier call left in `out`, with the photos that it put there; never those of
            others, nor photos that it did not put there.
        report: called with what is going on and the share of all the work that is done.
        say: called with sentences for the person.

    Returns:
        What came out and what is in doubt.

    Raises:
        HyrfDataError: there are too few photos, or they do not overlap, or show the scene from one place only.
        HyrfError: the folder cannot be written, has poses already, or the library failed.
        ValueError: `matching` or `seed` is none.

    Example:
        >>> import hyrfpack
        >>> found = hyrfpack.estimate_poses("photos/corner", "scenes/corner")
        >>> len(hyrfpack.load_scene("scenes/corner").views) == found.registered
        True
    """
    check_choice("matching", matching, MATCHING)
    check_int("seed", seed, 0, 2**64 - 1)
    work = _Estimation(Path(photos), Path(out), matching, masks, seed, overwrite, report, say)
    with _disk_errors(work.out):
        return work.run()


@dataclass
class _Estimation:
    """One call, and what it found on the way."""

    photos: Path
    out: Path
    matching: str
    masks: StrPath | None
    seed: int
    overwrite: bool
    report: Report | None
    say: Say | None
    count: int = 0
    left_out: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def work(self) -> Path:
        """Where products in progress are."""
        return self.out / ".poses"

    def run(self) -> PosesReport:
        """All stages."""
        if is_archive(self.photos):
            self.photos = unpacked(self.photos)
        self._check_out()
        began = time.monotonic()
        self._tell("photos", "reading photos", 0.0)
        job = self._prepare()
        self.seconds["photos"] = time.monotonic() - began
        features = self._stage("features")
        self._check_features(features)
        matches = self._stage("matches")
        self._check_matches(matches)
        found = self._stage("finish", *self._map())
        self._check_found(found, job)
        return self._conclude(job, features, matches, found)

    def _check_out(self) -> None:
        if not self.photos.exists():
            raise HyrfDataError(f"{self.photos}: there is no such folder or video; name the one that holds the photos")
        if os.path.lexists(self.out) and not self.out.is_dir():
            raise HyrfError(f"{self.out}: this is a file; name a folder for the scene")
        there = set(os.listdir(self.out)) if self.out.is_dir() else set()
        if there.intersection((*MODELS, *TABLES, *POSES, "colmap")):
            if read_report(self.out) is None:
                raise HyrfError(
                    f"{self.out}: the folder has poses of another program, which are kept; train on them, or name "
                    "another folder"
                )
            if not self.overwrite:
                raise HyrfError(f"{self.out}: the folder has poses already; use them, or replace them with --overwrite")
        if not _same(self.photos, self.out) and any(name.lower().endswith(PICTURES) for name in there):
            raise HyrfError(f"{self.out}: photos lie in this folder; name another for the scene")
        make_folder(self.out)
        check_writable(self.out)

    def _prepare(self) -> Job:
        """Photos in their folder, and the job."""
        video = self.photos.is_file()
        if video and self.photos.suffix.lower() in PICTURES:
            raise HyrfDataError(f"{self.photos}: one photo has no poses; name the folder of all photos, or a video")
        images = self.out / "images"
        here = not video and self._in_images(images)
        mask_folder = self._mask_folder(here)
        sources = [self.photos] if video else self._list(images if here else self.photos)
        if video:
            again = self._claim(sources, mask_folder)
            self._take_frames(images, again)
            sources = list_photos(images)
        root = images if here or video else self.photos
        stay = here or video
        photos, self.left_out = look_at(root, sources, stay)
        self.count = len(photos) + len(self.left_out)
        self._check_count(photos)
        found = find_masks(photos, mask_folder) if mask_folder else {}
        if self.masks is not None and not found:
            raise HyrfDataError(f"{self.masks}: no mask is named as a photo is ({photos[0].source}.png); rename them")
        if not video:
            again = self._claim(sources, mask_folder)  # not before: nothing is removed for photos that are refused
        if not stay and not (again and images.is_dir()):
            self._make(images, lambda folder: make_images(photos, folder))
        masks_here = self.out / "masks"
        if found and mask_folder is not None and not _same(mask_folder, masks_here):
            if not (again and masks_here.is_dir()):
                self._make(masks_here, lambda folder: make_masks(photos, found, folder))
            made = {name: masks_here / f"{name}.png" for name in found}
            found = {name: path for name, path in made.items() if path.is_file()} or found
        if found:
            self._note(f"{len(found)} of {len(photos)} photos have a mask")
        if faces := sum(photo.face is not None for photo in photos):
            self._note(f"{faces // len(FACES)} panoramas were cut into {faces} photos")
        sideways = sum(photo.facts.orientation != 1 for photo in photos)
        if sideways and stay and not video:
            self._note(f"{sideways} photos are stored on their side and are used as they are stored")
        elif sideways:
            self._note(f"{sideways} photos that the camera stored on their side were turned upright")
        devices, of = devices_of(photos, stay)
        if len(devices) > 1:
            self._note(f"{len(devices)} cameras or zooms are told apart by folder, device, size and focal length")
        ordered = video or (len(photos) > EXHAUSTIVE_UP_TO and in_order(photos))
        matching = choose_matching(len(photos), ordered) if self.matching == "auto" else self.matching
        job = Job(
            images.resolve(),
            self.work.resolve(),
            tuple(photo.name for photo in photos),
            devices,
            of,
            {name: str(path.resolve()) for name, path in found.items()},
            matching,
            self.seed,
        )
        job.save(self.work / "job.json")
        return job

    def _list(self, folder: Path) -> list[Path]:
        """The photos in a folder, but for what was put into a scene in it."""
        files = list_photos(folder)
        scene = (self.out / "images" if _same(folder, self.out) else self.out).resolve()
        if folder.resolve() in scene.parents:
            files = [path for path in files if scene not in path.resolve().parents]
        return files

    def _in_images(self, images: Path) -> bool:
        """Whether the photos are those that lie in the scene's images/ already."""
        if not (_same(self.photos, self.out) and images.is_dir()):
            return _same(self.photos, images)
        ours = any(name.startswith("images/") for name in self._made())
        return not (ours and self._list(self.photos))  # beside what we made of them, the photos themselves

    def _check_count(self, photos: list) -> None:
        found = len(photos)
        if found >= LEAST:
            return
        copies = [reason for reason in self.left_out.values() if reason.startswith("a copy of")]
        if not self.count:
            videos = [name for name in os.listdir(self.photos) if name.lower().endswith(VIDEOS)]
            hint = f"; name the video itself: {videos[0]}" if videos else "; name the folder that holds them"
            raise HyrfDataError(f"{self.photos}: there are no photos here (JPEG, PNG, WebP, TIFF or HEIC){hint}")
        if copies and found + len(copies) >= LEAST:
            raise HyrfDataError(
                f"{self.photos}: {len(copies)} of {self.count} files are copies of another, and {found} "
                f"different {'photo is' if found == 1 else 'photos are'} too few; take photos from many places"
            )
        if self.left_out and not copies:
            name, reason = next(iter(self.left_out.items()))
            raise HyrfDataError(
                f"{self.photos}: {len(self.left_out)} of {self.count} photos cannot be read ({name}: {reason}), and "
                f"{found or 'none'} is too few; replace the files"
            )
        raise HyrfDataError(
            f"{self.photos}: {found} {'photo is' if found == 1 else 'photos are'} too few to find poses; take 20 or "
            "more from different places, each sharing two thirds of its view with the next"
        )

    def _mask_folder(self, here: bool) -> Path | None:
        if self.masks is not None:
            if not Path(self.masks).is_dir():
                raise HyrfDataError(f"{self.masks}: there is no such folder of masks; name another")
            return Path(self.masks)
        if self.photos.is_file():
            return None
        beside = [self.out / "masks"] if here else [self.photos / "masks", self.photos / "mask"]
        if self.photos.name == "images":
            beside.append(self.photos.parent / "masks")
        return next((folder for folder in beside if folder.is_dir()), None)

    def _claim(self, sources: list[Path], masks: Path | None) -> bool:
        """Make the folder of products, or find that of the same call; returns whether it goes on."""
        listed = [*sources, *(list_pictures(masks) if masks else [])]
        states = [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in listed]
        settings = [_VERSION, self.matching, self.seed]
        fingerprint = hashlib.sha256(json.dumps([settings, states]).encode()).hexdigest()
        kept = self.work / "fingerprint"
        if kept.is_file() and kept.read_text() == fingerprint:
            if self.say is not None:
                self.say("an interrupted estimation goes on")
            return True
        remove(self.out, self._made(), {path.resolve() for path in listed})
        shutil.rmtree(self.work, ignore_errors=True)
        self.work.mkdir()
        write_atomic(kept, fingerprint.encode())
        return False

    def _make(self, folder: Path, fill: Callable[[Path], object], goes_on: bool = False) -> None:
        """Make a folder of the scene, whole or not at all; `goes_on`: what an interrupted call has filled in stays."""
        if folder.is_dir() and any(folder.iterdir()):
            raise HyrfError(
                f"{folder}: there are files that are not of these photos; name another folder for the scene, or "
                f"{self.out} itself as that of the photos"
            )
        unfinished = self.work / f"unfinished-{folder.name}"
        if not goes_on:
            shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(exist_ok=True)
        fill(unfinished)
        made = self._made() | files_of(unfinished, folder.name)
        write_atomic(self.work / "made.json", json.dumps(made).encode())
        if folder.is_dir():
            folder.rmdir()
        os.replace(unfinished, folder)

    def _made(self) -> Made:
        """What this estimation, or an earlier one, put into the scene's images/ and masks/."""
        kept = self.work / "made.json"
        made = json.loads(kept.read_bytes()) if kept.is_file() else (read_report(self.out) or {}).get("made")
        return still_there(self.out, made)

    def _take_frames(self, images: Path, again: bool) -> None:
        def tell(doing: str, share: float) -> None:
            self._tell("photos", doing, share)

        frames: FrameReport | None = None

        def fill(folder: Path) -> None:
            nonlocal frames
            frames = choose_frames(self.photos, folder, report=tell)

        if again and images.is_dir():
            fill(images)  # which finds them there
        else:
            self._make(images, fill, goes_on=True)
        assert frames is not None
        self._note(f"{frames.taken} of {frames.of} frames were taken")
        for sentence in frames.notes:
            self._note(sentence)

    def _stage(self, stage: str, *more: str) -> dict[str, Any]:
        began = time.monotonic()
        try:
            return run_stage(self.work / "job.json", stage, lambda doing, share: self._tell(stage, doing, share), *more)
        finally:
            self.seconds[stage] = time.monotonic() - began

    def _map(self) -> list[str]:
        """Run both mappers; returns the names of their results."""
        results, failures = [], []
        for stage in ("global", "incremental"):
            try:
                results += self._stage(stage)["models"]
            except Crashed as error:
                failures.append(error)
                self._note(f"the {stage} mapper failed, and the other one's result is taken unchecked: {error}")
        if len(failures) == 2:
            raise failures[0]
        return results

    def _check_features(self, features: dict[str, Any]) -> None:
        self.left_out |= {name: f"cannot be decoded ({reason})" for name, reason in features["unreadable"].items()}
        counts = list(features["keypoints"].values())
        if len(counts) < LEAST:
            name, reason = next(iter(features["unreadable"].items()))
            raise HyrfDataError(
                f"{self.photos}: {len(counts)} of {self.count} photos can be decoded ({name}: {reason}); replace the "
                "files"
            )
        if np.median(counts) < _FEATURELESS:
            raise HyrfDataError(
                f"{self.photos}: there is hardly anything in these photos that can be recognised in another (a typical "
                f"one has {int(np.median(counts))} features); take sharp, well lit photos of things that have texture"
            )

    def _check_matches(self, matches: dict[str, Any]) -> None:
        if len(matches["matched"]) < LEAST:
            raise HyrfDataError(
                f"{self.photos}: {matches['pairs'] or 'no'} pairs of these {self.count} photos show the same thing; "
                "take sharp photos of one scene, each sharing two thirds of its view with the next"
            )
        if matches["turned"] >= _TURNED:
            raise HyrfDataError(
                f"{self.photos}: the photos are all taken from one place, where the camera turned at most, so that no "
                "depth can be seen in them; walk around the scene, a step to the side between photos"
            )

    def _check_found(self, found: dict[str, Any], job: Job) -> None:
        if len(found["registered"]) < LEAST:
            raise HyrfDataError(
                f"{self.photos}: no poses could be found, for these {len(job.names)} photos share too little with each "
                "other; take more between them, each sharing two thirds of its view with the next"
            )

    def _conclude(
        self, job: Job, features: dict[str, Any], matches: dict[str, Any], found: dict[str, Any]
    ) -> PosesReport:
        registered = set(found["registered"])
        sharp = features["sharpness"]
        blurred = {name for name, is_so in zip(sharp, is_blurred(list(sharp.values())), strict=True) if is_so}
        for name in job.names:
            if name in registered or name in self.left_out:
                continue
            if name in found["apart"]:
                reason = "belongs to a piece of its own, which too little joins to the rest"
            elif features["keypoints"].get(name, 0) < _FEATURELESS and sharp.get(name, 0) < _BLANK:
                reason = "nothing in it that can be recognised"
            elif name in blurred:
                reason = "blurred"
            elif name not in matches["matched"]:
                reason = "no matches with other photos"
            else:
                reason = "too few matches with the posed photos"
            self.left_out[name] = reason
        if found["doubt"]:
            self._note(found["doubt"])
        if found["angle"] < _FLAT:
            self._note("the photos are taken from nearly one place, so that depth is vague; take steps to the side")
        if blurred & registered:
            self._note(f"{len(blurred & registered)} of the posed photos are blurred beside the others")
        report = PosesReport(
            self.out,
            self.count,
            len(registered),
            len(found["sure"]),
            dict(sorted(self.left_out.items())),
            found["mapper"],
            found["why"],
            tuple(self.notes),
            {stage: round(seconds, 1) for stage, seconds in self.seconds.items()},
        )
        unsure = sorted(registered.difference(found["sure"]))
        content = asdict(report) | {"scene": str(self.out), "unsure": unsure, "made": self._made()}
        self._put(job.model("chosen"), json.dumps(content, indent=1).encode())
        return report

    def _put(self, model: Path, content: bytes) -> None:
        """Move the model to its place, and say that it is ours first: what is ours may be made anew."""
        write_atomic(self.out / REPORT, content)
        shutil.rmtree(self.out / "sparse", ignore_errors=True)
        unfinished = self.work / "sparse"
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        os.replace(model, unfinished / "0")
        os.replace(unfinished, self.out / "sparse")
        shutil.rmtree(self.work, ignore_errors=True)

    def _note(self, sentence: str) -> None:
        self.notes.append(sentence)
        if self.say is not None:
            self.say(sentence)

    def _tell(self, stage: str, doing: str, share: float) -> None:
        if self.report is not None:
            stages = list(_SHARES)
            before = sum(_SHARES[earlier] for earlier in stages[: stages.index(stage)])
            self.report(doing, min(before + _SHARES[stage] * share, 1.0))


def _same(first: Path, second: Path) -> bool:
    return first.resolve() == second.resolve()


@contextmanager
def _disk_errors(out: Path) -> Iterator[None]:
    """What the disk refuses is one sentence; what is done is kept."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise HyrfError(
                f"{out}: the disk is full; free some space and run the same command again, which goes on here"
            ) from error
        if isinstance(error, FileNotFoundError):
            raise HyrfError(
                f"{error.filename or out}: was removed or moved meanwhile; put it back and run the same command again"
            ) from error
        raise HyrfError(
            f"{error.filename or out}: cannot be read or written ({error.strerror or error}); check the folder's "
            "permissions and the disk"
        ) from error
