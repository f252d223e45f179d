"""The wheel and the sdist hold the package and nothing else, and their metadata is complete."""

from __future__ import annotations

import hashlib
import re
import sys
import tarfile
import zipfile
from email import message_from_bytes
from email.message import Message
from pathlib import Path

import pytest
from distributions import (
    REPOSITORY_ROOT,
    build_distribution,
    copy_repository,
    list_repository_files,
    make_environment,
    run_in_environment,
    wheel_requirements,
)

import hyrfpack

DISTRIBUTED_DOCUMENTS = (
    *("CHANGELOG.md", "CITATION.cff", "LICENSE", "MANIFEST.in", "README.md", "SECURITY.md", "pyproject.toml"),
)


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """The wheel and the sdist of a clean copy, and the wheel that is built from this sdist."""
    folder = tmp_path_factory.mktemp("built")
    source = copy_repository(folder / "source")
    sdist = build_distribution("sdist", source, folder)
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    (folder / "again").mkdir()
    return {
        "sdist": sdist,
        "wheel": build_distribution("wheel", source, folder),
        "wheel of the sdist": build_distribution("wheel", unpacked, folder / "again"),
    }


def digests(wheel: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of the package in a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if ".dist-info/" not in name]
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in names}


@pytest.fixture(scope="module")
def metadata(built) -> Message:
    with zipfile.ZipFile(built["wheel"]) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        return message_from_bytes(archive.read(name))


def package_files() -> dict[str, str]:
    """Return the SHA-256 of each file that belongs to the package."""
    names = [name for name in list_repository_files() if name.startswith("hyrfpack/")]
    return {name: hashlib.sha256((REPOSITORY_ROOT / name).read_bytes()).hexdigest() for name in names}


@pytest.mark.parametrize("which", ["wheel", "wheel of the sdist"])
def test_a_wheel_holds_every_file_of_the_package_and_nothing_else(built, which):
    assert digests(built[which]) == package_files()


def test_the_sdist_holds_the_package_and_its_documents_and_no_tests(built):
    with tarfile.open(built["sdist"]) as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    generated = {name for name in names if name in ("PKG-INFO", "setup.cfg") or name.startswith("hyrfpack.egg-info/")}
    assert names - generated == {*package_files(), *DISTRIBUTED_DOCUMENTS}


def test_the_metadata_is_complete(metadata):
    assert metadata["Version"] == hyrfpack.__version__
    assert (metadata["License-Expression"], metadata["License-File"]) == ("Apache-2.0", "LICENSE")
    assert metadata["Requires-Python"] == ">=3.10"
    assert metadata["Description-Content-Type"] == "text/markdown"
    versions = re.findall(r"Python :: (3\.\d+)", "\n".join(metadata.get_all("Classifier")))
    assert versions[0] == "3.10" and f"{sys.version_info[0]}.{sys.version_info[1]}" in versions


@pytest.mark.parametrize("extra", ["poses", "usd", "video"])
def test_an_extra_asks_for_what_the_default_set_has(metadata, extra):
    requirements = [line.partition(";")[::2] for line in metadata.get_all("Requires-Dist")]
    default = {package for package, condition in requirements if "extra ==" not in condition}
    assert {package for package, condition in requirements if condition.strip() == f'extra == "{extra}"'} <= default
    assert extra in metadata.get_all("Provides-Extra")


def test_the_citation_has_the_version_of_the_package():
    assert f"\nversion: {hyrfpack.__version__}\n" in (REPOSITORY_ROOT / "CITATION.cff").read_text(encoding="utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="links to packages need administrator rights")
def test_the_installed_wheel_passes_the_smoke_check(built, tmp_path):
    python = make_environment(tmp_path / "environment", built["wheel"], *wheel_requirements(built["wheel"]))
    done = run_in_environment(python, REPOSITORY_ROOT / "tools" / "safety" / "smoke.py")
    assert done.returncode == 0, done.stderr
    assert str(tmp_path) in done.stdout  # the installed package is checked, not this checkout
