"""Variants with COLMAP models as other versions and text editors write them, and with incomplete models."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

from tools.safety.variants.variant import Variant
from tools.safety.variants.working_set import WorkingSet


def list_variants() -> Iterator[Variant]:
    """Yield the variants of this module."""

    def change_tables(change: Callable[[str, bytes], bytes | None]) -> Callable[[WorkingSet], None]:
        """Write the model as text and change the bytes of each table, or remove the table where `change` gives None."""

        def make(s: WorkingSet) -> None:
            s.write_model(text=True)
            for table in list(s.model.iterdir()):
                content = change(table.stem, table.read_bytes())
                table.write_bytes(content) if content is not None else table.unlink()

        return make

    def remove_points(table: str, content: bytes) -> bytes | None:
        return None if table == "points3D" else content

    note = "no points"
    yield Variant("model: text", change_tables(lambda t, b: b))
    yield Variant("model: text, CRLF", change_tables(lambda t, b: b.replace(b"\n", b"\r\n")))
    yield Variant("model: text, BOM", change_tables(lambda t, b: b"\xef\xbb\xbf" + b))
    yield Variant("model: text, BOM and CRLF", change_tables(lambda t, b: b"\xef\xbb\xbf" + b.replace(b"\n", b"\r\n")))
    yield Variant("model: text without comments", change_tables(lambda t, b: re.sub(rb"(?m)^#.*\n", b"", b)))
    yield Variant("model: text with more comments", change_tables(lambda t, b: b"# by hand\n\n" + b))
    yield Variant("model: text, empty lines at the end", change_tables(lambda t, b: b + b"\n\n"))
    yield Variant("model: text without points3D", change_tables(remove_points), note=note)
    yield Variant(
        "model: text with empty points3D", change_tables(lambda t, b: b"" if t == "points3D" else b), note=note
    )
    yield Variant("model: binary without points3D", lambda s: (s.model / "points3D.bin").unlink(), note=note)
    yield Variant("model: points3D.ply alone", _write_ply_points)
    yield Variant("model: text and points3D.ply", lambda s: (s.write_model(text=True), _write_ply_points(s)))
    yield Variant("model: with rigs and frames", lambda s: s.read_reconstruction().write_binary(str(s.model)))
    yield Variant(
        "model: without cameras", lambda s: [file.unlink() for file in s.model.glob("cameras.*")], "cameras.* missing"
    )
    yield Variant(
        "model: without images", lambda s: [file.unlink() for file in s.model.glob("images.*")], "images.* missing"
    )
    yield Variant(
        "model: images.bin cut",
        lambda s: (s.model / "images.bin").write_bytes((s.model / "images.bin").read_bytes()[:-9]),
        "truncated",
    )


def _write_ply_points(s: WorkingSet) -> None:
    import trimesh

    points = list(s.read_reconstruction().points3D.values())
    cloud = trimesh.PointCloud([point.xyz for point in points], [(*map(int, point.color), 255) for point in points])
    cloud.export(s.model / "points3D.ply")
    for table in s.model.glob("points3D.*"):
        if table.suffix != ".ply":
            table.unlink()
