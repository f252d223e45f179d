"""Reports of a benchmark: tables, pages, plots, and the command."""

from __future__ import annotations

import json
import re

import pytest
from commands import hyrfpack, refused
from PIL import Image
from scenes import ball_points, small_model

from hyrfpack.bench.figure import build_panels, plot
from hyrfpack.bench.rows import Error, Row
from hyrfpack.bench.suite import BenchReport
from hyrfpack.bench.tables import build_tables, fill_page, format_markdown
from hyrfpack.errors import HyrfError
from hyrfpack.format import save_model
from hyrfpack.measure.timing import Ratio, Timing


def make_row(group, setting, value, ms=1.0, rms=1e-3, **more) -> Row:
    settings = {"is_reference": False, "is_default": False, **more}
    time = Timing(ms, 0.25, 2 * ms, 7)
    return Row(group, setting, value, time=time, ratio=Ratio(ms, ms), error=Error(2 * rms, rms), **settings)


def make_rows() -> list[Row]:
    sweep = [
        make_row("render", "background_stride", str(n), 4 / n, (n - 1) * 1e-3, is_reference=n == 1) for n in range(1, 5)
    ]
    decode = {"decode": Timing(3, None, 3, 1), "decode_ratio": Ratio(3, 3)}
    return [
        *sweep,
        make_row("render", "geometry", "decoded once", 1, 0, is_default=True, psnr=50.0, ssim=0.99),
        make_row("codec", "profile", "raw", 1, 0, is_reference=True, bytes=4000, psnr=30.0, psnr_drop=0.0, **decode),
        make_row("codec", "profile", "paper", 90, is_default=True, bytes=1000, psnr=29.9, psnr_drop=0.1, **decode),
        make_row("codec", "paper, color", "1 x 64", 80, bytes=900, parts={"positions": Error(0.5, 0.25)}, **decode),
    ]


def make_report() -> BenchReport:
    return BenchReport({"cpu": "slide rule", "cores": 2}, "a model", ["a note"], make_rows())


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "tiny.hyrf"
    save_model(small_model(ball_points(50)[0], background=True, fields=0.3), path)
    return path


def test_every_row_is_in_a_table_with_its_error_and_time():
    render, codec, parts = build_tables(make_rows())
    assert [table.title.partition(":")[0] for table in (render, codec, parts)] == ["render", "codec", "codec"]
    assert (len(render.cells), len(codec.cells), len(parts.cells)) == (5, 3, 1)
    stride = dict(zip(render.header, render.cells[2], strict=True))
    assert (stride["value"], stride["ms"], stride["rms error"], stride["cpu ms"]) == (
        "3",
        "1.33 ± 0.25",
        "2.0e-03",
        "2.67",
    )
    paper = dict(zip(codec.header, codec.cells[1], strict=True))
    assert (paper[""], paper["bytes"], paper["PSNR drop"], paper["decode ms"]) == ("default", "1,000", "0.100", "3")
    assert parts.cells[0][-1] == "5.0e-01 / 2.5e-01"
    assert "bytes" not in render.header and "PSNR" in render.header


def test_tables_are_inserted_into_a_page_and_its_text_is_kept():
    words = "# Title\nWords about `<!-- bench codec -->` and `<!-- end -->`.\n"
    places = "<!-- bench machine -->\nold\n<!-- end -->\nbetween\n<!-- bench codec -->\n<!-- end -->\nlast"
    blocks = {name: block for name, block in format_markdown(make_report()).items() if name != "render"}
    filled = fill_page(words + places, blocks)
    assert filled.startswith(words) and "\nbetween\n" in filled and filled.endswith("last")
    assert "old" not in filled and "slide rule" in filled and "| profile | paper | default |" in filled
    assert fill_page(filled, blocks) == filled
    assert "Error of each group of parameters, max / rms:\n\n| setting | value | positions |" in filled


def test_a_page_without_a_placeholder_is_rejected():
    with pytest.raises(HyrfError, match="page.md: there is no place for render"):
        fill_page(
            "<!-- bench machine -->\n<!-- end -->\n<!-- bench codec -->\n<!-- end -->",
            format_markdown(make_report()),
            "page.md",
        )
    with pytest.raises(HyrfError, match="no place for machine"):
        fill_page("<!-- bench machine --> and no end", format_markdown(make_report()))


