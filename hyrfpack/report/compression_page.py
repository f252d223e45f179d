"""The HTML page of `hyrfpack compress --report`, which needs no network and no scripts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hyrfpack.compress import CompressionReport
from hyrfpack.compress.sensitivity import PRUNED_KEY
from hyrfpack.counts import format_count
from hyrfpack.evaluate import Evaluation
from hyrfpack.evaluate.metrics import IDENTICAL_PSNR
from hyrfpack.format.info import sum_layers
from hyrfpack.report.page import encode_page, escape, paragraph, section, table, table_row

MAX_SHOWN_VIEWS = 4
PICTURE_KINDS = ("before", "after", "difference")


def picture_names(number: int) -> list[str]:
    """Return the file names of the pictures of a shown view, in the order of PICTURE_KINDS; `number` counts from 1."""
    return [f"view{number}_{kind}.png" for kind in PICTURE_KINDS]


PAGE_FILE = "index.html"
REPORT_FILES = (
    PAGE_FILE,
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
        amplification: factor by which the difference pictures are amplified.
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
    amplification: int
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


def encode_compression_page(
    source: Path, packed: Path, report: CompressionReport, findings: Findings, plot: str, command: str
) -> bytes:
    """Encode the page as HTML.

    Args:
        source: the file that was compressed.
        packed: the compressed file.
        report: the result of `hyrfpack.compress_model`.
        findings: the measurements.
        plot: HTML of the plot of all files.
        command: command line that makes the file again; empty if unknown.
    """
    heading = format_headline(report, findings)
    content = [
        *map(paragraph, _summarize(source, packed, report, findings)),
        section("sizes", "Size of each part", *_section_sizes(report)),
        section("files", "Size, loss and speed", *_alternatives(findings, plot)),
        section("pictures", "Before and after", *_view_pictures(findings)),
    ]
    if command:
        content.append(section("command", "Command that makes this file again", f"<pre>{escape(command)}</pre>"))
    origin = f"Written by {findings.writer}. Times were measured on this machine: {findings.machine}."
    content.append(paragraph(origin, "small"))
    return encode_page(heading, content, title=f"{packed.name}: {heading}", pictures="'self'")


def format_headline(report: CompressionReport, findings: Findings) -> str:
    """Summarise the result in a few words: "183 kB, 5.8 times smaller, 0.04 dB lost"."""
    size = format_size(report.bytes_after)
    if report.profile == "raw":
        return f"{size}, every number exact, nothing lost"
    ratio = report.bytes_before / report.bytes_after
    return f"{size}, {ratio:.1f} times smaller, {_loss_in_words(findings)}"


def format_size(count: float) -> str:
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


def _summarize(source: Path, packed: Path, report: CompressionReport, findings: Findings) -> list[str]:
    """Return plain paragraphs about the file and its loss."""
    kept = format_count(report.gaussians, "Gaussian")
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
    return sentences


def _section_sizes(report: CompressionReport) -> list[str]:
    """Return a table of the bytes of each section, summed over layers, and a note on it."""
    sections, total = sum_layers(report.sections), report.bytes_after
    header = ["part", "bytes before", "bytes after", "share of the file", "bits per number"]
    rows = []
    for part in sections:
        bits = f"{8 * part.after / part.parameters:.2f}" if part.parameters else ""
        loss = f"{report.shares[part.type]:.1%}" if part.type in report.shares else ""
        rows.append([part.holds, f"{part.before:,}", f"{part.after:,}", f"{part.after / total:.1%}", bits, loss])
    if report.shares:
        rows.append(["Gaussians left out", "", "0", "0.0%", "", f"{report.shares.get(PRUNED_KEY, 0):.1%}"])
    rest = total - sum(part.after for part in sections)
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
    formatted = [table_row(name, cells[: len(header) - 1]) for name, *cells in rows]
    return [table([*map(escape, header)], formatted), paragraph(note)]


def _alternatives(findings: Findings, plot: str) -> list[str]:
    """Return the plot of all files, and the same numbers as a table."""
    measure = "PSNR lost (dB)" if findings.has_photos else "PSNR (dB)"
    rows = [
        table_row(
            point.name,
            [
                f"{point.bytes:,}",
                "exact" if findings.is_exact(point.scores) else f"{findings.fidelity(point.scores):.3f}",
                f"{point.scores.ssim:.4f}",
                f"{point.decode_ms:.1f}",
            ],
            chosen=point is findings.chosen,
        )
        for point in findings.points
    ]
    caption = (
        "Other files that the same model can be compressed to. The line joins files of profile compact at several "
        "distortions, with default settings and without fine-tuning. Profile paper is the method of the HyRF paper; "
        "profile raw stores every number exactly. The plot below shows the time to decode each file. To get another "
        "file on the line, compress the model again with its size as the target size."
    )
    header = ["file", "bytes", measure, "SSIM", "decoding (ms)"]
    return [f"<figure>{plot}<figcaption>{escape(caption)}</figcaption></figure>", table(header, rows)]


def _view_pictures(findings: Findings) -> list[str]:
    labels = ("before", "after", f"difference, amplified {findings.amplification} times")
    figures = []
    for view in findings.shown:
        caption = f"{view.name}: {view.between:.1f} dB between before and after"
        if view.between == IDENTICAL_PSNR:
            caption = f"{view.name}: before and after are identical"
        if findings.has_photos:
            caption += f"; {view.before:.2f} dB before and {view.after:.2f} dB after against the photo"
        pictures = "".join(
            f'<a href="{escape(file)}"><img src="{escape(file)}" alt="{escape(f"{view.name}, {label}")}">'
            f"<div>{label}</div></a>"
            for file, label in zip(view.files, labels, strict=True)
        )
        caption = f"<figcaption>{escape(caption)}</figcaption>"
        figures.append(f'<figure><div class="triple">{pictures}</div>{caption}</figure>')
    intro = (
        "Renders of the model before compression and of the compressed file. The third picture is the absolute "
        f"difference in each colour channel, amplified {findings.amplification} times; black means no difference. The "
        "views are sorted from the largest loss to the smallest. Select a picture to see it in full size."
    )
    return [paragraph(intro), *figures]
