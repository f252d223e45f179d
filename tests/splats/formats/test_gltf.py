from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from made_up_splats import random_splats
from property_tests import examples
from scipy.spatial.transform import Rotation

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats import gltf
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.placement import choose_local_origin, upright_rotation
from hyrfpack.splats.splats import Splats

Y_DOWN, Z_UP = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def are_equal_except_positions(first: Splats, second: Splats) -> bool:
    """Compare everything but positions; quaternions with a tolerance, because reading normalises them."""
    equal = all(np.array_equal(getattr(first, name), getattr(second, name)) for name in ("scales", "opacities"))
    return (
        equal
        and np.array_equal(first.harmonics, second.harmonics)
        and np.allclose(first.quats, second.quats, rtol=0, atol=1e-7)
    )


def parse_json(data: bytes) -> dict:
    return json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])


def build_glb(content: dict, binary: bytes) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


@pytest.mark.parametrize("degree", range(4))
def test_splats_round_trip_in_the_same_axes(degree):
    splats = random_splats(degree=degree)
    read = gltf.decode(gltf.encode(splats, Hints(Y_DOWN)), "a.glb")
    assert are_equal_except_positions(read, splats)
    np.testing.assert_array_equal(read.positions, splats.positions.astype(np.float32))


def test_encoding_is_deterministic():
    assert gltf.encode(random_splats(), Hints(Z_UP)) == gltf.encode(random_splats(), Hints(Z_UP))


