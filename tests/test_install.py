"""The installed package is found from every folder, and its name is in one place."""

import os
import re
import subprocess
import sys
import tomllib

import yaml

from mimic.base import distribution
from tests.helpers.repository import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]


def test_all_files_agree_on_the_name_and_the_version():
    assert PROJECT["name"] == distribution.NAME
    assert set(re.findall(r"(mimic[\w-]*)\[", str(PROJECT["optional-dependencies"]))) == {distribution.NAME}
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert citation["version"] == distribution.VERSION and distribution.NAME in citation["abstract"]
    assert distribution.NAME in (REPOSITORY / "README.md").read_text()


def test_mimic_is_imported_next_to_a_clone(tmp_path):
    """A folder named mimic without an `__init__.py`, as a clone is, must not be taken for the package."""
    (tmp_path / "mimic").mkdir()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    code = "import mimic\nassert mimic.__file__, 'an empty package: install mimic again, with make install'"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
