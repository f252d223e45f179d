"""Folders of static files for any web server: a player of one model, and a gallery of several."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count as count_up
from itertools import zip_longest
from pathlib import Path

from PIL import Image

from hyrfpack.cameras.capture import PSNR_BEFORE_COMPRESSION, PSNR_BEFORE_EDIT, PSNR_BEFORE_KEY, place_photos
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.checks import check_several, check_type
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.evaluate.metrics import IDENTICAL_PSNR
from hyrfpack.export.pages import choose_page_cameras, suggest_compression
from hyrfpack.export.poster import (
    encode_poster,
    frame_splats,
    render_model_poster,
    render_splats_poster,
)
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.format import describe_file
from hyrfpack.format.input_folder import find_input_folder
from hyrfpack.format.run_folder import name_model
from hyrfpack.format.scene_folder import SceneFolder, as_single_file, is_scene
from hyrfpack.lock import exclusive_folder
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.outputs import Outputs
from hyrfpack.outputs.indexed_folder import IndexedFolder
from hyrfpack.scene import Scene
from hyrfpack.splats.files import READABLE_ENDINGS, read_splats
from hyrfpack.splats.names import is_splats
from hyrfpack.web.gallery import STYLE_FILE_NAME as GALLERY_STYLE_NAME
from hyrfpack.web.gallery import Card, encode_gallery, encode_gallery_style
from hyrfpack.web.html import encode_views
from hyrfpack.web.player import encode_element_script, encode_player, encode_player_files, encode_readme
from hyrfpack.web.view import find_playable_file

_LOG = logging.getLogger(__name__)

POSTER_LONGEST_SIDE_PIXELS = 640
MAX_POSTER_BYTES = 30_000
INDEX_NAME = "index.html"
GALLERY_PLAYER_NAME = "player.html"
README_NAME = "README.txt"
ELEMENT_SCRIPT_NAME = "hyrf-viewer.js"
DEFAULT_SCENE_STEM = "scene"
HYRF_ENDING = ".hyrf"
POSTER_NAME = "poster.jpg"

StrPath = str | os.PathLike[str]


def export_player(
    source: StrPath | None,
    folder: StrPath,
    *,
    data: Scene | None = None,
    overwrite: bool = True,
    title: str | None = None,
    credit: str = "",
    editable: bool = False,
) -> ExportReport:
    """Write a folder of static files that plays a scene on any web server: a page, the file itself and a poster.

    The page also plays a file that its address names (`index.html?content=URL`) or that a user drops on it. The script
    `hyrf-viewer.js` in the same folder embeds the player into other pages: `<hyrf-viewer src="scene.hyrf">`.

    Args:
        source: a `.hyrf` file or the folder of a run, or a file of splats (.ply, .spz, .splat, .sog), which is copied
            unchanged; None for a player without a scene.
        folder: output folder; created if it is missing. Files with other names stay.
        data: photos of the scene; the poster is rendered from the first camera. Without them it is rendered from a
            camera that the file keeps or suggests.
        overwrite: replace existing files; if False, an existing file is an error.
        title: title of the page. Default: the name of the source, or of the folder.
        credit: text below the title, such as the author and the licence.
        editable: include a panel that crops, cleans, turns and measures the scene.

    Raises:
        HyrfError: the file cannot be read, a file cannot be written, the photos do not belong to the model, or another
            call is writing into the folder.
        TypeError: `data` is not a Scene.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.export_player("bonsai.hyrf", "bonsai")
        >>> sorted(path.name for path in Path("bonsai").glob("*.h*"))
        ['index.html', 'scene.hyrf']
    """
    if data is not None:
        check_type("data", data, Scene)
    sources = [] if source is None else [source]
    check_export_folder(folder, sources, [data], overwrite=True, is_gallery=False)
    with exclusive_folder(folder):
        check_export_folder(folder, sources, [data], overwrite=overwrite, is_gallery=False)
        if source is not None:
            suggest_compression(source)
        with ExitStack() as open_resources:
            file = None if source is None else open_resources.enter_context(as_single_file(source))
            output = open_resources.enter_context(IndexedFolder(Path(folder), INDEX_NAME, overwrite))
            return _write_player(file, output, data, title, credit, editable)


def _write_player(
    source: StrPath | None,
    output: IndexedFolder,
    data: Scene | None,
    title: str | None,
    credit: str,
    editable: bool,
) -> ExportReport:
    """Write the files of `export_player` into a folder that the caller has locked."""
    if title is None:
        title = _name_folder(output.path) if source is None else name_model(source)
    content_name = poster_name = None
    views = {}
    description, count = "A player of 3D scenes", 0
    if source is not None:
        source = find_playable_file(source)
        content = _PlayableContent.read(source, data, with_quality=False)
        count = content.count
        content_name, poster_name = _choose_file_names([source], is_gallery=False)[0]
        output.copy(content_name, source)
        views = {content_name: content.views} if content.views else {}
        if content.poster is None:
            poster_name = None
        else:
            output.write(poster_name, encode_poster(content.poster, "JPEG", MAX_POSTER_BYTES))
        description = f"{format_count(count, 'Gaussian')}, {content.length:,} bytes"
    output.write(ELEMENT_SCRIPT_NAME, encode_element_script())
    output.write(README_NAME, encode_readme(title, INDEX_NAME, INDEX_NAME, element=content_name or "URL"))
    for name, encoded in encode_player_files(editable).items():
        output.write(name, encoded)
    page = encode_player(
        title,
        content=content_name,
        poster=poster_name,
        description=description,
        views=views,
        in_folder=True,
        credit=credit,
        editable=editable,
        file=Path(source).name if editable and source is not None else None,
    )
    output.write(INDEX_NAME, page)
    return ExportReport(str(output.path), output.bytes, count, native=source is not None)


def export_gallery(
    sources: Sequence[StrPath],
    folder: StrPath,
    *,
    data: Sequence[Scene | None] = (),
    overwrite: bool = True,
    title: str | None = None,
    credit: str = "",
    editable: bool = False,
) -> ExportReport:
    """Write a folder of static files that shows several scenes: a page that lists them, a player, and the files.

    Args:
        sources: at least one source as in `export_player`; a scene from the folder of a run is named after the folder.
        folder: output folder; created if it is missing. Files with other names stay.
        data: photos of each scene, or None. Held-out photos score a model, and the list shows the score. Without them
            the list shows how well the model fits its training photos or the splats that it was imported from, if the
            file states it. It says so if this was measured before compression or an edit.
        overwrite: replace existing files; if False, an existing file is an error.
        title: title of the list. Default: the name of the folder.
        credit: text below the title of each scene.
        editable: include a panel that crops, cleans, turns and measures a scene.

    Raises:
        HyrfError: a file cannot be read or written, photos do not belong to their model, or another call is writing
            into the folder.
        ValueError: the numbers of `data` and `sources` differ.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.export_gallery(["bonsai.hyrf", "bonsai.ply"], "gallery")
        >>> sorted(path.name for path in Path("gallery").glob("bonsai*"))
        ['bonsai-2.jpg', 'bonsai-2.ply', 'bonsai.hyrf', 'bonsai.jpg']
    """
    check_several("sources", sources)
    if not sources:
        raise ValueError("there are no models; give at least one")
    scenes = list(data) or [None] * len(sources)
    if len(scenes) != len(sources):
        raise ValueError(
            f"{format_count(len(scenes), 'set')} of photos for {format_count(len(sources), 'model')}; give one for "
            "each, or none at all"
        )
    for scene in scenes:
        if scene is not None:
            check_type("data", scene, Scene)
    check_export_folder(folder, sources, scenes, overwrite=True, is_gallery=True)
    with exclusive_folder(folder):
        check_export_folder(folder, sources, scenes, overwrite=overwrite, is_gallery=True)
        with ExitStack() as open_resources:
            for source in sources:
                suggest_compression(source)
            files = [open_resources.enter_context(as_single_file(source)) for source in sources]
            output = open_resources.enter_context(IndexedFolder(Path(folder), INDEX_NAME, overwrite))
            return _write_gallery(sources, files, output, scenes, title, credit, editable)


def _write_gallery(
    sources: Sequence[StrPath],
    files: Sequence[Path],
    output: IndexedFolder,
    scenes: Sequence[Scene | None],
    title: str | None,
    credit: str,
    editable: bool,
) -> ExportReport:
    """Write the files of `export_gallery` into a folder that the caller has locked.

    Args:
        sources: `sources` of `export_gallery`.
        files: the single file of each source.
        output, scenes, title, credit, editable: the folder, and arguments of `export_gallery`.
    """
    playable, contents = [find_playable_file(file) for file in files], []
    for source, file, scene in zip(sources, playable, scenes, strict=True):  # all are read before anything is written
        _LOG.info(f"reading {source}")
        contents.append(_PlayableContent.read(file, scene, with_quality=True))
    cards = []
    for source, file, content, (content_name, poster_name) in zip(
        sources, playable, contents, _choose_file_names(sources, is_gallery=True), strict=True
    ):
        output.copy(content_name, file)
        if content.poster is not None:
            output.write(poster_name, encode_poster(content.poster, "JPEG", MAX_POSTER_BYTES))
        picture = None if content.poster is None else poster_name
        cards.append(Card(_name_source(source), content_name, picture, content.count, content.length, content.quality))
    title = _name_folder(output.path) if title is None else title
    pairs = zip(cards, contents, strict=True)
    views = {card.content: content.views for card, content in pairs if content.views}
    for name, encoded in encode_player_files(editable).items():
        output.write(name, encoded)
    page = encode_player(title, views=views, gallery=INDEX_NAME, in_folder=True, credit=credit, editable=editable)
    output.write(GALLERY_PLAYER_NAME, page)
    output.write(GALLERY_STYLE_NAME, encode_gallery_style())
    output.write(README_NAME, encode_readme(title, GALLERY_PLAYER_NAME, INDEX_NAME))
    output.write(INDEX_NAME, encode_gallery(title, cards, GALLERY_PLAYER_NAME))
    return ExportReport(str(output.path), output.bytes, sum(card.count for card in cards), native=True)


def check_export_folder(
    folder: StrPath, sources: Sequence[StrPath], scenes: Sequence[Scene | None], *, overwrite: bool, is_gallery: bool
) -> None:
    """Check that `export_player`, or `export_gallery` if `is_gallery`, may write into a folder.

    Args:
        folder, sources, scenes: arguments of `export_player` or `export_gallery`.
        overwrite: existing files may be replaced, except those that are read.
        is_gallery: check for the files of `export_gallery`.

    Raises:
        HyrfError: a file must not be replaced or cannot be written, or photos are given with splats.
    """
    for source, scene in zip(sources, scenes, strict=False):
        if scene is not None and is_splats(source):
            raise HyrfError(f"{source}: photos go with .hyrf files only", fix="leave out `data`, or this file")
    names = [name for pair in _choose_file_names(sources, is_gallery=is_gallery) for name in pair]
    names += [README_NAME, INDEX_NAME, *encode_player_files()]
    names += [GALLERY_PLAYER_NAME, GALLERY_STYLE_NAME] if is_gallery else [ELEMENT_SCRIPT_NAME]
    files = [find_playable_file(source) for source in sources]
    input_folders = [find_input_folder(file) for file in files] or [None]
    for input_folder, scene in zip_longest(input_folders, scenes):
        Outputs(*files, folders=[input_folder], scene=scene, overwrite=overwrite).folder(folder, names)


@dataclass(frozen=True)
class _PlayableContent:
    """A file to be played, with the facts and the picture that a page shows for it.

    Attributes:
        count: number of Gaussians.
        length: size in bytes.
        poster: a picture of the scene, or None if none can be made.
        quality: quality of the model in words; empty if unknown.
        views: initial cameras for the page, see `hyrfpack.web.html.encode_views`; None if there is no poster.
    """

    count: int
    length: int
    poster: Image.Image | None
    quality: str = ""
    views: dict | None = None

    @classmethod
    def read(cls, path: StrPath, data: Scene | None, *, with_quality: bool) -> _PlayableContent:
        """Read a whole file, so that no damaged file is published.

        Args:
            path, data: `source` and `data` of `export_player`.
            with_quality: whether to determine the quality.

        Raises:
            HyrfError: the file cannot be read.
        """
        length = os.path.getsize(path) if os.path.isfile(path) else 0
        if _choose_ending(path) != HYRF_ENDING:
            splats = read_splats(path)
            frame = frame_splats(splats)
            if frame is None:
                return cls(len(splats), length, None)
            viewpoint = Viewpoint.from_frame(frame.center, frame.scale)
            poster = render_splats_poster(splats, frame, viewpoint.camera, POSTER_LONGEST_SIDE_PIXELS)
            views = encode_views([viewpoint.camera], viewpoint.up, viewpoint.center)
            return cls(len(splats), length, poster, views=views)
        data = place_photos(describe_file(path), data)
        loaded = Source.read(path, data)
        quality = _describe_quality(path, loaded.all_parts, data) if with_quality else ""
        cameras = choose_page_cameras(loaded)
        poster = render_model_poster(loaded.all_parts, cameras[0], POSTER_LONGEST_SIDE_PIXELS)
        return cls(len(loaded.all_parts), length, poster, quality, encode_views(cameras, loaded.up, loaded.center))


def _describe_quality(path: StrPath, model: HybridModel | MergedModel, data: Scene | None) -> str:
    """Describe the quality of a model in words, on held-out photos if there are any, else as stated in its file."""
    if data is not None and data.test:
        _LOG.info(f"scoring on {format_count(len(data.test), 'held-out photo')}")
        scores = evaluate_model(model, data.test)
        return f"{scores.psnr:.2f} dB on {format_count(len(scores.views), 'held-out photo')}"
    if isinstance(model, MergedModel):
        return ""
    facts = describe_file(path)
    provenance = facts["provenance"]
    stated_psnr, choices = provenance.get("psnr"), provenance.get("choices")
    if type(stated_psnr) not in (int, float) or not 0 < stated_psnr < IDENTICAL_PSNR:
        return ""
    imported = isinstance(choices, dict) and "imported" in choices
    quality = f"{stated_psnr:.1f} dB " + ("against the splats it was made of" if imported else "on its training photos")
    # Earlier versions did not store that a model was scored before compression. Training writes profile "raw".
    is_trained_and_compressed = not imported and facts["profile"] != "raw"
    change = provenance.get(PSNR_BEFORE_KEY)
    if change not in (PSNR_BEFORE_COMPRESSION, PSNR_BEFORE_EDIT):
        change = PSNR_BEFORE_COMPRESSION if is_trained_and_compressed else None
    return quality if change is None else f"{quality} before {change}"


def _choose_file_names(sources: Sequence[StrPath], *, is_gallery: bool) -> list[tuple[str, str]]:
    """Choose names for the files and their posters that are distinct on any file system and need no quoting."""
    if not is_gallery:
        return [(f"{DEFAULT_SCENE_STEM}{_choose_ending(source)}", POSTER_NAME) for source in sources]
    names: list[str] = []
    for source in sources:
        stem = re.sub(r"[^\w.-]+", "-", _name_source(source)).strip("-.") or DEFAULT_SCENE_STEM
        used_names = {name.casefold() for name in names}
        numbered = (stem if number == 1 else f"{stem}-{number}" for number in count_up(1))
        names.append(next(name for name in numbered if name.casefold() not in used_names))
    return [(f"{name}{_choose_ending(source)}", f"{name}.jpg") for name, source in zip(names, sources, strict=True)]


def _name_source(source: StrPath) -> str:
    """Return the name of a model, or of a scene folder if its manifest is given."""
    return name_model(SceneFolder(source).path if is_scene(source) else source) or DEFAULT_SCENE_STEM


def _choose_ending(path: StrPath) -> str:
    """Return the ending of a file to be played; ".hyrf" for folders and for all files without an ending of splats."""
    ending = Path(path).suffix.lower()
    return ending if ending in READABLE_ENDINGS and not os.path.isdir(path) else HYRF_ENDING


def _name_folder(folder: StrPath) -> str:
    return Path(os.path.abspath(folder)).name or "hyrfpack"
