"""Recordings and models of others, which tests use where they are: a folder beside the repository."""

import os
from pathlib import Path

import pytest

from tests.helpers.repository import REPOSITORY

DATA = Path(os.environ.get("MIMIC_TEST_DATA", REPOSITORY.parent / "shared" / "data"))
PANDA_LOG, TELEOP = DATA / "panda_log", DATA / "teleop" / "so101_to_piper"
ROBOSUITE = DATA / "robosuite_demos"


def needs(path: Path) -> pytest.MarkDecorator:
    """Skips a test where a file or folder is missing."""
    return pytest.mark.skipif(not path.exists(), reason=f"{path} is missing; MIMIC_TEST_DATA names its folder")
