"""Every GPU kernel compiles for every supported GPU as it is launched, without register spills; no GPU is needed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from filelock import FileLock  # comes with torch
from ops.device import needs_triton

from tools.gpu.build_tables import format_comparison
from tools.gpu.sass import parse_listing

REPOSITORY_ROOT = Path(__file__).parents[2]
# Versions of Triton for which the kernels are arranged, and the bytes that a few kernels spill there. 3.9 spills 6 to
# 104 bytes in three builds (sm_80 and gfx942).
KNOWN_SPILLS = {
    "3.6.": {
        ("adam.gpu.adam_step_kernel", "sm_86"): 16,
        ("adam.gpu.adam_step_kernel", "sm_89"): 16,
        ("adam.gpu.adam_step_kernel", "sm_90"): 8,
        ("mlp.gpu.backward_kernel", "sm_120"): 32,
    },
    "3.7.": {("mlp.gpu.backward_kernel", "sm_120"): 8},
}
GPU_TARGETS = ["sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120", "gfx942"]

pytestmark = needs_triton


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list]:
    """The report of tools/gpu/build.py, run in another process, because here kernels may be interpreted.

    The workers of one test run share it, because each build takes a minute.
    """
    record = (
        tmp_path_factory.getbasetemp().parent / f"gpu_build-{os.environ.get('PYTEST_XDIST_TESTRUNUID', os.getpid())}"
    )
    with FileLock(f"{record}.lock"):
        if not record.exists():
            environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
            command = [sys.executable, "-m", "tools.gpu.build", "--json"]
            done = subprocess.run(command, cwd=REPOSITORY_ROOT, env=environment, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            record.write_text(done.stdout.splitlines()[-1])
    return json.loads(record.read_text())


def builds_for(report: dict[str, list], target: str) -> list[dict]:
    (probe,) = (probe for probe in report["probes"] if probe["target"] == target)
    if probe["error"]:
        pytest.skip(f"this Triton does not build for {target}: {probe['error']}")
    assert probe["spills"] > 0, "a kernel of too many registers shows no spills, so that those of others are not seen"
    return [build for build in report["builds"] if build["target"] == target]


@pytest.mark.parametrize("target", GPU_TARGETS)
def test_every_kernel_builds(report: dict[str, list], target: str) -> None:
    builds = builds_for(report, target)
    assert builds
    assert [f"{build['kernel']}: {build['error']}" for build in builds if build["error"]] == []


@pytest.mark.parametrize("target", GPU_TARGETS)
def test_no_kernel_spills_more_registers_than_known(report: dict, target: str) -> None:
    known = next((spills for prefix, spills in KNOWN_SPILLS.items() if report["triton"].startswith(prefix)), None)
    builds = builds_for(report, target)
    spilling = [build for build in builds if build["spills"] > (known or {}).get((build["kernel"], target), 0)]
    messages = [f"{build['kernel']}: {build['spills']} ({build['constants']})" for build in spilling]
    if messages and known is None:
        pytest.xfail(
            f"Triton {report['triton']} takes more registers than those the kernels were laid out for: {messages}"
        )
    assert messages == []


# Instructions of the blending loops for a pair, of which an iteration handles several, on sm_89 and sm_90 alike.
PAIRS_PER_ITERATION = {"blend": 4, "blend_backward": 2}
LOOP_INSTRUCTIONS_PER_PAIR = {
    ("blend", "DEPTH=False"): 141,
    ("blend", "DEPTH=True"): 148,
    ("blend_backward", "ABSGRAD=False"): 420,
    ("blend_backward", "ABSGRAD=True"): 467,
}
LOOP_TOLERANCE = 0.05


def sass_builds(report: dict[str, list], target: str, kernel: str) -> list[dict]:
    builds = [build for build in builds_for(report, target) if build["kernel"].endswith(f".{kernel}")]
    if any(build["sass"] is None for build in builds):
        pytest.skip(f"Triton {report['triton']} comes without nvdisasm")
    return builds


@pytest.mark.parametrize("target", ["sm_89", "sm_90"])
@pytest.mark.parametrize(("kernel", "option"), LOOP_INSTRUCTIONS_PER_PAIR)
def test_a_pair_takes_as_many_instructions_as_before(report: dict, target: str, kernel: str, option: str) -> None:
    builds = [build for build in sass_builds(report, target, kernel) if option in build["constants"].split()]
    assert builds
    for build in builds:
        per_pair = build["sass"]["loop_instructions"] / PAIRS_PER_ITERATION[kernel]
        assert per_pair == pytest.approx(LOOP_INSTRUCTIONS_PER_PAIR[kernel, option], rel=LOOP_TOLERANCE)


@pytest.mark.parametrize(("target", "scalar", "vector"), [("sm_89", 16, 0), ("sm_90", 0, 8)])
def test_both_features_of_a_vertex_are_added_at_once_where_the_gpu_can(
    report: dict, target: str, scalar: int, vector: int
) -> None:
    """A point adds two float32 to each of 8 vertices. GPUs before sm_90 have no addition of several numbers."""
    for build in sass_builds(report, target, "grad_table_kernel"):
        assert (build["sass"]["scalar_adds"], build["sass"]["vector_adds"]) == (scalar, vector), build["constants"]


# Instructions on float64 for each Gaussian, on sm_89 and sm_90 alike. Other kernels have none.
FLOAT64_INSTRUCTIONS = {
    ("rasterize.gpu_cull.frustum_kernel", None): 26,
    ("rasterize.gpu_project.project", "ANTIALIASED=False"): 185,
    ("rasterize.gpu_project.project", "ANTIALIASED=True"): 218,
    ("rasterize.gpu_project.project_backward", "ANTIALIASED=False"): 368,
    ("rasterize.gpu_project.project_backward", "ANTIALIASED=True"): 405,
    ("rasterize.gpu_shaded.project_shaded_kernel", "ANTIALIASED=False"): 203,
    ("rasterize.gpu_shaded.project_shaded_kernel", "ANTIALIASED=True"): 236,
}
FLOAT64_TOLERANCE = 0.05


@pytest.mark.parametrize("target", ["sm_89", "sm_90"])
def test_kernels_use_as_much_float64_as_before(report: dict, target: str) -> None:
    builds = [build for build in builds_for(report, target) if not build["error"]]
    if any(build["sass"] is None for build in builds):
        pytest.skip(f"Triton {report['triton']} comes without nvdisasm")
    found = set()
    for build in builds:
        options = {None, *build["constants"].split()}
        keys = [key for key in FLOAT64_INSTRUCTIONS if key[0] == build["kernel"] and key[1] in options]
        expected = FLOAT64_INSTRUCTIONS[keys[0]] if keys else 0
        found.update(keys)
        counted = build["sass"]["float64"]
        assert counted == pytest.approx(expected, rel=FLOAT64_TOLERANCE), f"{build['kernel']} {build['constants']}"
    assert {kernel for kernel, _ in found} == {kernel for kernel, _ in FLOAT64_INSTRUCTIONS}


DISASSEMBLY_LISTING = """
first:
.text.first:
        /*0000*/                   S2R R0, SR_CTAID.X ;
