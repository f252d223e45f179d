"""Estimate camera poses of photos: prepare them, match them, run two mappers, and choose the better result."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from hyrfpack.checks import check_type
from hyrfpack.config.poses import PosesConfig
from hyrfpack.context import RunContext
from hyrfpack.counts import format_count
from hyrfpack.data.archive import archive_paths_in_errors, is_archive, unpack
from hyrfpack.data.equirectangular import CUBE_FACES, is_panorama
from hyrfpack.data.folder import list_photos, list_pictures, list_raw_photos
from hyrfpack.data.masks import MaskMatches, locate_masks
from hyrfpack.data.unusable import raise_if_single_photo, raw_photos_notes, unreadable_sentences
from hyrfpack.errors import HyrfDataError, suggest_command
from hyrfpack.lock import exclusive_folder
from hyrfpack.outputs import StrPath
from hyrfpack.poses import diagnosis
from hyrfpack.poses.frames import FrameReport, choose_frames, frame_times
from hyrfpack.poses.job import Job
from hyrfpack.poses.output import SceneOutput, explain_disk_errors, is_same_path
from hyrfpack.poses.pairs import MAX_EXHAUSTIVE_PHOTOS, choose_matching
from hyrfpack.poses.prepare import (
    Photo,
    find_masks,
    group_by_device,
    is_ordered_sequence,
    make_images,
    make_masks,
    read_headers,
    select_unreadable,
)
from hyrfpack.poses.process import StageCrashedError, run_stage
from hyrfpack.progress import Event, Progress, TaskEvent, part_of_progress
from hyrfpack.splats.names import is_splats

_LOG = logging.getLogger(__name__)

# Ratio of each stage in the whole time, a compromise between sets of small and of large photos.
_STAGE_TIME_RATIOS = {
    "photos": 0.03,
    "features": 0.15,
    "matches": 0.28,
    "global": 0.2,
    "incremental": 0.12,
    "repeat": 0.1,  # needed by about half of the sets, on which it takes twice as long
    "finish": 0.12,
}
_VIDEO_FRAMES_TIME_RATIO = 0.3  # choosing the frames of a video takes this ratio of the time, all other stages the rest
_MIN_RAY_ANGLE_DEGREES = 2.0  # with smaller triangulation angles, the camera hardly moved


@dataclass(frozen=True)
class PosesReport:
    """Result of a pose estimation.

    Attributes:
        scene: folder of the scene, which `load_scene` reads.
        photos: number of photos that were given.
        registered: number of photos with a pose.
        sure: number of registered photos whose poses agree between both mappers, within 2 % of the scene's extent and
            5 degrees.
        left_out: the reason for each photo without a pose, by its path relative to the given folder; frames of a video
            and faces of panoramas by their names in images/.
        mapper: the mapper whose result was chosen, "incremental" or "global".
        why: the reason for the choice, a sentence with the figures of both mappers.
        notes: sentences about uncertain poses and about how the photos were treated.
        seconds: duration of each stage in this call.
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
    config: PosesConfig | None = None,
    *,
    masks: StrPath | None = None,
    overwrite: bool = False,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> PosesReport:
    """Estimate the camera poses of photos and write a scene that `load_scene` reads.

    Features are matched between photos and verified geometrically. Two mappers (incremental and global structure from
    motion) pose the photos, and the result that explains more of the matches is chosen. Each stage runs in a process of
    its own. Products are kept in `out`/.poses until the scene is complete, so that the same call resumes an interrupted
    one.

    Args:
        photos: a folder of photos (each sub-folder is a camera of its own), a .zip of one, or a video.
        out: folder of the scene. It gets images/ (copies of the photos, turned upright), sparse/0 and poses.json. A
            folder may be both `photos` and `out`; if its photos are in images/, they stay as they are.
        config: settings; None for the defaults.
        masks: folder of masks, named like the photos, black where a photo is ignored. None searches for masks/ in or
            beside the folder of photos.
        overwrite: replace poses and photos that an earlier call wrote into `out`. Files of other origin are never
            replaced.
        context: progress and stop.

    Returns:
        The number of registered photos, the chosen mapper, and notes about uncertain poses.

    Raises:
        HyrfDataError: there are too few photos, they do not overlap, or they show the scene from one place only.
        HyrfError: the folder cannot be written, already has poses, or is in use by another call; or pycolmap failed.

    Example:
        >>> import hyrfpack
        >>> found = hyrfpack.estimate_poses("photos/corner", "scenes/corner")
        >>> len(hyrfpack.load_scene("scenes/corner").views) == found.registered
        True
    """
    config = PosesConfig() if config is None else config
    check_type("config", config, PosesConfig)
    with explain_disk_errors(Path(out)), archive_paths_in_errors(), context.open_progress("poses") as progress:
        return _PoseEstimation(Path(photos), Path(out), config, masks, overwrite, progress).run()


