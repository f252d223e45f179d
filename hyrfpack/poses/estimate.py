"""Poses from photos, whole: prepare, match, map twice, choose, and keep what is done on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hyrfpack.checks import check_choice, check_int
from hyrfpack.choices import MATCHING_METHODS
from hyrfpack.data.archive import archive_paths_in_errors, is_archive, unpack
from hyrfpack.data.equirectangular import FACES
from hyrfpack.data.folder import list_photos, list_pictures, list_raw_photos
from hyrfpack.data.unusable import raise_if_single_photo, raw_photos_notes, unreadable_sentences
from hyrfpack.errors import HyrfDataError
from hyrfpack.lock import exclusive_folder
from hyrfpack.outputs import StrPath
from hyrfpack.poses import diagnosis
from hyrfpack.poses.frames import FrameReport, choose_frames, frame_times
from hyrfpack.poses.job import Job
from hyrfpack.poses.output import Output, disk_errors, same
from hyrfpack.poses.pairs import EXHAUSTIVE_UP_TO, choose_matching
from hyrfpack.poses.prepare import (
    Photo,
    devices_of,
    find_masks,
    in_order,
    look_at,
    make_images,
    make_masks,
    only_unreadable,
)
from hyrfpack.poses.process import Crashed, run_stage

# Share of each stage in the whole time, between what sets of small photos and of large ones take.
_SHARES = {"photos": 0.03, "features": 0.15, "matches": 0.35, "global": 0.25, "incremental": 0.12, "finish": 0.1}
_VIDEO_FRAMES_SHARE = 0.3  # of the time, in which the frames of a video are chosen; the other stages share the rest
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
        left_out: the reason for each photo without a pose, by its path below the folder that was given; frames of a
            video and faces of panoramas by their names in images/.
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
        out: the scene's folder. It gets images/ (copies of the photos, upright ones of those that a camera stored on
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
        HyrfError: the folder cannot be written, has poses already, another call is at work in it, or the library
            failed.
        ValueError: `matching` or `seed` is none.

    Example:
        >>> import hyrfpack
        >>> found = hyrfpack.estimate_poses("photos/corner", "scenes/corner")
        >>> len(hyrfpack.load_scene("scenes/corner").views) == found.registered
        True
    """
    check_choice("matching", matching, MATCHING_METHODS)
    check_int("seed", seed, 0, 2**64 - 1)
    with disk_errors(Path(out)), archive_paths_in_errors():
        return _Estimation(Path(photos), Path(out), matching, masks, seed, overwrite, report, say).run()


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
    names: dict[str, str] = field(default_factory=dict)  # that the user knows photos by, if these are others
    is_video: bool = False
    share: float = 0.0  # of all the work that was told to be done
    claimed: bool = False  # the folder of products
    finished: bool = False  # a stage, or work that this call goes on with

    def __post_init__(self) -> None:
        self.output = Output(self.out)
        self.given = self.photos  # an archive, whose files are unpacked elsewhere

    def run(self) -> PosesReport:
        """All stages; of an estimation that finishes none nothing is left, unless it was interrupted."""
        if is_archive(self.photos):
            self.photos = unpack(self.photos)
        self.output.check_place(self.photos)
        with exclusive_folder(self.out):
            self.output.check(self.photos, self.overwrite)
            try:
                return self._run()
            except HyrfDataError:
                if self.claimed and not self.finished:
                    self.output.clear()
                raise
            finally:
                self.output.clear_if_bare()

    def _run(self) -> PosesReport:
        began = time.monotonic()
        self._tell("photos", "reading photos", 0.0)
        job = self._prepare()
        self.seconds["photos"] = time.monotonic() - began
        features = self._stage("features")
        unreadable = {self._name(name): reason for name, reason in features["unreadable"].items()}
        self.left_out |= unreadable
        diagnosis.check_features(self.given, self.count, features, unreadable)
        self._note_all(unreadable_sentences(unreadable, self.count))
        matches = self._stage("matches")
        diagnosis.check_matches(self.given, self.count, matches)
        found = self._stage("finish", *self._map())
        diagnosis.check_found(self.given, len(job.names), found)
        return self._conclude(job, features, matches, found)

    def _prepare(self) -> Job:
        """Photos and masks where they are read from, and the job."""
        raise_if_single_photo(self.photos)
        video = self.is_video = self.photos.is_file()
        images = self.out / "images"
        here = not video and self._in_images(images)
        mask_folder = self._mask_folder(here)
        root = images if here else self.photos
        sources = [self.photos] if video else self._list(root)
        self.output.reads([*sources, *(list_pictures(mask_folder) if mask_folder else [])])
        if not here:
            self.output.check_free("images")
        if video:
            self._claim()
            root = self._take_frames()
            sources = list_photos(root)
        copied = not (here or video)
        looking = self._counter(
            "reading the headers of photos", len(sources), 0.9 if video else 0.0, 0.5 if copied else 1
        )
        photos, self.left_out = look_at(root, sources, in_place=not copied, progress=looking)
        self.count = len(photos) + len(self.left_out)
        diagnosis.check_count(self.given, root, len(photos), self.left_out)
        self.names = self._names(photos)
        masks = find_masks(photos, mask_folder) if mask_folder else {}
        if self.masks is not None and not masks:
            raise HyrfDataError(f"{self.masks}: no mask is named as a photo is ({photos[0].source}.png); rename them")
        put_masks = bool(masks) and mask_folder is not None and not same(mask_folder, self.out / "masks")
        if put_masks:
            self.output.check_free("masks")
        if not video:
            self._claim()  # not before: nothing is removed for photos that are refused
        if copied:
            copying = self._counter("copying photos", len(photos), 0.5, 1.0)
            root = self.output.make("images", lambda folder: make_images(photos, folder, copying))
        if put_masks:
            folder = self.output.make("masks", lambda folder: make_masks(photos, masks, folder))
            masks = {name: folder / f"{name}.png" for name in masks}
        self._note_photos(photos, masks, copied, turned=not here)
        if not video:
            self._note_all(raw_photos_notes(self._list(root if here else self.photos, list_raw_photos)))
        devices, of = devices_of(photos, in_place=not copied)
        if len(devices) > 1:
            self._note(f"{len(devices)} cameras or zooms are told apart by folder, device, size and focal length")
        ordered = video or (len(photos) > EXHAUSTIVE_UP_TO and in_order(photos))
        job = Job(
            root.resolve(),
            self.output.work.resolve(),
            tuple(photo.name for photo in photos),
            devices,
            of,
            {name: str(path.resolve()) for name, path in masks.items()},
            choose_matching(len(photos), ordered) if self.matching == "auto" else self.matching,
            self.seed,
        )
        job.save(self.output.work / "job.json")
        return job

    def _list(self, folder: Path, list_files: Callable[[Path], list[Path]] = list_photos) -> list[Path]:
        """The photos in a folder, but for what was put into a scene in it."""
        files = list_files(folder)
        scene = (self.out / "images" if same(folder, self.out) else self.out).resolve()
        if folder.resolve() in scene.parents:
            files = [path for path in files if scene not in path.resolve().parents]
        return files

    def _in_images(self, images: Path) -> bool:
        """Whether the photos are those that lie in the scene's images/ already."""
        if not (same(self.photos, self.out) and images.is_dir()):
            return same(self.photos, images)
        ours = any(name.startswith("images/") for name in self.output.made())
        return not (ours and self._list(self.photos))  # beside what we made of them, the photos themselves

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

    def _claim(self) -> None:
        self.finished = self.output.claim([self.matching, self.seed])
        self.claimed = True
        if self.finished and self.say is not None:
            self.say("an interrupted estimation goes on")

    def _take_frames(self) -> Path:
        """The folder of the frames that are taken of the video."""

        def tell(doing: str, share: float) -> None:
            self._tell("photos", doing, 0.9 * share)

        def take(folder: Path) -> FrameReport:
            return choose_frames(self.photos, folder, report=tell)

        folder = self.output.make("images", take, keep=True)
        frames = take(folder)  # which finds them there
        self._note(f"{frames.taken} of {frames.of} frames were taken")
        self._note_all(frames.notes)
        return folder

    def _names(self, photos: list[Photo]) -> dict[str, str]:
        """What the user calls photos that are called otherwise in images/: the photo that one was written from, or when
        a frame is shown."""
        if self.is_video:
            times = frame_times(self.output.work / "images")
            return {name: f"{name} (at {seconds:.1f} s)" for name, seconds in times.items()}
        return {photo.name: photo.source for photo in photos if photo.face is None}

    def _name(self, name: str) -> str:
        return self.names.get(name, name)

    def _counter(self, doing: str, count: int, first: float, last: float) -> Callable[[int], None]:
        """What tells how many of the photos are done, as shares of the first stage from `first` to `last`."""

        def progress(done: int) -> None:
            self._tell("photos", f"{doing}, {done:,} of {count:,}", first + (last - first) * done / max(count, 1))

        return progress

    def _note_photos(self, photos: list[Photo], masks: dict[str, Path], copied: bool, turned: bool) -> None:
        """Say what was done with the photos.

        Args:
            photos: all that are used.
            masks: of them.
            copied: they were put into images/.
            turned: those that are stored on their side are upright now.
        """
        self._note_all(unreadable_sentences(only_unreadable(self.left_out), self.count))
        if copied:
            size = sum(path.stat().st_size for path in {photo.facts.path for photo in photos})
            where = self.out / "images"
            self._note(f"the photos ({size / 1e6:,.1f} MB) are copied into {where}; edits there do not change yours")
        if masks:
            self._note(f"{len(masks)} of {len(photos)} photos have a mask")
        if faces := sum(photo.face is not None for photo in photos):
            self._note(f"{faces // len(FACES)} panoramas were cut into {faces} photos")
        sideways = sum(photo.facts.orientation != 1 for photo in photos)
        if sideways and turned:
            self._note(f"{sideways} photos that the camera stored on their side were turned upright")
        elif sideways:
            self._note(f"{sideways} photos are stored on their side and are used as they are stored")

    def _stage(self, stage: str, *more: str) -> dict[str, Any]:
        began, job = time.monotonic(), self.output.work / "job.json"
        try:
            answer = run_stage(job, stage, lambda doing, share: self._tell(stage, doing, share), *more)
        finally:
            self.seconds[stage] = time.monotonic() - began
        self.finished = True
        return answer

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

    def _conclude(
        self, job: Job, features: dict[str, Any], matches: dict[str, Any], found: dict[str, Any]
    ) -> PosesReport:
        registered = set(found["registered"])
        decoded = [name for name in job.names if name not in features["unreadable"]]
        unposed = diagnosis.unposed(decoded, features, matches, found)
        self.left_out |= {self._name(name): reason for name, reason in unposed.items()}
        if found["doubt"]:
            self._note(found["doubt"])
        if found["angle"] < _FLAT:
            self._note("the photos are taken from nearly one place, so that depth is vague; take steps to the side")
        if blurred := diagnosis.blurred(features) & registered:
            self._note(f"{len(blurred)} of the posed photos are blurred beside the others")
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
        self.output.check(self.photos, self.overwrite)  # again: another program may have put poses there meanwhile
        self.output.put(job.model("chosen"), asdict(report) | {"scene": str(self.out), "unsure": unsure})
        return report

    def _note_all(self, sentences: Iterable[str]) -> None:
        for sentence in sentences:
            self._note(sentence)

    def _note(self, sentence: str) -> None:
        self.notes.append(sentence)
        if self.say is not None:
            self.say(sentence)

    def _tell(self, stage: str, doing: str, share: float) -> None:
        if self.report is not None:
            shares = dict(_SHARES)
            if self.is_video:
                rest = (1 - _VIDEO_FRAMES_SHARE) / (1 - _SHARES["photos"])
                shares = {name: rest * value for name, value in _SHARES.items()} | {"photos": _VIDEO_FRAMES_SHARE}
            stages = list(shares)
            before = sum(shares[earlier] for earlier in stages[: stages.index(stage)])
            self.share = max(self.share, min(before + shares[stage] * share, 1.0))
            self.report(doing, self.share)
