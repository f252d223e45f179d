"""The HTML page of `hyrfpack compress --report`, which needs no network and no scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from hyrfpack.compress import CompressionReport
from hyrfpack.errors import printable
from hyrfpack.evaluate import Evaluation
from hyrfpack.evaluate.metrics import IDENTICAL_PSNR
from hyrfpack.format.sections import NON_PARAMETER_SECTIONS, group_and_layer

PLOT_FILE = "size_against_loss.png"
MAX_SHOWN_VIEWS = 4
PICTURE_KINDS = ("before", "after", "difference")
PAGE_CSS = """
body { font: 16px/1.5 system-ui, sans-serif; color: #202124; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 2rem; margin-bottom: 0; }
h2 { font-size: 1.3rem; margin-top: 2.5rem; }
p, figcaption { max-width: 48rem; }
figcaption { color: #5f6368; margin-top: .3rem; }
figure { margin: 1rem 0 2rem; }
img { max-width: 100%; height: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .25rem .8rem; border-bottom: 1px solid #dadce0; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
tr.chosen td { font-weight: bold; }
pre { background: #f1f3f4; padding: .8rem; white-space: pre-wrap; overflow-wrap: anywhere; }
.views { display: grid; grid-template-columns: repeat(3, 1fr); gap: .5rem; text-align: center; }
.views img { width: 100%; }
"""


def picture_names(number: int) -> list[str]:
    """Return the file names of the pictures of a shown view, in the order of PICTURE_KINDS; `number` counts from 1."""
    return [f"view{number}_{kind}.png" for kind in PICTURE_KINDS]


PAGE_FILE = "index.html"
REPORT_FILES = (
    PAGE_FILE,
    PLOT_FILE,
    *(name for number in range(1, MAX_SHOWN_VIEWS + 1) for name in picture_names(number)),
)


@dataclass(frozen=True)
class MeasuredFile:
    """Size, scores and decoding time of one file that the model can be written as.

    Attributes:
        name: name of the file on the page.
        bytes: size of the whole file.
        scores: scores of the decoded file.
        decode_ms: median decoding time in milliseconds.
    """

    name: str
    bytes: int
    scores: Evaluation
    decode_ms: float


@dataclass(frozen=True)
class ShownView:
    """A view whose pictures are shown on the page.

    Attributes:
        name: name of the photo, or the number of the viewpoint.
        before, after: PSNR of the model before and after compression against the photo, dB.
        between: PSNR between the two renders, dB.
        files: paths of the pictures before, after and difference, relative to the page.
    """

    name: str
    before: float
    after: float
    between: float
    files: list[str]


@dataclass(frozen=True)
class Findings:
    """The measurements that the page shows.

    Attributes:
        views: description of the scored views.
        has_photos: True if views are scored against photos, False if against renders of the uncompressed model.
        before: scores of the uncompressed model.
        chosen: the file that was written.
        profiles: the model in the other profiles, which have no settings.
        curve: the model in profile "compact" at several distortions, smallest distortion first.
        shown: views whose pictures are shown, the one that loses most first.
        amplified: factor by which the difference pictures are amplified.
        gaussians: number of Gaussians of the uncompressed model.
        machine: the machine on which times were measured.
        writer: the program that wrote the file, and its version.
    """

    views: str
    has_photos: bool
    before: Evaluation
    chosen: MeasuredFile
    profiles: list[MeasuredFile]
    curve: list[MeasuredFile]
    shown: list[ShownView]
    amplified: int
    gaussians: int
    machine: str
    writer: str

    @property
    def points(self) -> list[MeasuredFile]:
        """Return all files, largest first; the chosen file may also be a point of the curve."""
        others = [point for point in (*self.profiles, *self.curve) if point is not self.chosen]
        return sorted([self.chosen, *others], key=lambda point: -point.bytes)

    def is_exact(self, scores: Evaluation) -> bool:
        """Return whether renders before and after are identical in every pixel; always False with photos."""
        return not self.has_photos and scores.psnr == IDENTICAL_PSNR

    def fidelity(self, scores: Evaluation) -> float:
        """Return the loss of PSNR against photos, or without photos the PSNR against the uncompressed model; dB."""
        return self.before.psnr - scores.psnr if self.has_photos else scores.psnr


def build_page(source: Path, packed: Path, report: CompressionReport, findings: Findings, command: str) -> str:
    """Return the page as HTML. Texts from files become text nodes of an element tree, so they cannot inject markup."""
    title = headline(report, findings)
    head = _element(
        "head",
        _element("meta", charset="utf-8"),
        _element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        _element("title", f"{packed.name}: {title}"),
        _element("style", PAGE_CSS),
    )
    body = _element(
        "body",
        _element("h1", title),
        *_summary(source, packed, report, findings),
        _element("h2", "Size of each part"),
        *_section_sizes(report),
        _element("h2", "Size, loss and speed"),
        *_alternatives(findings),
        _element("h2", "Before and after"),
        *_view_pictures(findings),
        *([_element("h2", "Command that makes this file again"), _element("pre", command)] if command else []),
        _element("p", f"Written by {findings.writer}. Times were measured on this machine: {findings.machine}."),
    )
    document = _element("html", head, body, lang="en")
    ElementTree.indent(document)
    return "<!DOCTYPE html>\n" + ElementTree.tostring(document, encoding="unicode", method="html") + "\n"


def headline(report: CompressionReport, findings: Findings) -> str:
    """Summarise the result in a few words: "183 kB, 5.8 times smaller, 0.04 dB lost"."""
    size = size_in_words(report.bytes_after)
    if report.profile == "raw":
        return f"{size}, every number exact, nothing lost"
    ratio = report.bytes_before / report.bytes_after
    return f"{size}, {ratio:.1f} times smaller, {_loss_in_words(findings)}"


def size_in_words(count: float) -> str:
    """Format a number of bytes with three significant digits; k, M and G are powers of 1000."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= 0.9995 * factor:
            return f"{count / factor:.3g} {unit}"
    return f"{count:.0f} bytes"


def _loss_in_words(findings: Findings) -> str:
    scores = findings.chosen.scores
    value = findings.fidelity(scores)
    if not findings.has_photos:
        return "no pixel changed" if findings.is_exact(scores) else f"{value:.1f} dB between pictures before and after"
    if abs(value) < 0.005:
        return "less than 0.01 dB lost"
    return f"{abs(value):.2f} dB {'lost' if value > 0 else 'gained'}"


def _summary(source: Path, packed: Path, report: CompressionReport, findings: Findings) -> list[Element]:
    kept = f"{report.gaussians:,} Gaussians"
    if report.gaussians < findings.gaussians:
        kept += f" out of {findings.gaussians:,} (the others hardly affect renders and were pruned)"
    before, after = findings.before, findings.chosen.scores
    sentences = [
        f"{packed} is a compressed copy of {source}, a 3D scene that was reconstructed from photos. "
        f"It has {report.bytes_after:,} bytes and holds {kept}. As uncompressed 32-bit numbers, its parameters take "
        f"{report.bytes_before:,} bytes. Profile: {report.profile}.",
    ]
    if findings.has_photos:
        sentences.append(
            f"Its renders were compared with {findings.views}: PSNR {before.psnr:.3f} dB before and {after.psnr:.3f} "
            f"dB after compression, SSIM {before.ssim:.4f} before and {after.ssim:.4f} after. PSNR and SSIM measure "
            "how similar renders are to the photos. Higher is better; the maximum of SSIM is 1. A difference of 0.1 dB "
            "is rarely visible."
        )
    elif findings.is_exact(after):
        sentences.append(f"Its renders were compared with {findings.views}: they are identical in every pixel.")
    else:
        sentences.append(
            f"Its renders were compared with {findings.views}: PSNR {after.psnr:.2f} dB, SSIM {after.ssim:.4f}. PSNR "
            "and SSIM measure how similar renders are. Higher is better; the maximum of SSIM is 1. From 40 dB on, "
            "differences are hard to see. A report made with photos of the scene also measures the loss against them."
        )
    if report.found:
        sentences.append(f"Result of the search: {report.found}.")
    return [_element("p", sentence) for sentence in sentences]


def _section_sizes(report: CompressionReport) -> list[Element]:
    """Return a table of the bytes of each section, summed over layers, and a note on it."""
    sizes: dict[str, list[int]] = {}
    names = {part.type: part.holds for part in report.sections}
    for part in report.sections:
        size = sizes.setdefault(group_and_layer(part.type)[0], [0, 0])
        size[0] += part.before
        size[1] += part.after
    header = ["part", "bytes before", "bytes after", "share of the file", "bits per number"]
    rows, total = [], report.bytes_after
    for tag, (before, after) in sizes.items():
        numbers = 0 if tag in NON_PARAMETER_SECTIONS else before // 4
        bits = f"{8 * after / numbers:.2f}" if numbers else ""
        loss = f"{report.shares[tag]:.1%}" if tag in report.shares else ""
        rows.append([names.get(tag, tag), f"{before:,}", f"{after:,}", f"{after / total:.1%}", bits, loss])
    if report.shares:
        left_out = sum(share for part, share in report.shares.items() if part not in sizes)
        rows.append(["Gaussians left out", "", "0", "0.0%", "", f"{left_out:.1%}"])
    rest = total - sum(after for _, after in sizes.values())
    rows.append(["header, table of contents, padding", "", f"{rest:,}", f"{rest / total:.1%}", "", ""])
    rows.append(["the whole file", f"{report.bytes_before:,}", f"{total:,}", "100.0%", "", ""])
    note = (
        "Positions and logits belong to the Gaussians, which are soft blobs of colour. Hash tables and decoders form "
        "two small neural networks, which adjust each Gaussian's colour, size, opacity and rotation. Bytes before are "
        "those of uncompressed 32-bit numbers; their sum leaves out the metadata."
    )
    if report.shares:
        header.append("share of the loss")
        note += " The share of the loss estimates how much of the change in renders each part causes."
    return [_table(header, [row[: len(header)] for row in rows]), _element("p", note)]


def _alternatives(findings: Findings) -> list[Element]:
    """Return the plot of all files, and the same numbers as a table."""
    measure = "PSNR lost (dB)" if findings.has_photos else "PSNR (dB)"
    rows = [
        [
            point.name,
            f"{point.bytes:,}",
            "exact" if findings.is_exact(point.scores) else f"{findings.fidelity(point.scores):.3f}",
            f"{point.scores.ssim:.4f}",
            f"{point.decode_ms:.1f}",
        ]
        for point in findings.points
    ]
    caption = (
        "Other files that the same model can be compressed to. The line joins files of profile compact at several "
        "distortions, with default settings and without fine-tuning. Profile paper is the method of the HyRF paper; "
        "profile raw stores every number exactly. The plot below shows the time to decode each file. To get another "
        "file on the line, compress the model again with its size as the target size."
    )
    return [
        _element(
            "figure",
            _element(
                "img", src=PLOT_FILE, alt="Bytes of each file against its loss, and against the time to decode it"
            ),
            _element("figcaption", caption),
        ),
        _table(
            ["file", "bytes", measure, "SSIM", "decoding (ms)"],
            rows,
            chosen=findings.points.index(findings.chosen),
        ),
    ]


def _view_pictures(findings: Findings) -> list[Element]:
    labels = ("before", "after", f"difference, amplified {findings.amplified} times")
    figures = []
    for view in findings.shown:
        caption = f"{view.name}: {view.between:.1f} dB between before and after"
        if view.between == IDENTICAL_PSNR:
            caption = f"{view.name}: before and after are identical"
        if findings.has_photos:
            caption += f"; {view.before:.2f} dB before and {view.after:.2f} dB after against the photo"
        pictures = [
            _element("a", _element("img", src=file, alt=f"{view.name}, {label}"), _element("div", label), href=file)
            for file, label in zip(view.files, labels, strict=True)
        ]
        figures.append(
            _element("figure", _element("div", *pictures, **{"class": "views"}), _element("figcaption", caption))
        )
    intro = (
        "Renders of the model before compression and of the compressed file. The third picture is the absolute "
        f"difference in each colour channel, amplified {findings.amplified} times; black means no difference. The "
        "views are sorted from the largest loss to the smallest. Select a picture to see it in full size."
    )
    return [_element("p", intro), *figures]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], chosen: int | None = None) -> Element:
    return _element(
        "table",
        _element("thead", _element("tr", *(_element("th", cell) for cell in header))),
        _element(
            "tbody",
            *(
                _element(
                    "tr",
                    *(_element("td", cell) for cell in row),
                    **({"class": "chosen"} if number == chosen else {}),
                )
                for number, row in enumerate(rows)
            ),
        ),
    )


def _element(tag: str, *content: str | Element, **attributes: str) -> Element:
    """Return an element that contains text or other elements."""
    element = Element(tag, {name: printable(value) for name, value in attributes.items()})
    for part in content:
        if isinstance(part, Element):
            element.append(part)
        else:
            element.text = part if tag == "style" else printable(part)
    return element