def test_every_row_and_codec_size_is_drawn():
    drawn = build_panels(make_rows())
    titles = [panel.title for panel in drawn]
    assert titles == [
        "render: background_stride",
        "render: other settings",
        "codec: profile, encoding",
        "codec: profile, size",
        "codec: paper, encoding",
        "codec: paper, size",
    ]
    assert sum(len(panel.rows) for panel in drawn) == 5 + 2 * 3
    (size,) = [panel for panel in drawn if panel.title == "codec: paper, size"]
    assert size.x_value(size.rows[0]) == 900 / 4000


@pytest.mark.acceptance
def test_the_plot_is_a_picture_in_the_format_of_its_name(tmp_path):
    plot(make_rows(), tmp_path / "new" / "plot.png")
    assert Image.open(tmp_path / "new" / "plot.png").size[0] > 1000
    plot(make_rows(), tmp_path / "plot.svg")
    drawing = (tmp_path / "plot.svg").read_text()
    assert drawing.startswith("<?xml") and len(drawing) > 10_000
    with pytest.raises(HyrfError, match=r"plot.txt: a plot is written as png"):
        plot(make_rows(), tmp_path / "plot.txt")


def test_a_plot_of_one_row_without_error_is_drawn(tmp_path):
    plot([make_row("mlp", "forward", "float64 reference", rms=0, is_reference=True)], tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000


def test_json_on_standard_output_is_the_only_output(model, tmp_path):
    result = hyrfpack("bench", model, "--only", "mlp", "--repeats", 2, "--json", "-o", tmp_path / "b.png")
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert {item["group"] for item in values["rows"]} == {"mlp"}
    assert values["rows"][0]["is_reference"] and values["rows"][0]["time"]["repeats"] == 2
    assert (tmp_path / "b.png").exists() and "measuring mlp" in result.stderr


def test_one_run_writes_the_table_the_page_and_the_plot(model, tmp_path):
    chosen = ("--only", "hash_encode", "--only", "mlp", "--repeats", 1)
    files = ("--markdown", tmp_path / "b.md", "-o", tmp_path / "b.png")
    result = hyrfpack("bench", model, *chosen, *files)
    assert result.exit_code == 0, result.output
    assert "bfloat16 reference" in result.stdout and "cores" in result.stdout
    page = (tmp_path / "b.md").read_text()
    rows = re.findall(r"^.*float64 reference", result.stdout, re.MULTILINE)
    assert page.count("| float64 reference |") == len(rows) > 0
    (tmp_path / "b.md").write_text(page.replace("## mlp", "## mlp\n\nMy own words."))
    assert hyrfpack("bench", model, *chosen[2:], *files, "--overwrite").exit_code == 0
    assert "My own words." in (tmp_path / "b.md").read_text()


def test_mistakes_of_the_user_are_a_clear_error(model, tmp_path):
    assert "no such file" in refused("bench", tmp_path / "missing.hyrf")
    (tmp_path / "bad.hyrf").write_bytes(b"not a model")
    assert "not a .hyrf file" in refused("bench", tmp_path / "bad.hyrf")
    assert "nowhere" in refused("bench", model, "--data", tmp_path / "nowhere")
    assert "'nothing' is not one of" in refused("bench", model, "--only", "nothing")
    assert "name the MODEL, too" in refused("bench", "--data", tmp_path)
    assert "plot is written as" in refused("bench", model, "-o", tmp_path / "plot.txt")


def test_a_page_without_placeholders_is_rejected_before_measuring(model, tmp_path):
    (tmp_path / "page.md").write_text("# Nothing here")
    sentence = refused("bench", model, "--only", "mlp", "--markdown", tmp_path / "page.md", "-o", tmp_path / "b.png")
    assert "no place for machine" in sentence and (tmp_path / "page.md").read_text() == "# Nothing here"
    assert not (tmp_path / "b.png").exists()
