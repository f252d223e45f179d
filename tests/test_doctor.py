"""`hyrfpack doctor` and `diagnose_machine` describe a machine, whatever is missing or broken there."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from importlib.metadata import version
from math import inf, nan

import pytest
import torch
from commands import refused, succeeded
from fake_gpu import use_fake_gpu

from hyrfpack import doctor
from hyrfpack.doctor import COMPUTING_PACKAGES, diagnose_machine
from hyrfpack.self_test import SelfTest, run_self_test
from hyrfpack.version import __version__

BROKEN_MLP_TEST = SelfTest(
    "cpu", "cpu", ({"item": "mlp", "operation": "mlp", "status": "failed", "note": "outputs is NaN"},)
)


@pytest.fixture
def broken_kernels(monkeypatch):
    monkeypatch.setattr("hyrfpack.self_test.run_self_test", lambda implementation, device: BROKEN_MLP_TEST)


def test_the_report_has_the_versions_that_are_installed():
    report = diagnose_machine("cpu", self_test=False)
    assert report.versions["hyrfpack"] == __version__
    assert report.versions["python"] == ".".join(map(str, sys.version_info[:3]))
    assert all(report.versions[name] in (None, version(name)) for name in COMPUTING_PACKAGES if report.versions[name])
    assert report.self_test is None and report.device == "cpu" and report.memory_bytes > 1 << 28


def test_json_is_the_whole_report(broken_kernels):
    found = json.loads(succeeded("doctor", "--json", "--device", "cpu").stdout)
    assert found["self_test"]["rows"] == list(BROKEN_MLP_TEST.rows)
    assert "kernels of mlp: outputs is NaN" in found["problems"]


def test_json_stores_an_error_that_is_not_finite_as_null(monkeypatch):
    (row,) = BROKEN_MLP_TEST.rows
    broken = replace(BROKEN_MLP_TEST, rows=({**row, "value error": inf, "gradient error": nan},))
    monkeypatch.setattr("hyrfpack.self_test.run_self_test", lambda *_: broken)
    found = json.loads(succeeded("doctor", "--json", "--device", "cpu").stdout)
    assert found["self_test"]["rows"] == [{**row, "value error": None, "gradient error": None}]


def test_the_text_is_a_block_to_paste_and_names_broken_kernels(broken_kernels):
    lines = succeeded("doctor", "--device", "cpu").stdout.splitlines()
    assert lines[0] == lines[-1] == "```"
    assert "self-test: 0 of 1 cases of the cpu kernels passed in 0.0 s" in lines
    assert "problem: kernels of mlp: outputs is NaN" in lines


def test_cases_that_fail_for_one_reason_are_one_problem(monkeypatch):
    rows = [{"item": name, "operation": "mlp", "status": "failed", "note": "late"} for name in ("mlp", "mlp, mixed")]
    monkeypatch.setattr("hyrfpack.self_test.run_self_test", lambda *_: SelfTest("cpu", "cpu", tuple(rows)))
    assert "kernels of mlp; mlp, mixed: late" in diagnose_machine("cpu").problems


def test_no_self_test_runs_none(monkeypatch):
    monkeypatch.setattr("hyrfpack.self_test.run_self_test", lambda *_: pytest.fail("the self-test was run"))
    assert "self-test: not run" in succeeded("doctor", "--no-self-test").stdout


def test_missing_and_broken_packages_are_reported_with_what_they_are_for(monkeypatch):
    installed = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "pycolmap" else installed(name))
    monkeypatch.setitem(sys.modules, "numba", None)  # importing it raises ImportError
    report = diagnose_machine("cpu", self_test=False)
    assert report.missing["pycolmap"] == {
        "needed_for": "COLMAP models, estimating poses",
        "install": 'pip install "hyrfpack[poses]"',
    }
    assert not any("pycolmap" in problem for problem in report.problems)


@pytest.mark.parametrize("error", [ImportError, OSError, RuntimeError, SystemError, AttributeError])
def test_a_torch_that_cannot_be_imported_is_a_problem_and_not_the_end(error, monkeypatch):
    class Refuses:
        def find_spec(self, name, path=None, target=None):
            if name == "torch":
                raise error("\nlibcudart.so is damaged")

    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setattr(sys, "meta_path", [Refuses(), *sys.meta_path])
    monkeypatch.setattr(doctor, "OPTIONAL_PACKAGES", {})
    monkeypatch.setenv("HYRFPACK_THREADS", "3")
    lines = succeeded("doctor").stdout.splitlines()
    assert "problem: torch cannot be imported: libcudart.so is damaged" in lines
    assert lines[3].startswith("CPU: ") and lines[3].endswith(", 3 cores, unknown memory")
    assert "device: none" in lines and "self-test: not run" in lines


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there_is_a_problem():
    output = succeeded("doctor", "--device", "cuda").stdout
    assert "problem: device 'cuda' is not available" in output and "use --device cpu" in output


def test_a_driver_without_a_gpu_for_torch_is_a_problem(monkeypatch):
    monkeypatch.setattr("hyrfpack.measure.machine.driver_version", lambda: "580.65.06")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    (problem,) = [text for text in diagnose_machine("cpu", self_test=False).problems if "driver" in text]
    assert problem.startswith("there is a GPU driver, version 580.65.06, but torch sees no GPU")


def test_a_text_that_names_no_device_is_refused():
    assert "'gpu' is not a device" in refused("doctor", "--device", "gpu")


def test_a_gpu_is_described_and_its_result_stored(monkeypatch, tmp_path):
    stored = []
    monkeypatch.setattr("hyrfpack.self_test.run_self_test", lambda *_: replace(BROKEN_MLP_TEST, implementation="gpu"))
    monkeypatch.setattr("hyrfpack.self_test.store_self_test", lambda test, device: stored.append(test.implementation))
    with use_fake_gpu():
        output = succeeded("doctor", "--device", "cuda").stdout
    assert "GPU 0: a GPU that is not there, 8.0 GiB, capability 9.0" in output
    assert "device: cuda (a GPU that is not there)" in output or "device: cuda:0 (a GPU that is not there)" in output
    assert stored == ["gpu"]


@pytest.mark.acceptance
def test_the_worker_of_the_self_test_can_be_started_from_any_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hyrfpack.self_test.run.list_self_test_cases", dict)
    assert run_self_test("cpu", torch.device("cpu")) == SelfTest("cpu", "cpu", ())