.L_x_1:
        /*0010*/                   FADD R1, R1, R2 ;
        /*0020*/              @!P0 BRA `(.L_x_2) ;
        /*0030*/                   REDG.E.ADD.F32x2.FTZ.RN.STRONG.GPU desc[UR4][R2.64], R4 ;
.L_x_2:
        /*0040*/                   RED.E.ADD.F32.FTZ.RN.STRONG.GPU [R2.64], R4 ;
        /*0050*/                   RED.E.ADD.F32.FTZ.RN.STRONG.GPU [R2.64+0x4], R4 ;
        /*0060*/               @P1 BRA `(.L_x_1) ;
        /*0070*/                   REDUX.MIN.S32 UR4, R0 ;
        /*0078*/                   DFMA R4, R2, R2, -R8 ;
        /*0078*/              @P0  DSETP.GT.AND P1, PT, R4, UR4, PT ;
        /*0078*/                   F2F.F32.F64 R6, R4 ;
        /*0078*/                   MUFU.RSQ64H R7, R9 ;
        /*0078*/                   LDG.E.64 R8, desc[UR4][R2.64] ;
.L_x_3:
        /*0080*/                   BRA `(.L_x_3);
"""


def test_loops_additions_and_float64_are_read_from_a_listing() -> None:
    facts = {"loop_instructions": 6, "scalar_adds": 2, "vector_adds": 1, "float64": 4}
    assert asdict(parse_listing(DISASSEMBLY_LISTING)) == facts
    assert asdict(parse_listing(DISASSEMBLY_LISTING.replace("@P1 BRA `(.L_x_1)", "@P1 EXIT")))["loop_instructions"] == 0


def test_versions_of_triton_are_compared_kernel_by_kernel() -> None:
    def report(registers: int, spills: int) -> dict:
        rows = [("sm_90", registers, spills), ("sm_89", 64, 0), ("sm_90", 32, 0)]
        builds = [{"kernel": "a.b", "target": target, "registers": r, "spills": s} for target, r, s in rows]
        return {"builds": builds}

    *_, row = format_comparison([report(78, 8), report(80, 0)])
    assert row == "| `a.b` | 0 | 64 | 78 + 8 / 80 | 0 |"


def test_every_kernel_is_built(report: dict[str, list]) -> None:
    assert report["builds"]
    assert report["left_out"] == []


def test_a_folder_without_triton_is_not_compared(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tools.gpu.build", "--compare", str(tmp_path)]
    done = subprocess.run(command, cwd=REPOSITORY_ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and "there is no Triton" in done.stderr
