"""What the README and the pages in docs show, works."""

import pathlib
import re

import pytest

import mimic
from mimic.trainers import session
from mimic.trainers.config import PoseMapperConfig, TrainConfig

REPOSITORY = pathlib.Path(__file__).resolve().parent.parent
README = (REPOSITORY / "README.md").read_text()
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]


def run_examples(text, **names):
    """Runs the Python examples of a page, one after the other."""
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert blocks
    scope: dict = dict(names)
    for block in blocks:
        exec(block, scope)  # noqa: S102 - our own text
    return scope


def test_the_example_of_the_readme_runs():
    scope = run_examples(README)
    assert scope["bound"].shape == (scope["demonstrations"].horizon + 1,)
    assert scope["gradient"].shape == (4,)


def test_the_examples_on_poses_run(tmp_path):
    settings = {"samples": 256, "batch_size": 128, "epochs": 1, "hidden_layers": [8], "held_out_poses": 32}
    trainer = PoseMapperConfig(**settings, evaluations=1, validation_poses=32)
    config = TrainConfig(mimic.env_config("panda4dof"), trainer, run_dir=str(tmp_path / "run"), compilation_cache="")
    assert session.prepare_training(config, 0.0)() == 0
    page = (REPOSITORY / "docs" / "static_pose_imitation.md").read_text()
    scope = run_examples(page, run_dir=tmp_path / "run")
    assert scope["found"].qpos.shape == (100, 4) and scope["learner_poses"].shape == (10, 4)
    assert scope["followed"].qpos.shape == (50, 4)


def test_the_readme_names_every_environment_and_only_what_exists():
    for name in mimic.environments():
        assert f"`{name}`" in README
    table = README.split("| to | call |")[1].split("\n\n")[0]
    for name in re.findall(r"`(\w+)`", table):
        assert hasattr(mimic, name), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(((?!http)[^)]+)\)", page.read_text()):
        path, _, heading = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        headings = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE) if heading else []
        assert not heading or heading in [text.lower().replace(" ", "-") for text in headings], link
