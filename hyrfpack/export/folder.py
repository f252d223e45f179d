"""Folders of static files that anyone can host: a player with a model, and a gallery of several."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count as counted
from pathlib import Path

from PIL import Image

from hyrfpack.atomic import pending_file, write_atomic
from hyrfpack.checks import check_type
from hyrfpack.evaluate import evaluate
from hyrfpack.evaluate.metrics import IDENTICAL_PSNR
from hyrfpack.export.pages import page_cameras, tell_of_size
from hyrfpack.export.poster import encode_poster, model_poster, splats_poster
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.format import describe
from hyrfpack.lock import exclusive_folder
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.scene import Scene
from hyrfpack.splats.files import READABLE_ENDINGS, read_splats
from hyrfpack.web.gallery import Card, encode_gallery
from hyrfpack.web.html import stage
from hyrfpack.web.player import element_script, encode_player, encode_readme
from hyrfpack.web.view import playable_file

POSTER, POSTER_BYTES = 640, 30_000  # pixels of its longer side; bytes
INDEX, LIST_PLAYER, README, ELEMENT = "index.html", "player.html", "README.txt", "hyrf-viewer.js"
SCENE, HYRF, POSTER_NAME = "scene", ".hyrf", "poster.jpg"

StrPath = str | os.PathLike[str]
Say = Callable[[str], None]


def player(
    source: StrPath | None,
    folder: StrPath,
    *,
    data: Scene | None = None,
    overwrite: bool = True,
    say: Say = lambda sentence: None,
) -> ExportReport:
    """Write a folder of static files that plays a scene on any web server: a page, the file itself and its picture.

    The page plays other files as well: those that its address names (`index.html?content=URL`) and those that are
    dropped on it. `hyrf-viewer.js` beside it is for other people's pages: `<hyrf-viewer src="scene.hyrf">`.

    Args:
        source: a `.hyrf` file or the folder of a run, or a file of splats (.ply, .spz, .splat, .sog), copied as it is;
            None for a player without a scene.
        folder: where; made when it is missing. Files of other names stay.
        data: photos of the scene, from where the picture is taken; else it is from where the file says.
        overwrite: replace files that are there; without it, they are an error.
        say: told what is going on.

    Raises:
        HyrfError: the file cannot be read, a file cannot be written, or another call is at work in the folder.
        TypeError: `data` is no Scene.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.export.player("bonsai.hyrf", "bonsai")
        >>> sorted(path.name for path in Path("bonsai").glob("*.h*"))
        ['index.html', 'scene.hyrf']
    """
    if data is not None:
        check_type("data", data, Scene)
    sources = [] if source is None else [source]
    check_folder(folder, sources, [data], overwrite=True, listed=False)
    with exclusive_folder(folder):
        check_folder(folder, sources, [data], overwrite=overwrite, listed=False)
        return _write_player(source, _Folder(Path(folder), overwrite), data, say)


def _write_player(source: StrPath | None, into: _Folder, data: Scene | None, say: Say) -> ExportReport:
    """As `player`, into a folder that this call holds."""
    title = _title(into.path)
    content = poster = None
    stages = {}
    description, count = "A player of 3D scenes", 0
    if source is not None:
        title = Path(source).stem
        source = playable_file(source)
        scene = _Content.read(source, data, say, scored=False)
        count = scene.count
        content, poster = _names([source], listed=False)[0]
        into.copy(content, source)
        stages = {content: scene.stage} if scene.stage else {}
        if scene.poster is None:
            poster = None
        else:
            into.write(poster, encode_poster(scene.poster, "JPEG", POSTER_BYTES))
        description = f"{count:,} Gaussians, {scene.length:,} bytes"
    into.write(ELEMENT, element_script())
    into.write(README, encode_readme(title, INDEX, INDEX, element=content or "URL"))
    into.write(INDEX, encode_player(title, content=content, poster=poster, description=description, stages=stages))
    return ExportReport(str(into.path), into.bytes, count, native=source is not None)


def gallery(
    sources: Sequence[StrPath],
    folder: StrPath,
    *,
    data: Sequence[Scene | None] = (),
    overwrite: bool = True,
    say: Say = lambda sentence: None,
) -> ExportReport:
    """Write a folder of static files that shows several scenes: a page that lists them, a player, and the files.

    Args:
        sources: as of `player`, at least one; the folder of a run gives its name to the scene.
        folder: where; made when it is missing. Files of other names stay.
        data: photos of each scene, or None; held-out ones score it, and the list tells so. Without them it tells how
            well a model fits the photos it was trained on, where its file says.
        overwrite: replace files that are there; without it, they are an error.
        say: told what is going on.

    Raises:
        HyrfError: a file cannot be read or written, or another call is at work in the folder.
        ValueError: there are not as many `data` as `sources`.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.export.gallery(["bonsai.hyrf", "bonsai.ply"], "gallery")
        >>> sorted(path.name for path in Path("gallery").glob("bonsai*"))
        ['bonsai-2.jpg', 'bonsai-2.ply', 'bonsai.hyrf', 'bonsai.jpg']
    """
    scenes = list(data) or [None] * len(sources)
    if len(scenes) != len(sources) or not sources:
        raise ValueError(f"{len(scenes)} sets of photos for {len(sources)} models; give one for each, or none at all")
    for scene in scenes:
        if scene is not None:
            check_type("data", scene, Scene)
    check_folder(folder, sources, scenes, overwrite=True, listed=True)
    with exclusive_folder(folder):
        check_folder(folder, sources, scenes, overwrite=overwrite, listed=True)
        return _write_gallery(sources, _Folder(Path(folder), overwrite), scenes, say)


def _write_gallery(sources: Sequence[StrPath], into: _Folder, scenes: Sequence[Scene | None], say: Say) -> ExportReport:
    """As `gallery`, into a folder that this call holds."""
    contents = []
    for source, scene in zip(sources, scenes, strict=True):  # all, before anything is written
        say(f"reading {source}")
        contents.append(_Content.read(playable_file(source), scene, say, scored=True))
    cards = []
    for source, shown, (content, poster) in zip(sources, contents, _names(sources, listed=True), strict=True):
        into.copy(content, playable_file(source))
        if shown.poster is not None:
            into.write(poster, encode_poster(shown.poster, "JPEG", POSTER_BYTES))
        picture = None if shown.poster is None else poster
        cards.append(Card(Path(source).stem, content, picture, shown.count, shown.length, shown.quality))
    title = _title(into.path)
    pairs = zip(cards, contents, strict=True)
    stages = {card.content: shown.stage for card, shown in pairs if shown.stage}
    into.write(LIST_PLAYER, encode_player(title, stages=stages))
    into.write(README, encode_readme(title, LIST_PLAYER, INDEX))
    into.write(INDEX, encode_gallery(title, cards, LIST_PLAYER))
    return ExportReport(str(into.path), into.bytes, sum(card.count for card in cards), native=True)


def check_folder(
    folder: StrPath, sources: Sequence[StrPath], scenes: Sequence[Scene | None], *, overwrite: bool, listed: bool
) -> None:
    """Refuse a folder that `player`, or if `listed` `gallery`, may not or cannot write into.

    Args:
        folder, sources, scenes: theirs.
        overwrite: files that are there may be replaced, but for those that are read.

    Raises:
        HyrfError: what it is.
    """
    names = [name for pair in _names(sources, listed=listed) for name in pair]
    names += [README, INDEX, LIST_PLAYER if listed else ELEMENT]
    files = [playable_file(source) for source in sources]
    for scene in scenes or [None]:
        Outputs(*files, scene=scene, overwrite=overwrite).folder(folder, names)


@dataclass(frozen=True)
class _Content:
    """A file to be played.

    Attributes:
        count: Gaussians in it.
        length: its bytes.
        poster: what it looks like; None where that cannot be told.
        quality: how good it is, in words; empty where nothing is known.
        stage: from where to look at it, see `hyrfpack.web.html.stage`; None of splats.
    """

    count: int
    length: int
    poster: Image.Image | None
    quality: str = ""
    stage: dict | None = None

    @classmethod
    def read(cls, path: StrPath, data: Scene | None, say: Say, *, scored: bool) -> _Content:
        """Read a file whole, so that none goes along that is damaged.

        Args:
            path, data, say: as of `player`.
            scored: whether to find out how good it is.

        Raises:
            HyrfError: it cannot be read.
        """
        length = os.path.getsize(path) if os.path.isfile(path) else 0
        if _ending(path) != HYRF:
            splats = read_splats(path)
            return cls(len(splats), length, splats_poster(splats, POSTER))
        read = Source.read(path, data)
        tell_of_size(path, length, say)
        quality = _quality(path, read.model, data, say) if scored else ""
        cameras = page_cameras(read)
        poster = model_poster(read.model, cameras[0], POSTER)
        return cls(len(read.model), length, poster, quality, stage(cameras, read.up, read.center))


def _quality(path: StrPath, model: HybridModel, data: Scene | None, say: Say) -> str:
    """How good a model is, in words: on held-out photos if there are some, or else by its file's own account."""
    if data is not None and data.test:
        say(f"scoring on {_photos(len(data.test))}")
        scores = evaluate(model, data.test)
        return f"{scores.psnr:.2f} dB on {_photos(len(scores.views))}"
    provenance = describe(path)["provenance"]
    stated, choices = provenance.get("psnr"), provenance.get("choices")
    if not isinstance(stated, float) or not 0 < stated < IDENTICAL_PSNR:
        return ""
    imported = isinstance(choices, dict) and "imported" in choices
    return f"{stated:.1f} dB " + ("against the splats it was made of" if imported else "on its training photos")