@dataclass
class _PoseEstimation:
    """Arguments and intermediate results of one call of `estimate_poses`."""

    photos: Path
    out: Path
    config: PosesConfig
    masks: StrPath | None
    overwrite: bool
    progress: Progress
    photo_count: int = 0
    left_out: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    user_names: dict[str, str] = field(default_factory=dict)  # by name in images/, where the two names differ
    is_video: bool = False
    reported_ratio: float = 0.0  # reported progress never decreases
    has_work_folder: bool = False
    has_products: bool = False  # this call or an interrupted one has finished a stage

    def __post_init__(self) -> None:
        self.output = SceneOutput(self.out)
        self.given_path = self.photos  # an archive is unpacked elsewhere, but messages name the archive

    def run(self) -> PosesReport:
        """Run all stages. If an error ends the call before a stage is finished, its products are removed."""
        if is_archive(self.photos):
            self.photos = unpack(self.photos)
        self.output.check_paths(self.photos)
        _raise_if_scene_file(self.photos)
        with exclusive_folder(self.out):
            self.output.check_replaceable(self.photos, self.overwrite)
            try:
                return self._run_stages()
            except HyrfDataError:
                if self.has_work_folder and not self.has_products:
                    self.output.clear()
                raise
            finally:
                self.output.clear_if_empty()

    def _run_stages(self) -> PosesReport:
        began = time.monotonic()
        self._report_progress("photos", TaskEvent("reading photos", 0.0))
        job = self._prepare_job()
        self.seconds["photos"] = time.monotonic() - began
        features = self._run_stage("features")
        unreadable = {self._user_name(name): reason for name, reason in features["unreadable"].items()}
        self.left_out |= unreadable
        diagnosis.check_features(self.given_path, self.photo_count, features, unreadable)
        self._add_notes(unreadable_sentences(unreadable, self.photo_count), logging.WARNING)
        matches = self._run_stage("matches")
        diagnosis.check_matches(self.given_path, self.photo_count, matches)
        result = self._run_stage("finish", *self._run_mappers())
        diagnosis.check_registered(self.given_path, len(job.names), result)
        return self._write_result(job, features, matches, result)

    def _prepare_job(self) -> Job:
        """Prepare photos and masks and return the job."""
        raise_if_single_photo(self.photos)
        is_video = self.is_video = self.photos.is_file()
        images = self.out / "images"
        in_place = not is_video and self._are_in_images(images)
        mask_folder = self._find_mask_folder(in_place)
        root = images if in_place else self.photos
        source_files = [self.photos] if is_video else self._list_photos(root)
        self.output.protect([*source_files, *(list_pictures(mask_folder) if mask_folder else [])])
        if not in_place:
            self.output.check_free("images")
        if is_video:
            self._claim_work_folder()
            root = self._extract_frames()
            source_files = list_photos(root)
            if any(is_panorama(frame) for frame in source_files):
                raise HyrfDataError(
                    f"{self.given_path}: this is a 360-degree video, which cannot be cut into photos directly",
                    fix="save frames of the video as pictures in a folder, and name that folder",
                )
        copies_photos = not (in_place or is_video)
        report_photos = partial(self._report_progress, "photos")
        report_reading = part_of_progress(report_photos, 0.9 if is_video else 0.0, 0.5 if copies_photos else 1.0)
        photos, self.left_out = read_headers(root, source_files, in_place=not copies_photos, progress=report_reading)
        self.photo_count = len(photos) + len(self.left_out)
        diagnosis.check_photo_count(self.given_path, root, len(photos), self.left_out)
        self.user_names = self._map_user_names(photos)
        masks = self._match_masks(photos, mask_folder, in_place=not copies_photos)
        copies_masks = bool(masks) and mask_folder is not None and not is_same_path(mask_folder, self.out / "masks")
        if copies_masks:
            self.output.check_free("masks")
        if not is_video:
            self._claim_work_folder()  # only now, so that rejected photos do not remove products of an earlier call
        if copies_photos:
            report_copying = part_of_progress(report_photos, 0.5, 1.0)
            root = self.output.make_folder("images", lambda folder: make_images(photos, folder, report_copying))
        if copies_masks:
            folder = self.output.make_folder("masks", lambda folder: make_masks(photos, masks, folder))
            masks = {name: folder / f"{name}.png" for name in masks}
        self._note_photos(photos, masks, copies_photos, turned=not in_place)
        if not is_video:
            self._add_notes(raw_photos_notes(self._list_photos(root if in_place else self.photos, list_raw_photos)))
        return self._save_job(photos, masks, root, in_place=not copies_photos)

    def _match_masks(self, photos: list[Photo], folder: Path | None, in_place: bool) -> dict[str, Path]:
        """Return the masks in a folder by photo name, and add notes about masks that match no photo."""
        matches = find_masks(photos, folder, in_place) if folder else MaskMatches()
        self._add_notes(matches.notes, logging.WARNING)
        if self.masks is not None and not matches.by_photo:
            raise HyrfDataError(
                f"{self.masks}: no mask has the name of a photo (such as {photos[0].source}.png)",
                fix="give each mask the name of its photo",
            )
        return matches.by_photo

    def _save_job(self, photos: list[Photo], masks: dict[str, Path], root: Path, in_place: bool) -> Job:
        """Describe the prepared photos and masks by a job, save it for the stages, and return it."""
        devices, device_indices = group_by_device(photos, in_place)
        if len(devices) > 1:
            self._add_note(
                f"{len(devices)} cameras or zooms are distinguished by folder, device, size and focal length"
            )
        ordered = self.is_video or (len(photos) > MAX_EXHAUSTIVE_PHOTOS and is_ordered_sequence(photos))
        job = Job(
            root.resolve(),
            self.output.work.resolve(),
            tuple(photo.name for photo in photos),
            devices,
            device_indices,
            {name: str(path.resolve()) for name, path in masks.items()},
            choose_matching(len(photos), ordered) if self.config.matching == "auto" else self.config.matching,
            self.config.seed,
        )
        job.save(self.output.work / "job.json")
        return job

    def _list_photos(self, folder: Path, list_files: Callable[[Path], list[Path]] = list_photos) -> list[Path]:
        """List the photos in a folder, without those of a scene in it."""
        files = list_files(folder)
        scene = (self.out / "images" if is_same_path(folder, self.out) else self.out).resolve()
        if folder.resolve() in scene.parents:
            files = [path for path in files if scene not in path.resolve().parents]
        return files

    def _are_in_images(self, images: Path) -> bool:
        """Return whether the photos are already those in the scene's images/."""
        if not (is_same_path(self.photos, self.out) and images.is_dir()):
            return is_same_path(self.photos, images)
        has_copies = any(name.startswith("images/") for name in self.output.owned_files())
        # If the folder also holds the originals of these copies, the originals are the photos.
        return not (has_copies and self._list_photos(self.photos))

    def _find_mask_folder(self, in_place: bool) -> Path | None:
        """Return the given folder of masks, or that in or beside the folder of photos; None if there is none."""
        if self.masks is not None:
            if not Path(self.masks).is_dir():
                raise HyrfDataError(f"{self.masks}: there is no such folder of masks", fix="name another folder")
            return Path(self.masks)
        if self.photos.is_file():
            return None
        masks = locate_masks(self.out / "images" if in_place else self.photos)
        if masks is None or in_place or not is_same_path(masks, self.out / "masks"):
            return masks
        if not any(name.startswith("masks/") for name in self.output.owned_files()):
            _LOG.warning(
                f"{masks}: these masks are not read, as the scene's own belong there; name another folder for the scene"
            )
        return None

    def _claim_work_folder(self) -> None:
        """Create the folder of products in progress, or take over the folder of an interrupted call."""
        self.has_products = self.output.claim_work_folder([self.config.matching, self.config.seed])
        self.has_work_folder = True
        if self.has_products:
            _LOG.info("resuming an interrupted estimation")

    def _extract_frames(self) -> Path:
        """Write the chosen frames of the video into a folder, and return the folder."""
        report_frames = part_of_progress(partial(self._report_progress, "photos"), 0.0, 0.9)

        def write_frames(folder: Path) -> FrameReport:
            return choose_frames(self.photos, folder, progress=report_frames)

        folder = self.output.make_folder("images", write_frames, resume_filling=True)
        frames = write_frames(folder)  # all frames are written now, so this call only reads their record
        self._add_note(
            format_count(frames.taken, f"of {frames.of} frames was taken", f"of {frames.of} frames were taken")
        )
        self._add_notes(frames.notes)
        return folder

    def _map_user_names(self, photos: list[Photo]) -> dict[str, str]:
        """Map names in images/ to names that the user knows: the source photo, or the frame with its time."""
        if self.is_video:
            times = frame_times(self.output.work / "images")
            return {name: f"{name} (at {seconds:.1f} s)" for name, seconds in times.items()}
        return {photo.name: photo.source for photo in photos if photo.face is None}

    def _user_name(self, name: str) -> str:
        return self.user_names.get(name, name)

    def _note_photos(self, photos: list[Photo], masks: dict[str, Path], copies_photos: bool, turned: bool) -> None:
        """Add notes about the treatment of the photos.

        Args:
            photos: all photos in use.
            masks: their masks by photo name.
            copies_photos: the photos were copied into images/.
            turned: photos that are stored on their side were turned upright.
        """
        self._add_notes(unreadable_sentences(select_unreadable(self.left_out), self.photo_count), logging.WARNING)
        if copies_photos:
            size = sum(path.stat().st_size for path in {photo.facts.path for photo in photos})
            where = self.out / "images"
            self._add_note(
                f"the photos ({size / 1e6:,.1f} MB) are copied into {where}; edits there do not change yours"
            )
        if masks:
            of_photos = f"of {len(photos):,} photos"
            self._add_note(f"{format_count(len(masks), f'{of_photos} has', f'{of_photos} have')} a mask")
        if faces := sum(photo.face is not None for photo in photos):
            panoramas = format_count(faces // len(CUBE_FACES), "panorama was", "panoramas were")
            self._add_note(f"{panoramas} cut into {faces} photos")
        sideways_count = sum(photo.facts.orientation != 1 for photo in photos)
        if sideways_count and turned:
            was_stored = "that the camera stored sideways"
            self._add_note(
                f"{format_count(sideways_count, f'photo {was_stored} was', f'photos {was_stored} were')} turned upright"
            )
        elif sideways_count:
            used = "stored sideways and used in that orientation"
            self._add_note(format_count(sideways_count, f"photo is {used}", f"photos are {used}"))

    def _run_stage(self, stage: str, *more: str) -> dict[str, Any]:
        """Run a stage in its process and return its answer."""
        began, job = time.monotonic(), self.output.work / "job.json"
        try:
            answer = run_stage(job, stage, partial(self._report_progress, stage), *more)
        finally:
            self.seconds[stage] = time.monotonic() - began
        self.has_products = True
        return answer

    def _run_mappers(self) -> list[str]:
        """Run both mappers, repeat them unless they agree, and return the names of their results.

        If one of the mappers crashes, a note is added.
        """
        answers: dict[str, dict[str, Any]] = {}
        failures = []
        for stage in ("global", "incremental"):
            try:
                answers[stage] = self._run_stage(stage)
            except StageCrashedError as error:
                failures.append(error)
                self._add_note(
                    f"the {stage} mapper failed, so the result of the other one is used without confirmation: {error}",
                    logging.WARNING,
                )
        if len(failures) == 2:
            raise failures[0]
        if "global" in answers and not answers.get("incremental", {}).get("agrees", False):
            try:
                answers["repeat"] = self._run_stage("repeat")
            except StageCrashedError as error:
                self._add_note(
                    f"the repetition of the mappers failed, so their first results are used: {error}",
                    logging.WARNING,
                )
        return [name for answer in answers.values() for name in answer["models"]]

    def _write_result(
        self, job: Job, features: dict[str, Any], matches: dict[str, Any], result: dict[str, Any]
    ) -> PosesReport:
        """Move the scene to its place and return the report; `result` is the answer of the last stage."""
        registered = set(result["registered"])
        decoded = [name for name in job.names if name not in features["unreadable"]]
        unposed = diagnosis.explain_unposed(decoded, features, matches, result)
        self.left_out |= {self._user_name(name): reason for name, reason in unposed.items()}
        if result["warning"]:
            self._add_note(result["warning"], logging.WARNING)
        if result["angle"] < _MIN_RAY_ANGLE_DEGREES:
            self._add_note(
                "the photos were taken from nearly one place, so depth is uncertain; move sideways between photos",
                logging.WARNING,
            )
        if blurred := diagnosis.blurred_photos(features) & registered:
            blurred_are = format_count(len(blurred), "of the posed photos is", "of the posed photos are")
            self._add_note(f"{blurred_are} more blurred than the others", logging.WARNING)
        report = PosesReport(
            self.out,
            self.photo_count,
            len(registered),
            len(result["sure"]),
            dict(sorted(self.left_out.items())),
            result["mapper"],
            result["why"],
            tuple(self.notes),
            {stage: round(seconds, 1) for stage, seconds in self.seconds.items()},
        )
        unsure = sorted(registered.difference(result["sure"]))
        # The folder is checked again, because another program may have written poses into it meanwhile.
        self.output.check_replaceable(self.photos, self.overwrite)
        self.output.install(job.model_folder("chosen"), asdict(report) | {"scene": str(self.out), "unsure": unsure})
        return report

    def _add_notes(self, sentences: Iterable[str], level: int = logging.INFO) -> None:
        for sentence in sentences:
            self._add_note(sentence, level)

    def _add_note(self, sentence: str, level: int = logging.INFO) -> None:
        """Add a sentence to the report, and log it at a level of `logging`."""
        self.notes.append(sentence)
        _LOG.log(level, sentence)

    def _report_progress(self, stage: str, event: Event) -> None:
        """Report a task of a stage, with its share of the whole work."""
        if not isinstance(event, TaskEvent) or event.share is None:
            return
        start, length = self._stage_interval(stage)
        self.reported_ratio = max(self.reported_ratio, min(start + length * event.share, 1.0))
        self.progress(TaskEvent(event.task, self.reported_ratio))

    def _stage_interval(self, stage: str) -> tuple[float, float]:
        """Return the share of the whole work before a stage, and that of the stage.

        If the mappers are not repeated, the last stage takes the share of the repetition, so that the share never
        jumps.
        """
        shares = dict(_STAGE_TIME_RATIOS)
        if stage == "finish" and "repeat" not in self.seconds:
            shares["finish"] += shares.pop("repeat")
        if self.is_video:
            rest = (1 - _VIDEO_FRAMES_TIME_RATIO) / (1 - shares["photos"])
            shares = {name: rest * value for name, value in shares.items()} | {"photos": _VIDEO_FRAMES_TIME_RATIO}
        stages = list(shares)
        return sum(shares[earlier] for earlier in stages[: stages.index(stage)]), shares[stage]


def _raise_if_scene_file(path: Path) -> None:
    """Raise HyrfDataError if a path is a file of splats or a model, which would otherwise be read as a video."""
    if not path.is_file():
        return
    if path.suffix.lower() == ".hyrf":
        raise HyrfDataError(
            f"{path}: this is a model, not photos or a video",
            fix=f"look at it with {suggest_command('view', path)}, or name photos",
        )
    if is_splats(path):
        model = path.with_suffix(".hyrf").name
        raise HyrfDataError(
            f"{path}: this is a file of splats, not photos or a video",
            fix=f"import it with {suggest_command('import', path, '-o', model)}, or name photos",
        )
