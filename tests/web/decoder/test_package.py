"""The decoder is an npm package without dependencies whose modules have types."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

import hyrfpack
from hyrfpack.format import describe_file
from hyrfpack.format.arrays import group_shapes, parse_config
from hyrfpack.format.container import read_container
from hyrfpack.format.sections import DECODER_SECTIONS, LAYERED_SECTIONS, TABLE_SECTIONS
from hyrfpack.model import HashGridConfig

PROJECT_FOLDER = Path(__file__).parents[3]
PACKAGE_FOLDER = PROJECT_FOLDER / "hyrfpack" / "web" / "hyrf"
GOLDEN_FOLDER = PROJECT_FOLDER / "tests" / "golden"
PUBLIC_MODULES = (
    "index",
    "grids",
    "exposure",
    "fields",
    "frustum",
    "harmonics",
    "levels",
    "manifest",
    "places",
    "remote",
    "remote_worker",
    "rotation",
    "row_states",
    "sampling",
    "sort",
    "view_evaluator",
    "viewpoint",
)


def run_module(code: str, folder: Path, *arguments: str) -> object:
    """Run a module in node and return the JSON that it prints."""
    completed = subprocess.run(
        ["node", "--input-type=module", "-e", code, *arguments], cwd=folder, capture_output=True, text=True
    )
    assert completed.returncode == 0, completed.stderr
    return json.loads(completed.stdout)


def test_type_declarations_pass_the_typescript_compiler(compiler):
    completed = subprocess.run(
        ["node", str(compiler), "--project", str(Path(__file__).with_name("tsconfig.json"))],
        capture_output=True,
        text=True,
    )

    assert completed.returncode == 0, completed.stdout


def test_the_package_has_the_version_and_license_of_hyrfpack():
    package = json.loads((PACKAGE_FOLDER / "package.json").read_text())

    assert package["version"] == hyrfpack.__version__
    assert package["license"] == "Apache-2.0"
    assert (PACKAGE_FOLDER / "LICENSE").read_bytes() == (PROJECT_FOLDER / "LICENSE").read_bytes()


def test_examples_import_only_exported_modules():
    exports = json.loads((PACKAGE_FOLDER / "package.json").read_text())["exports"]
    codes = [path.read_text() for path in (PROJECT_FOLDER / "examples" / "three").glob("*.js")]

    imported = {name for code in codes for name in re.findall(r'from "hyrf\.js/([\w.]+)"', code)}
    assert imported and {f"./{name}" for name in imported} <= exports.keys()


def test_public_modules_are_exported():
    exports = json.loads((PACKAGE_FOLDER / "package.json").read_text())["exports"]

    assert exports == {
        ("." if name == "index" else f"./{name}.js"): {"types": f"./types/{name}.d.ts", "default": f"./{name}.js"}
        for name in PUBLIC_MODULES
    }
    assert all((PACKAGE_FOLDER / file).exists() for files in exports.values() for file in files.values())


def test_modules_import_only_each_other_and_use_no_browser_objects():
    for module in PACKAGE_FOLDER.glob("*.js"):
        code = module.read_text()
        for source in re.findall(r'^import .* from "(.*)";$', code, re.MULTILINE):
            assert (PACKAGE_FOLDER / source).parent == PACKAGE_FOLDER and (PACKAGE_FOLDER / source).exists()
        # The bundler accepts only this one-line form of import.
        assert len(re.findall(r"^import\b", code, re.MULTILINE)) == len(
            re.findall(r'^import \{ [\w, ]+ \} from "\./\w+\.js";$', code, re.MULTILINE)
        )
        assert not re.search(r"\b(document|window|eval|require)\b[.(]", code), module.name


def test_only_a_failed_allocation_is_reported_as_too_little_memory():
    code = """
        import { explainMemory } from "./errors.js";
        const attempts = [
          () => new ArrayBuffer(2 ** 52), () => new Uint8Array(2 ** 52), () => new Float32Array(-1),
          () => new DataView(new ArrayBuffer(1)).getUint32(0), () => (1).toFixed(999),
          function recurse() { recurse(); },
        ];
        const messages = attempts.map((attempt) => {
          try { return attempt(); } catch (error) { return explainMemory(error).message; }
        });
        console.log(JSON.stringify(messages.map((message) => message.includes("more memory than there is"))));"""

    assert run_module(code, PACKAGE_FOLDER) == [True, True, True, False, False, False]


def test_a_section_of_2_to_the_31_numbers_is_refused_for_its_size():
    code = """
        import { decodeTokens } from "./rans.js";
        try { decodeTokens(new Uint8Array(9), 2 ** 31, null); } catch ({ name, message }) {
          console.log(JSON.stringify([name, message]));
        }"""

    name, message = run_module(code, PACKAGE_FOLDER)

    assert name == "HyrfFormatError" and "too large for this reader" in message and "damaged" not in message


def test_levels_are_chosen_by_one_limit():
    code = """
        import { selectLevels } from "./levels.js";
        try { selectLevels({}, {}, { gaussians: 1, bytes: 1 }); } catch ({ name, message }) {
          console.log(JSON.stringify([name, message]));
        }"""

    assert run_module(code, PACKAGE_FOLDER) == ["TypeError", "Give `gaussians` or `bytes`, not both."]


@pytest.mark.acceptance
def test_the_packed_and_installed_package_reads_a_file(npm, tmp_path):
    listed = subprocess.run(
        [npm, "pack", "--dry-run", "--json"], cwd=PACKAGE_FOLDER, capture_output=True, text=True, check=True
    )
    (pack,) = json.loads(listed.stdout)
    modules = {path.name for path in PACKAGE_FOLDER.glob("*.js")}
    types = {f"types/{path.name}" for path in (PACKAGE_FOLDER / "types").iterdir()}
    assert {file["path"] for file in pack["files"]} == modules | types | {"package.json", "README.md", "LICENSE"}
    assert pack["size"] < 95_000

    subprocess.run(
        [npm, "pack", "--pack-destination", str(tmp_path)], cwd=PACKAGE_FOLDER, capture_output=True, check=True
    )
    (archive,) = tmp_path.glob("*.tgz")
    (tmp_path / "app").mkdir()
    (tmp_path / "app" / "package.json").write_text("{}")
    install = [npm, "install", "--offline", "--no-audit", "--no-fund", str(archive)]
    subprocess.run(install, cwd=tmp_path / "app", capture_output=True, check=True)
    code = """
        import { readFileSync } from "node:fs";
        import { read } from "hyrf.js";
        import { gridLevels } from "hyrf.js/grids.js";
        const model = await read(readFileSync(process.argv[1]));
        console.log(JSON.stringify([Array.from(model.positions), gridLevels(model.config.geometry).length]));
    """
    positions, levels = run_module(code, tmp_path / "app", str(GOLDEN_FOLDER / "v1.1_compact.hyrf"))

    recorded = np.load(GOLDEN_FOLDER / "v1.1_compact.npz")["gaussians.positions"]
    assert np.array_equal(np.array(positions, np.float32), recorded.ravel())
    assert levels == 2


def test_shapes_of_grids_and_decoders_equal_those_of_hyrfpack():
    rng = np.random.default_rng(1)
    facts = describe_file(GOLDEN_FOLDER / "v1.0_raw.hyrf")["config"]
    configs = []
    for _ in range(3000):
        base = int(rng.integers(2, 1 + 2 ** rng.integers(1, 17)))
        finest = int(rng.integers(base, 65537)) if rng.random() < 0.5 else min(65536, base << int(rng.integers(0, 9)))
        grid = {"log2_table_size": int(rng.integers(4, 25)), "levels": int(rng.integers(1, 33))}
        grid |= {"base": base, "finest": finest}
        encoding = str(rng.choice(["sh", "frequency"]))
        configs.append(facts | {"radiance": grid, "hidden": int(rng.integers(1, 1025)), "direction_encoding": encoding})
    code = """
        import { readFileSync } from "node:fs";
        import { decoderLayout, decoderSize, gridLevels, tableRows } from "./grids.js";
        const configs = JSON.parse(readFileSync(0));
        console.log(JSON.stringify(configs.map((config) => [
          gridLevels(config.radiance).map(({ resolution, first, rows }) => [resolution, first, first + rows]),
          tableRows(config.radiance),
          ...["geometry", "radiance"].map((field) => decoderSize(config, field)),
          decoderLayout(config, "radiance"),
        ])));
    """
    completed = subprocess.run(
        ["node", "--input-type=module", "-e", code],
        input=json.dumps(configs),
        cwd=PACKAGE_FOLDER,
        capture_output=True,
        text=True,
        check=True,
    )

    for config, (levels, rows, geometry, radiance, layers) in zip(configs, json.loads(completed.stdout), strict=True):
        grid, shapes = HashGridConfig(**config["radiance"]), group_shapes(parse_config(config), 0)
        assert [level[0] for level in levels] == list(grid.resolutions)
        assert [level[1] for level in levels] + [levels[-1][2]] == list(grid.offsets)
        assert rows == grid.rows
        assert [(geometry, 1), (radiance, 1)] == [shapes[tag] for tag in DECODER_SECTIONS]
        hidden, directions = config["hidden"], {"sh": 9, "frequency": 24}[config["direction_encoding"]]
        inputs = 2 * grid.levels + directions
        assert [(layer["inputs"], layer["outputs"]) for layer in layers] == [
            (inputs, hidden),
            (hidden, hidden),
            (hidden, 3),
        ]
        assert [layer["bias"] - layer["matrix"] for layer in layers] == [inputs * hidden, hidden * hidden, 3 * hidden]


def test_a_file_is_described_from_its_first_bytes():
    file = GOLDEN_FOLDER / "v1.1_compact_layers.hyrf"
    data = file.read_bytes()
    container = read_container(data)
    start = 48 + 40 * len(container.entries)
    code = """
        import { readFileSync } from "node:fs";
        import { describe } from "./index.js";
        const bytes = readFileSync(process.argv[1]);
        const facts = describe(bytes.subarray(0, Number(process.argv[2])));
        let refused = "";
        try { describe(bytes.subarray(0, Number(process.argv[2]) - 1)); } catch (error) { refused = error.message; }
        console.log(JSON.stringify({ facts, refused, same: describe(bytes) }));
    """

    answer = run_module(code, PACKAGE_FOLDER, str(file), str(start))

    first = ("META", *LAYERED_SECTIONS, *TABLE_SECTIONS, *DECODER_SECTIONS)
    assert (
        answer["facts"]
        == answer["same"]
        == {
            "version": list(container.version),
            "length": len(data),
            "sections": [
                {"type": e.type, "codec": e.codec, "offset": e.offset, "stored": e.length, "raw": e.raw_length}
                for e in container.entries.values()
            ],
            "firstLayer": max(container.entries[tag].end for tag in first),
        }
    )
    assert "within its table of contents" in answer["refused"]


def test_a_file_is_read_in_a_worker():
    code = """
        import { readFileSync } from "node:fs";
        import { pathToFileURL } from "node:url";
        import { Worker } from "node:worker_threads";
        const source = `
          import { parentPort, workerData } from "node:worker_threads";
          const { read } = await import(workerData.reader);
          const model = await read(new Uint8Array(workerData.bytes));
          parentPort.postMessage(model, [model.positions.buffer]);
        `;
        const shared = new SharedArrayBuffer(readFileSync(process.argv[1]).length);
        new Uint8Array(shared).set(readFileSync(process.argv[1]));
        const reader = pathToFileURL("index.js").href;
        const url = new URL("data:text/javascript," + encodeURIComponent(source));
        const worker = new Worker(url, { workerData: { reader, bytes: shared } });
        worker.once("message", ({ count, positions }) => console.log(JSON.stringify([count, Array.from(positions)])));
    """

    count, positions = run_module(code, PACKAGE_FOLDER, str(GOLDEN_FOLDER / "v1.1_compact.hyrf"))

    recorded = np.load(GOLDEN_FOLDER / "v1.1_compact.npz")["gaussians.positions"]
    assert count == len(recorded) and np.array_equal(np.array(positions, np.float32), recorded.ravel())


def test_documentation_and_readme_mention_the_package_and_the_three_js_loader():
    page, readme = ((PROJECT_FOLDER / path).read_text() for path in ("docs/how-to/web.md", "README.md"))

    for place in ("hyrfpack/web/hyrf", "examples/three"):
        assert place in page and (PROJECT_FOLDER / place / "README.md").exists()
    assert "npm install ./hyrfpack/web/hyrf" in page and "loadHyrf" in page
    assert "hyrf.js" in readme and "three.js" in readme and "docs/how-to/web.md#in-your-own-javascript" in readme
    assert "\n## In your own JavaScript\n" in page
