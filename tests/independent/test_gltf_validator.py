"""Khronos' glTF validator finds nothing wrong with our .glb files."""

from __future__ import annotations

import pytest
from independent.clouds import made_up
from independent.formats import FORMATS

# What it says of an extension that it does not know, by where.
UNKNOWN = {
    ("UNSUPPORTED_EXTENSION", "/extensionsUsed/0"),
    *(
        ("MESH_PRIMITIVE_INVALID_ATTRIBUTE", f"/meshes/0/primitives/0/attributes/KHR_gaussian_splatting:{name}")
        for name in (
            *("ROTATION", "SCALE", "OPACITY"),
            *(f"SH_DEGREE_{band}_COEF_{term}" for band in range(4) for term in range(2 * band + 1)),
        )
    ),
}


@pytest.fixture(scope="module")
def reports(node, tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    folder = tmp_path_factory.mktemp("gltf")
    files = [folder / f"{degree}.glb" for degree in range(4)]
    for degree, file in enumerate(files):
        file.write_bytes(FORMATS["glb"].encode(made_up(degree)))
    return node("gltf_validator.mjs", *files)


@pytest.mark.parametrize("degree", range(4))
def test_the_validator_complains_of_nothing_but_the_extension_it_does_not_know(degree, reports):
    issues = reports[degree]["issues"]
    assert not issues["truncated"]
    assert {(issue["code"], issue["pointer"]) for issue in issues["messages"]} <= UNKNOWN
    info = reports[degree]["info"]
    assert (info["version"], info["extensionsUsed"], info["totalVertexCount"]) == (
        "2.0",
        ["KHR_gaussian_splatting"],
        300,
    )
