"""The comparison page of several runs: its numbers, pictures and errors; text from files is never read as HTML."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from commands import refused, succeeded
from PIL import Image
from scenes import QUIET_CONTEXT, ball_scene

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.figures import PAPER_COLOR
from hyrfpack.report.run import choose_short_names, read_run
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig

HOSTILE_TEXT = "<script>alert(1)</script><b a=\"'&{{style}}"


def make_scene(**options) -> Scene:
    """Return a scene of balls with two of its eight photos held out."""
    whole = ball_scene(side=24, points=60, **options)
    return dataclasses.replace(whole, train=whole.train[2:], test=whole.train[:2])


def train_run(folder: Path, of: Scene | None = None, **settings) -> Path:
    hyrfpack.train_model(
        of or make_scene(), folder, TrainConfig(steps=12, max_gaussians=60, **settings), context=QUIET_CONTEXT
    )
    return folder


@pytest.fixture(scope="module")
def original_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs a and b, which differ in seed and one setting, and a run of another scene. Tests must not change them."""
    root = tmp_path_factory.mktemp("runs")
    train_run(root / "a")
    train_run(root / "b", seed=1, ssim_weight=0.3)
    train_run(root / "far", make_scene(offset=(9, 0, 0), scale=2.0))
    return root


@pytest.fixture
def runs(original_runs: Path, tmp_path: Path) -> list[Path]:
    """Copies of runs a and b."""
    return [Path(shutil.copytree(original_runs / name, tmp_path / name)) for name in "ab"]


def read_metrics(run: Path) -> dict:
    return json.loads((run / "metrics.json").read_text())


def change_metrics(run: Path, change: Callable[[dict], object]) -> Path:
    values = read_metrics(run)
    change(values)
    (run / "metrics.json").write_text(json.dumps(values))
    return run


