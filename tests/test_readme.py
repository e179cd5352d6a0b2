"""What the README shows, works."""

import pathlib
import re

import mimic

README = (pathlib.Path(__file__).resolve().parent.parent / "README.md").read_text()


def test_the_python_example_runs():
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert blocks
    scope: dict = {}
    for block in blocks:
        exec(block, scope)  # noqa: S102 - our own text
    assert scope["bound"].shape == (scope["demonstrations"].horizon + 1,)
    assert scope["gradient"].shape == (4,)


def test_it_names_every_environment_and_only_what_exists():
    for name in mimic.environments():
        assert f"`{name}`" in README
    table = README.split("| to | call |")[1].split("\n\n")[0]
    for name in re.findall(r"`(\w+)`", table):
        assert hasattr(mimic, name), name
    for path in re.findall(r"\]\(((?!http)[^)]+)\)", README):
        assert (pathlib.Path(__file__).resolve().parent.parent / path).exists(), path