def test_attributes_follow_the_specification():
    splats = random_splats(3, degree=1)
    data = gltf.encode(splats, Hints(Y_DOWN))
    content = parse_json(data)
    primitive = content["meshes"][0]["primitives"][0]
    assert content["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }

    def numbers(semantic: str, width: int) -> np.ndarray:
        accessor = content["accessors"][primitive["attributes"][semantic]]
        view = content["bufferViews"][accessor["bufferView"]]
        start = len(data) - content["buffers"][0]["byteLength"] + view["byteOffset"]
        return np.frombuffer(data, "<f4", 3 * width, start).reshape(3, width)

    w, x, y, z = splats.quats.T
    np.testing.assert_array_equal(numbers("KHR_gaussian_splatting:ROTATION", 4), np.stack((x, y, z, w), 1))
    np.testing.assert_array_equal(numbers("KHR_gaussian_splatting:SCALE", 3), splats.scales)
    np.testing.assert_array_equal(numbers("KHR_gaussian_splatting:OPACITY", 1)[:, 0], splats.opacities)
    np.testing.assert_array_equal(numbers("KHR_gaussian_splatting:SH_DEGREE_1_COEF_2", 3), splats.harmonics[:, 3])
    stored = splats.positions.astype(np.float32)
    assert content["accessors"][0]["min"] == stored.min(0).tolist()
    assert content["accessors"][0]["max"] == stored.max(0).tolist()


def test_viewers_without_the_extension_see_colored_upright_points():
    splats = random_splats(50)
    cloud = trimesh.load_scene(io.BytesIO(gltf.encode(splats, Hints(Y_DOWN))), file_type="glb").to_geometry()
    np.testing.assert_allclose(cloud.vertices, splats.positions * (1, -1, -1), atol=1e-6)
    srgb = np.clip(0.5 + splats.harmonics[:, 0] / np.sqrt(4 * np.pi), 0, 1)
    bright = srgb > 0.05
    np.testing.assert_allclose((cloud.colors[:, :3] / 255)[bright], srgb[bright] ** 2.2, atol=0.012)
    np.testing.assert_allclose(cloud.colors[:, 3] / 255, splats.opacities, atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize("up", [Y_DOWN, -Y_DOWN, Z_UP, -Z_UP, np.array([1.0, 0, 0]), np.array([0.48, -0.6, 0.64])])
def test_the_node_rotates_up_to_y(up):
    splats = random_splats(5)
    data = gltf.encode(splats, Hints(up))
    turn = Rotation.from_quat(parse_json(data)["nodes"][0]["rotation"])
    np.testing.assert_allclose(turn.apply(up), (0, 1, 0), atol=1e-12)
    upright = gltf.decode(data, "a.glb", upright=True)
    np.testing.assert_allclose(upright.positions, turn.apply(splats.positions), atol=1e-6)
    np.testing.assert_allclose(upright.harmonics, splats.rotated(turn.as_matrix()).harmonics, atol=1e-6)


def test_upright_rotation_is_a_half_turn_for_y_down_and_a_quarter_turn_for_z_up():
    np.testing.assert_array_equal(upright_rotation(Y_DOWN, -Y_DOWN), np.diag((1, -1, -1)))
    np.testing.assert_array_equal(upright_rotation(Z_UP, -Y_DOWN), [[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def test_a_scene_far_away_keeps_its_precision():
    splats = random_splats(100, shift=(5e5, -4e6, 120.0))
    data = gltf.encode(splats, Hints(Z_UP))
    np.testing.assert_allclose(gltf.decode(data, "a.glb").positions, splats.positions, rtol=0, atol=1e-6)
    assert np.abs(parse_json(data)["accessors"][0]["max"]).max() < 8
    assert not choose_local_origin(random_splats(100, shift=(2, 2, 2)).positions).any()


def test_normalized_integers_strides_and_matrices_are_read():
    record = struct.pack("<3f4hHHBBBx3f", 1, 2, 3, 0, 0, 32767, 0, 5, 65535, 255, 0, 51, 0.1, 0.2, 0.3)
    fields = {
        "POSITION": (0, 5126, False, "VEC3"),
        "KHR_gaussian_splatting:ROTATION": (12, 5122, True, "VEC4"),
        "KHR_gaussian_splatting:OPACITY": (22, 5123, True, "SCALAR"),
        "KHR_gaussian_splatting:SCALE": (24, 5121, True, "VEC3"),
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": (28, 5126, False, "VEC3"),
    }
    accessors = [
        {"bufferView": 0, "byteOffset": offset, "componentType": kind, "normalized": norm, "count": 2, "type": shape}
        for offset, kind, norm, shape in fields.values()
    ]
    primitive = {
        "attributes": {name: number for number, name in enumerate(fields)},
        "mode": 0,
        "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    content = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [1]}],
        # The node scales by two and moves; its parent rotates a quarter turn about z.
        "nodes": [
            {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 10, 0, 0, 1]},
            {"children": [0], "rotation": [0, 0, 0.5**0.5, 0.5**0.5]},
        ],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": 80, "byteStride": 40}],
        "buffers": [{"byteLength": 80}],
    }
    read = gltf.decode(build_glb(content, 2 * record), "a.glb", upright=True)
    np.testing.assert_allclose(read.positions, [(-4, 12, 6)] * 2, atol=1e-12)
    np.testing.assert_allclose(read.scales, [(2, 0, 0.4)] * 2, atol=1e-7)
    np.testing.assert_allclose(read.opacities, [1, 1])
    turned = Rotation.from_quat(read.quats[:, [1, 2, 3, 0]]).as_matrix()
    expected = Rotation.from_euler("z", 90, degrees=True) * Rotation.from_quat([0, 0, 1, 0])
    np.testing.assert_allclose(turned, [expected.as_matrix()] * 2, atol=1e-6)
    np.testing.assert_allclose(read.harmonics[:, 0], [(0.1, 0.2, 0.3)] * 2, atol=1e-7)


def test_encoding_no_gaussians_is_refused():
    with pytest.raises(HyrfDataError, match="no Gaussian"):
        gltf.encode(random_splats()[:0], Hints(Y_DOWN))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda c: c["nodes"][0].update(scale=[1, 1, 2]), "scales axes differently"),
        (lambda c: c["nodes"][0].update(children=[0]), "no tree"),
        (lambda c: c["nodes"][0].pop("mesh"), "no Gaussian splats"),
        (lambda c: c["meshes"][0].update(primitives=c["meshes"][0]["primitives"] * 50), "many times"),
        (lambda c: c["accessors"][0].update(count=41), "past the end"),
        (lambda c: c["accessors"][0].update(count=-1), "past the end"),
        (lambda c: c["accessors"][0].update(sparse={}), "sparse"),
        (lambda c: c["buffers"][0].update(uri="a.bin"), "inside the .glb"),
        (lambda c: c["accessors"][0].update(bufferView=-1), "do not fit together"),
        (lambda c: c["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"].pop("kernel"), "'ellipse'"),
    ],
)
def test_invalid_content_is_refused_with_the_reason(change, sentence):
    data = gltf.encode(random_splats(40, degree=0), Hints(Y_DOWN))
    content = parse_json(data)
    change(content)
    with pytest.raises(HyrfDataError, match=f"^a.glb: .*{sentence}"):
        gltf.decode(build_glb(content, data[-content["buffers"][0]["byteLength"] :]), "a.glb")


_SAMPLE_FILE = gltf.encode(random_splats(3, degree=1), Hints(Y_DOWN))


@examples(150)
@given(
    places=st.lists(st.tuples(st.integers(0, len(_SAMPLE_FILE) - 1), st.integers(0, 255)), max_size=4),
    end=st.integers(0, len(_SAMPLE_FILE)) | st.just(len(_SAMPLE_FILE)),
)
def test_damaged_bytes_are_decoded_or_refused(places, end):
    data = bytearray(_SAMPLE_FILE)
    for place, value in places:
        data[place] = value
    try:
        assert isinstance(gltf.decode(bytes(data[:end]), "a.glb"), Splats)
    except HyrfDataError:
        pass


_SAMPLE_BINARY_BYTES = parse_json(_SAMPLE_FILE)["buffers"][0]["byteLength"]
_HOSTILE_JSON_VALUES = st.sampled_from([None, -1, 0, 1e308, 2**70, True, "x", [], {}, [1], float("nan")])


@examples(150)
@given(keys=st.lists(st.integers(0, 30), min_size=1, max_size=6), value=_HOSTILE_JSON_VALUES)
def test_any_invalid_json_entry_is_decoded_or_refused(keys, value):
    content = parse_json(_SAMPLE_FILE)
    target = content
    for key in keys:  # descend by the keys and replace the last entry that is reached
        names = list(target) if isinstance(target, dict) else list(range(len(target)))
        name = names[key % len(names)]
        if not isinstance(target[name], dict | list) or not target[name]:
            break
        above, target = target, target[name]
    else:
        target, name = above, name
    target[name] = value
    try:
        assert isinstance(gltf.decode(build_glb(content, _SAMPLE_FILE[-_SAMPLE_BINARY_BYTES:]), "a.glb"), Splats)
    except HyrfDataError:
        pass
