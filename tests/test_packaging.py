"""The wheel and the source distribution are complete, bounds admit what is tested, and containers name what exists."""

import importlib.metadata
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from mimic.base import distribution
from tests.helpers.repository import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
CONTAINERS = REPOSITORY / "containers"
PIN = re.compile(r"^([\w.-]+)==([^;\s]+)", re.MULTILINE)
PAIR = {"mujoco", "mujoco-mjx"}
BUILD = "import sys; from setuptools import build_meta as b; out = sys.argv[1]; b.build_sdist(out); b.build_wheel(out)"


def tracked_files():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("needs the repository")
    return [name for name in listed.stdout.split("\0") if name and (REPOSITORY / name).is_file()]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Names of the files in the source distribution and in the wheel, built from the files of the repository."""
    if Version(importlib.metadata.version("setuptools")) < Version("77"):
        pytest.skip("needs setuptools 77: install the extra test")
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("out")
    for name in tracked_files():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / name, source / name)
    subprocess.run([sys.executable, "-c", BUILD, str(out)], cwd=source, check=True, capture_output=True, text=True)
    with tarfile.open(next(out.glob("*.tar.gz"))) as archive:
        sdist = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    wheel = next(out.glob("*.whl"))
    with zipfile.ZipFile(wheel) as archive:
        metadata = archive.read(next(name for name in archive.namelist() if name.endswith("METADATA"))).decode()
        return sdist, set(archive.namelist()), wheel.name, metadata


@pytest.mark.slow
def test_the_source_distribution_has_the_repository(built):
    links = ("envs/", "trainers/", "xml/")  # into mimic
    unneeded = re.compile(r"\.(git|ci|pre-commit)|" + "|".join(links))
    expected = {name for name in tracked_files() if not unneeded.match(name)}
    assert expected <= built[0]
    added = {name for name in built[0] - expected if ".egg-info/" not in name}
    assert added == {"PKG-INFO", "setup.cfg"}


@pytest.mark.slow
def test_the_wheel_has_the_package_alone(built):
    _, wheel, name, metadata = built
    assert name == f"{distribution.NAME.replace('-', '_')}-{distribution.VERSION}-py3-none-any.whl"
    package = {file for file in tracked_files() if file.startswith("mimic/")}
    assert {file for file in wheel if ".dist-info/" not in file} == package
    for line in (f"Version: {distribution.VERSION}", "Project-URL: Paper, ", "License-Expression: Apache-2.0"):
        assert line in metadata


def bounds():
    """The requirements of mimic by name, without those of extras."""
    return {requirement.name: requirement for requirement in map(Requirement, PROJECT["dependencies"])}


def test_the_tested_versions_are_within_the_bounds():
    tested = PIN.findall((REPOSITORY / "constraints.txt").read_text())
    assert bounds().keys() <= {name for name, _ in tested}
    for name, version in tested:
        assert name not in bounds() or version in bounds()[name].specifier, (name, version)


def test_mujoco_and_mjx_stay_a_tested_pair():
    """The next minor version of either is not installed before it has been tested."""
    tested = dict(PIN.findall((REPOSITORY / "constraints.txt").read_text()))
    for name in PAIR:
        major, minor, *_ = Version(tested[name]).release
        assert f"{major}.{minor}.99" in bounds()[name].specifier
        for other in (f"{major}.{minor + 1}.0", f"{major + 1}.0.0", f"{major - 1}.0.0"):
            assert other not in bounds()[name].specifier, (name, other)


def shell_lines(text):
    """Shell commands of a recipe's text, with continued lines joined."""
    return [line.strip() for line in text.replace("\\\n", " ").splitlines() if line.strip()]


def dockerfile():
    """The instructions of the Dockerfile."""
    lines = [line for line in shell_lines((CONTAINERS / "Dockerfile").read_text()) if not line.startswith("#")]
    return [(name, text) for name, text in (line.split(maxsplit=1) for line in lines)]


def apptainer_sections():
    """The sections of the Apptainer recipe, the header under the name ""."""
    head, *parts = re.split(r"^%(\w+)\n", (CONTAINERS / "mimic.def").read_text(), flags=re.MULTILINE)
    return {"": head, **dict(zip(parts[::2], parts[1::2], strict=True))}


def is_complete(files):
    """Whether files are all that a build of the package needs."""
    needed = {"pyproject.toml", PROJECT["readme"], *PROJECT["license-files"], "constraints.txt", "mimic"}
    return set(files) == needed and all((REPOSITORY / name).exists() for name in files)


def check_commands(text):
    """Checks a shell text: its syntax, and its one installation of mimic."""
    assert subprocess.run(["sh", "-n"], input=text, text=True, check=False).returncode == 0
    (install,) = [line for line in shell_lines(text) if line.startswith("pip install")]
    words = shlex.split(install)
    assert words[:-1] == ["pip", "install", "--no-cache-dir", "-c", "constraints.txt"] and words[-1].startswith(".")
    assert set(re.findall(r"[a-z]+", words[-1])) <= set(PROJECT["optional-dependencies"])


def check_base(image):
    match = re.fullmatch(r"(\w+):([\d.]+)-slim", image)
    assert match, image
    name, version = match.groups()
    assert name == "python" and f"Programming Language :: Python :: {version}" in PROJECT["classifiers"]


def test_the_dockerfile():
    instructions = dockerfile()
    assert {name for name, _ in instructions} == {
        *("FROM", "ARG", "RUN", "WORKDIR", "COPY", "ENV", "ENTRYPOINT", "CMD"),
    }
    check_base(dict(instructions)["FROM"])
    copies = [text.split() for name, text in instructions if name == "COPY"]
    assert is_complete([source for *sources, _ in copies for source in sources])
    check_commands("\n".join(text for name, text in instructions if name == "RUN"))
    assert dict(instructions)["ENTRYPOINT"] == '["mimic"]' and "mimic" in PROJECT["scripts"]
    assert instructions.index(("WORKDIR", "/opt/mimic")) < instructions.index(("COPY", "mimic ./mimic"))


def test_the_apptainer_recipe():
    sections = apptainer_sections()
    assert set(sections) == {"", "files", "post", "environment", "runscript", "test"}
    header = dict(re.findall(r"^(\w+): (.*)$", sections[""], re.MULTILINE))
    assert header["Bootstrap"] == "docker" and header["From"] == dict(dockerfile())["FROM"]
    copies = [line.split() for line in shell_lines(sections["files"])]
    assert is_complete([source for source, _ in copies]) and {target for _, target in copies} == {"/opt/mimic/"}
    check_commands(sections["post"])
    assert "cd /opt/mimic" in shell_lines(sections["post"]) and sections["runscript"].strip() == 'exec mimic "$@"'


def test_both_containers_install_the_same_system_packages():
    def packages(text):
        return re.findall(r"apt-get install -y --no-install-recommends (.*?) &&", text)

    (docker,) = packages((CONTAINERS / "Dockerfile").read_text())
    assert [docker] == packages((CONTAINERS / "mimic.def").read_text())
    assert all(name in Path(REPOSITORY / "docs/install.md").read_text() for name in docker.split())
