from __future__ import annotations

import dataclasses
import importlib
import json
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused, succeeded
from PIL import Image
from scenes import ball_points, ball_scene, ring, small_model

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.compress import CompressionReport, compress_model
from hyrfpack.compress.calibrate import measure_calibrated_sensitivity
from hyrfpack.config.compress import CompressConfig
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format import load_model, save_model
from hyrfpack.report.compression import choose_amplification, write_compression_report
from hyrfpack.report.compression_page import format_size
from hyrfpack.scene import Scene
from tools.browser import chromium, firefox
from tools.safety.make_golden import GOLDEN_MERGED_FILE

pytestmark = pytest.mark.usefixtures("quick_calibration")
NAME_WITH_MARKUP = "<script>alert(1)</script>&amp;.png"


class ParsedReport(HTMLParser):
    """The tags, links, texts and tables of a report page, as a browser would parse them.

    Addresses that contain their data are not among the links.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.texts: dict[str, list[str]] = {}
        self.tables: list[list[list[str]]] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        addresses = [value for name, value in attrs if name in ("src", "href", "srcset")]
        self.links += [address for address in addresses if not address.startswith("data:")]
        if tag not in ("meta", "link", "img", "source"):
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)
            if self.open[-1] in ("td", "th"):
                self.tables[-1][-1][-1] += data

    @property
    def words(self) -> str:
        return " ".join(text for tag, texts in self.texts.items() if tag != "style" for text in texts)


@pytest.fixture(scope="module", autouse=True)
def use_quick_timing() -> Iterator[None]:
    """Time each file once, because these tests need no exact times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.report.compression.DECODE_TIMING_TURNS", 1)
        yield


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Return photos of balls with two held out, one of which has a name that contains markup."""
    made = ball_scene(8)
    views = [dataclasses.replace(made.train[0], name=NAME_WITH_MARKUP), *made.train[1:]]
    return dataclasses.replace(made, train=views[2:], test=views[:2])


@pytest.fixture(scope="module")
def model_file(scene, tmp_path_factory) -> Path:
    """Write a model of the balls with its cameras to a folder whose name contains markup."""
    positions, colors = ball_points(150)
    model = small_model(positions, color_logits=torch.from_numpy(colors) * 4 - 2, scale_logits=-2.5, fields=0.2)
    folder = tmp_path_factory.mktemp("<img src=x onerror=alert(1)>")
    path = folder / "model.hyrf"
    save_model(model, path, provenance={"cameras": provenance_cameras([view.camera for view in scene.train])})
    return path


def compress_and_report(
    model_file: Path, folder: Path, profile: str = "compact", scene: Scene | None = None, **options
) -> tuple[Path, CompressionReport, ParsedReport]:
    """Compress a model and write its report page; return the packed file, the report and the parsed page."""
    packed = folder / "packed.hyrf"
    report = compress_model(model_file, packed, CompressConfig(profile=profile, **options), data=scene)
    return (
        packed,
        report,
        ParsedReport(
            write_compression_report(folder / "page", model_file, packed, report, scene, command="make <it> \udcff")
        ),
    )


@pytest.fixture(scope="module")
def report_with_photos(model_file, scene, tmp_path_factory) -> tuple[Path, CompressionReport, ParsedReport]:
    return compress_and_report(model_file, tmp_path_factory.mktemp("photos"), scene=scene, distortion=1e-4)


@pytest.mark.parametrize(
    ("profile", "measured"), [("compact", 0), pytest.param("paper", 1, marks=pytest.mark.acceptance)]
)
def test_the_report_reuses_the_sensitivity_measured_for_packing(profile, measured, model_file, tmp_path, monkeypatch):
    asked = []

    def spy(*args: object) -> object:
        asked.append(args)
        return measure_calibrated_sensitivity(*args)

    monkeypatch.setattr("hyrfpack.report.compression.measure_calibrated_sensitivity", spy)
    _, report, _ = compress_and_report(model_file, tmp_path, profile)
    assert len(asked) == measured
    assert (report.sensitivity is None) == bool(measured)
    assert set(json.loads(json.dumps(report.to_dict()))) == {f.name for f in dataclasses.fields(report)} - {
        "sensitivity"
    }


# -- the page as a file ----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("drawn_figures")
def test_the_page_is_valid_and_refers_only_to_its_own_pictures(report_with_photos):
    packed, _, page = report_with_photos
    folder = packed.parent / "page"
    assert page.open == []  # every element is closed in the right order
    assert not {"script", "iframe", "object"} & set(page.tags)
    assert "url(" not in "".join(page.texts["style"]) and "@import" not in "".join(page.texts["style"])
    assert {"index.html", *page.links} == {path.name for path in folder.iterdir()}


@pytest.mark.acceptance
@pytest.mark.parametrize("program", [chromium.Chromium, firefox.Firefox])
def test_browsers_show_all_pictures_under_the_content_security_policy(program, report_with_photos):
    if importlib.import_module(program.__module__).find_program() is None:
        pytest.skip(f"{program.__name__} is not on this machine")
    with program() as browser:
        browser.open((report_with_photos[0].parent / "page" / "index.html").as_uri())
        assert browser.evaluate("[...document.images].map((image) => image.naturalWidth > 0)") == [True] * 7
        assert browser.list_errors() == []


def test_names_of_files_are_escaped(report_with_photos):
    _, _, page = report_with_photos
    assert any(NAME_WITH_MARKUP in text for text in page.texts["figcaption"])
    assert any("<img src=x onerror=alert(1)>" in text for text in page.texts["p"])
    assert page.texts["pre"] == ["make <it> \\udcff"]  # a path that is not valid Unicode
    assert page.tags.count("img") == 1 + 3 * 2


def test_an_unwritable_folder_is_refused_before_the_work(model_file, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    report = CompressionReport("model.hyrf", "raw", 1, 1, 1, [])
    with pytest.raises(HyrfError, match="file is a file, not a folder"):
        write_compression_report(tmp_path / "file" / "page", model_file, model_file, report)


@pytest.mark.acceptance
def test_the_page_is_written_after_its_pictures(model_file, tmp_path, monkeypatch):
    def full(path, image, **options):
        raise HyrfError("the disk is full", fix="free some space")

    monkeypatch.setattr("hyrfpack.report.compression.save_picture", full)
    with pytest.raises(HyrfError, match="full"):
        compress_and_report(model_file, tmp_path, "raw")
    assert not (tmp_path / "page").exists()


# -- its numbers -----------------------------------------------------------------------------------------------------


def test_the_headline_shows_the_file_size_and_the_psnr_drop_on_held_out_photos(report_with_photos, model_file, scene):
    packed, report, page = report_with_photos
    lost = evaluate_model(load_model(model_file), scene.test).psnr - evaluate_model(load_model(packed), scene.test).psnr
    ratio = report.bytes_before / packed.stat().st_size
    size = f"{packed.stat().st_size / 1000:.3g} kB"
    words = f"{abs(lost):.2f} dB {'lost' if lost > 0 else 'gained'}" if abs(lost) >= 0.005 else "less than 0.01 dB lost"
    assert page.texts["h1"] == [f"{size}, {ratio:.1f} times smaller, {words}"]
    assert "2 held-out photos" in page.words


def test_parts_add_up_to_the_file_size_and_to_the_loss(report_with_photos):
    packed, _, page = report_with_photos
    header, *rows = page.tables[0]
    assert header[2] == "bytes after" and header[5] == "share of the loss"
    *parts, total = [int(row[2].replace(",", "")) for row in rows]
    assert sum(parts) == total == packed.stat().st_size
    assert sum(float(row[5].rstrip("%")) for row in rows if row[5]) == pytest.approx(100, abs=0.5)


@pytest.mark.acceptance
def test_layers_of_a_section_are_reported_as_one_part(model_file, tmp_path):
    packed = tmp_path / "packed.hyrf"
    report = compress_model(model_file, packed, CompressConfig(profile="raw"))
    positions = next(part for part in report.sections if part.type == "POSI")
    halves = [
        dataclasses.replace(positions, type=type, before=positions.before // 2, after=positions.after // 2)
        for type in ("POSI", "POS1")
    ]
    sections = [*halves, *(part for part in report.sections if part.type != "POSI")]
    path = write_compression_report(
        tmp_path / "page", model_file, packed, dataclasses.replace(report, sections=sections)
    )
    (row,) = [row for row in ParsedReport(path).tables[0] if row[0].startswith("positions")]
    assert row[:3] == ["positions", f"{positions.before:,}", f"{positions.after:,}"]


def test_the_curve_has_smaller_files_at_higher_distortion(report_with_photos):
    _, _, page = report_with_photos
    header, *rows = page.tables[1]
    assert header[:3] == ["file", "bytes", "PSNR lost (dB)"]
    by_name = {row[0]: (int(row[1].replace(",", "")), float(row[2])) for row in rows}
    names = (
        "1/16 of the distortion",
        "1/4 of the distortion",
        None,
        "4 times the distortion",
        "16 times the distortion",
    )
    curve = [by_name["this file" if name is None else f"compact, {name}"] for name in names]
    assert [size for size, _ in curve] == sorted((size for size, _ in curve), reverse=True)
    assert curve[-1][1] > curve[0][1]
    assert by_name["raw"][1] == 0 and by_name["raw"][0] > by_name["paper"][0]
    assert len(by_name) == 7


@pytest.mark.acceptance
def test_a_file_that_is_not_on_the_curve_is_shown_separately(model_file, scene, tmp_path):
    _, _, page = compress_and_report(model_file, tmp_path, scene=scene, distortion=3e-3, finetune_steps=2)
    names = [row[0] for row in page.tables[1]]
    assert "this file" in names and "compact, the same distortion" in names


def test_difference_pictures_have_the_documented_amplification(report_with_photos):
    packed, _, page = report_with_photos
    folder = packed.parent / "page"
    (times,) = {int(text.split()[2]) for text in page.texts["div"] if text.startswith("difference")}
    before, after, difference = (
        np.asarray(Image.open(folder / f"view1_{name}.png")).astype(int) for name in ("before", "after", "difference")
    )
    np.testing.assert_array_equal(difference, np.minimum(times * np.abs(after - before), 255))
    assert difference.max() > 0


def test_views_are_sorted_by_descending_loss(report_with_photos, model_file, scene):
    packed, _, page = report_with_photos
    old, new = (evaluate_model(load_model(path), scene.test).views for path in (model_file, packed))
    lost = {before.name: before.psnr - after.psnr for before, after in zip(old, new, strict=True)}
    expected = sorted(lost, key=lost.get, reverse=True)
    captions = [text for text in page.texts["figcaption"] if "against the photo" in text]
    assert [next(name for name in expected if text.startswith(name)) for text in captions] == expected


# -- other inputs ----------------------------------------------------------------------------------------------------


@pytest.mark.acceptance
def test_without_photos_renders_are_compared_with_those_of_the_uncompressed_model(model_file, tmp_path):
    _, _, page = compress_and_report(model_file, tmp_path, distortion=1e-4)
    assert "dB between pictures before and after" in page.texts["h1"][0]
    assert "against the photo" not in page.words
    assert "renders of the uncompressed model from 6 viewpoints" in page.words
    (raw,) = [row for row in page.tables[1] if row[0] == "raw"]
    assert raw[2] == "exact"


def test_a_raw_file_has_no_loss(model_file, tmp_path):
    _, _, page = compress_and_report(model_file, tmp_path, "raw")
    assert page.texts["h1"][0].endswith("every number exact, nothing lost")
    assert "identical in every pixel" in page.words and "share of the loss" not in page.words
    assert "raw" not in [row[0] for row in page.tables[1]]


def test_a_model_without_gaussians_has_a_page_without_a_curve(tmp_path):
    save_model(
        small_model(np.zeros((0, 3))), tmp_path / "empty.hyrf", provenance={"cameras": provenance_cameras(ring(2))}
    )
    _, _, page = compress_and_report(tmp_path / "empty.hyrf", tmp_path, "paper")
    assert sorted(row[0] for row in page.tables[1][1:]) == ["raw", "this file"]


@pytest.mark.acceptance
def test_a_model_beyond_half_precision_has_a_page_without_paper(tmp_path):
    positions, _ = ball_points(20)
    model = small_model(positions)
    with torch.no_grad():
        model.gaussians.positions[0, 0] = 1e5
    save_model(model, tmp_path / "far.hyrf", provenance={"cameras": provenance_cameras(ring(2))})
    _, _, page = compress_and_report(tmp_path / "far.hyrf", tmp_path, distortion=1e-4)
    assert "paper" not in [row[0] for row in page.tables[1]]


def test_the_command_line_writes_the_page_and_reports_it(model_file, tmp_path):
    result = succeeded(
        "compress", model_file, "-o", tmp_path / "p.hyrf", "--profile", "raw", "--report", tmp_path / "page"
    )
    assert "for the report" in result.stderr
    page = tmp_path / "page" / "index.html"
    assert result.stdout.splitlines()[-1].startswith(f"{page}: ")
    assert ParsedReport(page).texts["pre"][0].startswith("hyrfpack ")


@pytest.mark.acceptance
def test_the_json_report_of_a_command_names_the_page(model_file, tmp_path):
    arguments = ("compress", model_file, "--profile", "raw", "--json")
    result = succeeded(*arguments, "-o", tmp_path / "p.hyrf", "--report", tmp_path / "page")
    assert json.loads(result.stdout)["report"] == str(tmp_path / "page" / "index.html")
    assert "report" not in json.loads(succeeded(*arguments, "-o", tmp_path / "q.hyrf").stdout)


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (0, "0 bytes"),
        (999, "999 bytes"),
        (1000, "1 kB"),
        (183_456, "183 kB"),
        (999_499, "999 kB"),
        (999_500, "1 MB"),
        (1_234_567, "1.23 MB"),
        (2_500_000_000, "2.5 GB"),
    ],
)
def test_formatted_sizes_have_three_digits(count, words):
    assert format_size(count) == words


@pytest.mark.parametrize(("between", "times"), [(100.0, 64), (40.0, 32), (30.0, 8), (6.0, 1), (0.0, 1)])
def test_amplification_makes_the_worst_difference_visible(between, times):
    assert choose_amplification(between) == times


def test_a_report_on_merged_models_is_refused_before_they_are_compressed(tmp_path):
    message = refused("compress", GOLDEN_MERGED_FILE, "-o", tmp_path / "a.hyrf", "--report", tmp_path / "page")
    assert "holds merged models, and a report compares versions of one model; leave out --report" in message
    assert list(tmp_path.iterdir()) == []