class _Folder:
    """A folder to write into, each file whole or not at all, and the bytes that have been.

    Its files name each other, so that none of them can take another name where its own is taken: that is an error.
    """

    def __init__(self, path: Path, overwrite: bool) -> None:
        self.path, self.overwrite, self.bytes = path, overwrite, 0

    def write(self, name: str, data: bytes) -> None:
        write_atomic(self.path / name, data, overwrite=self.overwrite, rename=False)
        self.bytes += len(data)

    def copy(self, name: str, source: StrPath) -> None:
        length = os.path.getsize(source)
        with pending_file(self.path / name, length, overwrite=self.overwrite, rename=False) as pending:
            shutil.copyfile(source, pending.temporary)
        self.bytes += os.path.getsize(self.path / name)


def _names(sources: Sequence[StrPath], *, listed: bool) -> list[tuple[str, str]]:
    """File names, for models and their pictures, that differ in whatever file system and need no quoting."""
    if not listed:
        return [(f"{SCENE}{_ending(source)}", POSTER_NAME) for source in sources]
    names: list[str] = []
    for source in sources:
        stem = re.sub(r"[^\w.-]+", "-", Path(source).stem).strip("-.") or SCENE
        taken = {name.casefold() for name in names}
        numbered = (stem if number == 1 else f"{stem}-{number}" for number in counted(1))
        names.append(next(name for name in numbered if name.casefold() not in taken))
    return [(f"{name}{_ending(source)}", f"{name}.jpg") for name, source in zip(names, sources, strict=True)]


def _ending(path: StrPath) -> str:
    """Of a file to be played: those that are not of splats are taken for models."""
    ending = Path(path).suffix.lower()
    return ending if ending in READABLE_ENDINGS else HYRF


def _photos(count: int) -> str:
    return f"{count:,} held-out photo{'' if count == 1 else 's'}"


def _title(folder: StrPath) -> str:
    return Path(os.path.abspath(folder)).name or "hyrfpack"