class Page(HTMLParser):
    """A parsed page: table rows, tags with their attributes, and the data of the script."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.rows: dict[str, list[str]] = {}
        self.tags: list[tuple[str, dict]] = []
        self.words = ""
        self._cells: list[str] = []
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag == "tr":
            self._cells = []
        if tag in ("td", "th"):
            self._cells.append("")

    def handle_data(self, data):
        self.words += data
        if self.tags and self.tags[-1][0] == "script" and data.startswith('{"runs"'):
            self.given = json.loads(data)
        if self._cells:
            self._cells[-1] += data

    def handle_endtag(self, tag):
        if tag == "tr":
            self.rows[self._cells[0]] = self._cells[1:]
            self._cells = []

    def picture(self, view: int, source: int) -> np.ndarray:
        data = base64.b64decode(self.given["views"][view]["pictures"][source].partition(",")[2])
        return np.asarray(Image.open(io.BytesIO(data)))


def test_the_page_shows_all_results_and_only_settings_that_differ(runs, tmp_path):
    (runs[1] / "small.hyrf").write_bytes(b"x" * 1234)
    report = hyrfpack.compare_runs(runs, tmp_path / "page.html")
    page, (a, b) = Page(tmp_path / "page.html"), map(read_metrics, runs)
    assert page.rows["held-out PSNR (dB)"] == [f"{run['evaluation']['psnr']:.2f}" for run in (a, b)]
    assert page.rows["held-out SSIM"] == [f"{run['evaluation']['ssim']:.4f}" for run in (a, b)]
    assert page.rows["Gaussians"] == ["60", "60"] and page.rows["steps"] == ["12", "12"]
    assert page.rows["seed"] == ["0", "1"]
    assert page.rows["bytes of model.hyrf"] == [f"{(run / 'model.hyrf').stat().st_size:,}" for run in runs]
    assert page.rows["bytes of small.hyrf"] == ["-", "1,234"]
    assert page.rows["ssim weight"] == ["0.2", "0.3"]
    assert not {"precision", "device", "density: rounds", "max gaussians"} & set(page.rows)
    assert "held-out LPIPS" not in page.rows
    assert report.runs == ["a", "b"] and report.doubts == []
    assert report.bytes == (tmp_path / "page.html").stat().st_size


def test_processes_are_shown_if_they_differ_and_the_size_of_photos_once(runs, tmp_path):
    def change(values: dict) -> None:
        values["processes"] = 2
        values["scene"]["max_size"] = values["scene"]["reading"]["max_size"] = 40

    for run, size in zip(runs, (80, 40), strict=True):
        change_metrics(run, lambda values, size=size: values["scene"].update(max_size=size, reading={"max_size": size}))
    change_metrics(runs[1], change)
    hyrfpack.compare_runs(runs, tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    assert page.rows["processes"] == ["1", "2"]
    assert {name: row for name, row in page.rows.items() if "max size" in name} == {"scene: max size": ["80", "40"]}


@pytest.mark.acceptance
def test_the_best_score_is_marked_where_scores_can_be_compared(runs, tmp_path):
    def best(page: Page) -> list[str]:
        return [name for name, attributes in page.tags if attributes.get("class") == "best"]

    for run, psnr in zip(runs, (20.0, 21.0), strict=True):
        scores = {"psnr": psnr, "ssim": 0.8 - psnr / 100}
        change_metrics(run, lambda values, scores=scores: values["evaluation"].update(scores))
    hyrfpack.compare_runs(runs, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert '<td class="best">21.00</td>' in text and '<td class="best">0.6000</td>' in text
    assert best(Page(tmp_path / "page.html")) == ["td", "td"]
    darken_photo(runs[1] / "views" / "000.png")
    hyrfpack.compare_runs(runs, tmp_path / "page.html", overwrite=True)
    assert best(Page(tmp_path / "page.html")) == []


def test_scores_at_predicted_exposure_of_earlier_versions_are_omitted(runs, tmp_path):
    for run in runs:
        change_metrics(run, lambda values: values["evaluation"].update(psnr_predicted=12.34, ssim_predicted="none"))
    hyrfpack.compare_runs(runs, tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    assert "12.34" not in page.words and not [name for name in page.rows if "predicted" in name]


def test_each_view_shows_the_photo_and_all_renders_with_scores(runs, tmp_path):
    hyrfpack.compare_runs(runs, tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    assert page.given["runs"] == ["a", "b"] and [view["name"] for view in page.given["views"]] == ["000.png", "001.png"]
    held_out = make_scene().test[1]
    times = 400 // 24  # small pictures are enlarged by this factor
    assert (page.picture(1, 0)[::times, ::times] == held_out.load().rgb).all()
    for number, run in enumerate(runs):
        drawn = hyrfpack.render_view(hyrfpack.load_model(run / "model.hyrf"), held_out.camera).rgb.clamp(0, 1)
        assert (page.picture(1, 1 + number)[::times, ::times] == (drawn * 255).round().numpy()).all()
        score = read_metrics(run)["evaluation"]["views"][1]
        assert page.given["views"][1]["scores"][number] == [score["psnr"], score["ssim"], None]


def test_only_views_with_pictures_in_all_runs_are_shown(runs, tmp_path):
    (runs[1] / "views" / "000.png").unlink()
    assert hyrfpack.compare_runs(runs, tmp_path / "page.html").views == ["001.png"]
    shutil.rmtree(runs[0] / "views")
    assert hyrfpack.compare_runs(runs, tmp_path / "bare.html").views == []
    assert 'id="views"' not in (tmp_path / "bare.html").read_text()


@pytest.mark.acceptance
def test_a_curve_has_seconds_and_one_of_an_earlier_version_a_note_about_their_absence(runs, tmp_path):
    first = read_metrics(runs[0])["curve"]
    assert [record.seconds for record in read_run(runs[0]).curve] == [record["seconds"] for record in first]
    hyrfpack.compare_runs(runs, tmp_path / "page.html")
    assert "spread evenly" not in Page(tmp_path / "page.html").words
    change_metrics(runs[1], lambda values: [record.pop("seconds") for record in values["curve"]])
    hyrfpack.compare_runs(runs, tmp_path / "page.html", overwrite=True)
    assert "Times of single steps are missing for b" in Page(tmp_path / "page.html").words


@pytest.mark.usefixtures("drawn_figures")
def test_the_same_runs_give_the_same_bytes_and_a_page_fetches_nothing(runs, tmp_path):
    pages = [tmp_path / "one.html", tmp_path / "two.html"]
    for page in pages:
        hyrfpack.compare_runs(runs, page)
    text = pages[0].read_text()
    assert text == pages[1].read_text()
    assert "default-src 'none'" in text and "unsafe" not in text
    named = [attributes for _, attributes in Page(pages[0]).tags]
    addresses = [attributes[name] for attributes in named for name in ("src", "href", "srcset") if name in attributes]
    assert addresses and all(not address or address.startswith("data:") for address in addresses)


def test_text_from_files_is_never_read_as_html(runs, tmp_path):
    plain = [name for name, _ in Page(Path(hyrfpack.compare_runs(runs, tmp_path / "plain.html").file)).tags]
    hostile = runs[1].rename(tmp_path / HOSTILE_TEXT.replace("/", ":"))
    for run in (runs[0], hostile):
        (run / "views" / "000.png").rename(run / "views" / f"{HOSTILE_TEXT.replace('/', '_')}.png")

        def poison(values: dict, run: Path = run) -> None:
            values["notes"] = [HOSTILE_TEXT, run.name]
            values["choices"] = {HOSTILE_TEXT: run.name}
            values["settings"] |= {HOSTILE_TEXT: run.name}
            values["device"] = HOSTILE_TEXT + run.name
            values["evaluation"]["views"][0]["name"] = HOSTILE_TEXT.replace("/", "_")

        change_metrics(run, poison)
    (hostile / f"{HOSTILE_TEXT.replace('/', '_')}.hyrf").write_bytes(b"")
    hyrfpack.compare_runs([runs[0], hostile], tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    assert {name for name, _ in page.tags} == set(plain)
    assert [name for name, _ in page.tags].count("script") == plain.count("script") == 2
    assert page.rows[HOSTILE_TEXT] == ["a", HOSTILE_TEXT.replace("/", ":")]
    assert "alert" not in re.sub(r"&lt;|\\u003c", "", " ".join(str(attributes) for _, attributes in page.tags))


# -- what cannot be compared -----------------------------------------------------------------------------------------


def darken_photo(sheet: Path) -> None:
    """Replace the photo in a picture by a darker one, and keep captions and gaps."""
    pixels = np.array(Image.open(sheet).convert("RGB"))
    pixels[(pixels != PAPER_COLOR).any(axis=2)] //= 2
    Image.fromarray(pixels).save(sheet)


def test_different_photos_of_the_same_name_are_noted_and_not_shown(runs, original_runs, tmp_path):
    darken_photo(runs[1] / "views" / "001.png")
    report = hyrfpack.compare_runs(runs, tmp_path / "page.html")
    (sentence,) = report.doubts
    assert "such as '001.png'" in sentence and sentence in Page(tmp_path / "page.html").words
    assert report.views == ["000.png"]


def test_different_cameras_are_noted(runs, original_runs, tmp_path):
    shutil.rmtree(runs[0] / "views")
    report = hyrfpack.compare_runs([runs[0], original_runs / "far"], tmp_path / "page.html")
    assert len(report.doubts) == 1 and "trained from different cameras" in report.doubts[0]


@pytest.mark.parametrize("which", [[0], [0, 1]], ids=["one", "all"])
def test_runs_without_held_out_photos_are_compared_by_the_rest(which, runs, tmp_path):
    for number in which:
        change_metrics(runs[number], lambda values: values.pop("evaluation"))
    report = hyrfpack.compare_runs(runs, tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    assert report.views == [] and len(report.doubts) == 1 and "o photos were held out in" in report.doubts[0]
    assert ("held-out PSNR (dB)" in page.rows) == (len(which) == 1)
    assert page.rows["Gaussians"] == ["60", "60"] and "training" in page.words


def test_other_held_out_photos_are_rejected(runs, tmp_path):
    change_metrics(runs[1], lambda values: values["evaluation"]["views"].pop())
    with pytest.raises(
        HyrfError, match=r"the runs 'a' and 'b' hold out different photos \(2 and 1; '001.png' is in only one of them\)"
    ):
        hyrfpack.compare_runs(runs, tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


BROKEN_METRICS = {
    "text": ("nothing", "it is not JSON"),
    "cut": ('{"settings": {"steps": 1', "it is not JSON"),
    "nested": ("[" * 100_000, "it is not JSON"),
    "bytes": (b"\xff\xfe", "it is not JSON"),
    "list": ("[1]", "it is not an object"),
    "nan": ('{"seconds": NaN}', "a number in it is NaN"),
}


@pytest.mark.parametrize("kind", BROKEN_METRICS)
def test_files_that_are_no_metrics_are_a_clear_error(kind, runs, tmp_path):
    text, reason = BROKEN_METRICS[kind]
    (runs[1] / "metrics.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    sentence = refused("compare", *runs, "-o", tmp_path / "page.html")
    assert f"{runs[1]}/metrics.json: the metrics are damaged ({reason})" in sentence


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda values: values.pop("curve"), "curve"),
        (lambda values: values.update(curve=[]), "curve"),
        (lambda values: values["curve"][3].update(psnr="20"), "psnr"),
        (lambda values: values["curve"][3].update(gaussians=True), "gaussians"),
        (lambda values: values["curve"].append(7), "step"),
        (lambda values: values["settings"].update(steps=0), "steps"),
        (lambda values: values["settings"].pop("seed"), "seed"),
        (lambda values: values.update(seconds=10**400), "seconds"),
        (lambda values: values.update(notes="none"), "notes"),
        (lambda values: values["evaluation"].update(ssim=None), "ssim"),
        (lambda values: values["evaluation"]["views"][0].pop("name"), "name"),
    ],
)  # fmt: skip
def test_metrics_that_lack_something_are_a_clear_error_that_names_it(change, named, runs):
    with pytest.raises(HyrfError, match=f"metrics are damaged .*'{named}'.*train the run anew"):
        read_run(change_metrics(runs[0], change))


def test_an_unfinished_run_is_an_error_that_says_what_to_do(runs, tmp_path):
    page = tmp_path / "page.html"
    assert "there is no such folder" in refused("compare", runs[0], tmp_path / "none", "-o", page)
    assert "give two or more folders" in refused("compare", runs[0], "-o", page)
    assert "each once" in refused("compare", *runs, runs[0] / ".." / "a", "-o", page)
    assert "extension must be .html" in refused("compare", *runs, "-o", tmp_path / "page.pdf")
    assert "the output is an input" in refused("compare", *runs, "-o", runs[0] / "metrics.json", "--overwrite")
    Image.new("RGB", (7, 5)).save(runs[0] / "views" / "000.png")
    assert "delete it to leave out this view" in refused("compare", *runs, "-o", page)
    (runs[0] / "model.hyrf").write_bytes(b"nothing")
    assert f"{runs[0]}/model.hyrf" in refused("compare", *runs, "-o", page)
    (runs[1] / "checkpoint.pt").touch()
    assert "command again with --resume" in refused("compare", runs[1], runs[0], "-o", page)
    (runs[0] / "model.hyrf").unlink()
    assert "there is no model.hyrf" in refused("compare", *runs, "-o", page)
    assert not page.exists()
    with pytest.raises(TypeError, match="give a list"):
        hyrfpack.compare_runs(str(runs[0]), page)


def test_the_command_reports_its_output_and_doubts(runs, tmp_path):
    page = tmp_path / "page.html"
    result = succeeded("compare", *runs, "-o", page)
    assert f"{page}: 2 runs, 2 held-out views, {page.stat().st_size:,} bytes" in result.stdout and not result.stderr
    assert "--overwrite" in refused("compare", *runs, "-o", page)
    change_metrics(runs[0], lambda values: values.pop("evaluation"))
    result = succeeded("compare", *runs, "-o", page, "--overwrite", "--json")
    assert json.loads(result.stdout)["runs"] == ["a", "b"] and "No photos were held out in 'a'" in result.stderr


def test_runs_are_named_by_the_shortest_distinct_part_of_their_paths():
    assert choose_short_names([Path("/x/runs/a"), Path("/x/runs/b")]) == ["a", "b"]
    assert choose_short_names([Path("/x/a.work/run"), Path("/x/b.work/run")]) == ["a.work/run", "b.work/run"]
    assert choose_short_names([Path("/run"), Path("/x/run")]) == ["//run", "x/run"]
