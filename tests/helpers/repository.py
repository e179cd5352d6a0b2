"""Where the repository is that the tests belong to."""

import pathlib

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
