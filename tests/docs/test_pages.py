"""Commands and code in README.md and the pages work; tests/helpers/pages.py describes how they are checked."""

import re

import pytest

import mimic
from tests.helpers.pages import PAGES, REPOSITORY, Block, check, commands, module, read_blocks, run_page

DOCS = REPOSITORY / "docs"
QUICK = ("install.md", "metric.md")  # run by `make test`; all by `make test-all`
RUN = [page for page in PAGES if any(block.is_run and block.kind != "text" for block in read_blocks(page.read_text()))]


def named(page):
    return page.name


def python(page):
    return [block.text for block in read_blocks(page.read_text()) if block.kind == "python"]


def test_the_example_of_the_readme_runs():
    scope: dict = {}
    exec(python(REPOSITORY / "README.md")[0], scope)  # noqa: S102 - our own text
    assert scope["solution"].qpos.shape == (4,)


def test_the_readme_is_short():
    assert len((REPOSITORY / "README.md").read_text().split()) <= 700


@pytest.mark.slow_for(
    "any_arm.md",
    "datasets.md",
    "dynamic_imitation.md",
    "hardware_world.md",
    "motion_capture.md",
    "other_tools.md",
    "own_arm.md",
    "own_demonstrations.md",
    "pretrained.md",
    "real_arm.md",
    "recipes.md",
    "scaling.md",
    "static_pose_imitation.md",
    "training.md1",
    "view.md",
)
@pytest.mark.parametrize("page", PAGES, ids=named)
def test_commands_and_code_are_valid(page, monkeypatch, tmp_path, own_registry):
    monkeypatch.chdir(tmp_path)
    for block in read_blocks(page.read_text()):
        if block.title:  # a command may import it
            (tmp_path / block.title).write_text(block.text)
        assert block.kind in ("bash", "python", "xml", "text"), block
        assert block.title or block.kind != "xml", block
        if block.kind == "python":
            compile(block.text, str(page), "exec")
        elif block.kind == "bash":
            for words in commands(block):
                check(words, monkeypatch)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=() if page.name in QUICK else pytest.mark.slow) for page in RUN],
    ids=named,
)
def test_pages_run(page, monkeypatch, tmp_path, own_registry):
    monkeypatch.chdir(tmp_path)
    run_page(page, tmp_path)


def test_every_block_of_a_page_is_recognised():
    """A block that the parser overlooks would not be checked."""
    page = "a\n\n    B=1 srun python -m m  # c\n    make x\n\n<!-- not run: no -->\n\n```python\n  d\n```\n"
    page += '```xml title="e.xml"\n<f/>\n```'
    assert read_blocks(page) == [
        Block("bash", "B=1 srun python -m m  # c\nmake x", None, True),
        Block("python", "  d", None, False),
        Block("xml", "<f/>", "e.xml", True),
    ]
    for path in PAGES:
        text = path.read_text()
        blocks = read_blocks(text)
        shown = [words for block in blocks if block.kind == "bash" for words in commands(block)]
        written = re.findall(r"^\s*(?:srun )?(?:[A-Z_]+=\S+ )*(?:python -m|make|pip) ", text, re.MULTILINE)
        assert len(written) == len([words for words in shown if module(words) != "."]), path
        assert len(re.findall(r"^```python\b", text, re.MULTILINE)) == len(
            [block for block in blocks if block.kind == "python"]
        ), path


@pytest.mark.parametrize(
    "command",
    ["python -m mimic.train env=panda5dof", "python -m benchmarks.pose --pair x", "make nothing", "rm -r runs"],
)
def test_bad_commands_are_found(command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((SystemExit, AssertionError, pytest.fail.Exception)):
        check(commands(Block("bash", command, None, True))[0], monkeypatch)


def test_pages_name_every_environment_and_only_functions_that_exist():
    for name in mimic.environments():
        assert f"`{name}`" in (DOCS / "training.md").read_text()
    table = (DOCS / "library.md").read_text().split("| to | call |")[1].split("\n\n")[0]
    for name in re.findall(r"`(\w+)`", table):
        assert hasattr(mimic, name), name


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_resolve(page):
    for link in re.findall(r"\]\(((?!http)[^)]+)\)", page.read_text()):
        path, _, heading = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        headings = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE) if heading else []
        assert not heading or heading in [text.lower().replace(" ", "-") for text in headings], link


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_pages_name_files_that_exist(page):
    for path in re.findall(r"`((?:mimic|tests|docs|benchmarks|examples)/[\w/.]+)`", page.read_text()):
        assert "NAME" in path or (REPOSITORY / path).exists(), path


def test_pages_on_the_code_name_files_that_exist():
    """Files of a row of CONTRIBUTING.md are in its folder, those of the architecture and the decisions in mimic/."""
    rows = re.findall(r"^\| [^|]+ \| `(\S+/)` \| (.*) \|$", (REPOSITORY / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    assert len(rows) > 10
    paths = [folder + name for folder, names in rows for name in re.findall(r"`([\w./]+)`", names)]
    for page in ("architecture.md", "decisions.md"):
        names = re.findall(r"`([a-z]\w*/[\w/]+\.\w+)`", (DOCS / "design" / page).read_text())
        paths += [name if (REPOSITORY / name).exists() else f"mimic/{name}" for name in names]
    assert not [path for path in paths if not (REPOSITORY / path).exists()]
