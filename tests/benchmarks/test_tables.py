"""Tables of the pages are those of their results files, and say which of these are of code that has changed."""

import json

import pytest

from benchmarks.common import measured_code
from benchmarks.tables import MARK, PAGES, ROOT, with_tables

WITH_TABLES = [page for page in PAGES if MARK.search(page.read_text())]


@pytest.mark.parametrize("page", WITH_TABLES, ids=lambda page: page.name)
def test_tables_are_those_of_their_files(page):
    text = page.read_text()
    assert with_tables(text) == text, "python -m benchmarks.tables writes them again"


def test_a_changed_number_is_noticed():
    text = "a\n\n<!-- table two_arms: bimanual_cpu.json -->\n| 0.1 % |\n<!-- end -->\n\nb\n"
    made = with_tables(text)
    assert made.startswith("a\n\n<!-- table") and made.endswith("<!-- end -->\n\nb\n")
    assert "96.7%" in made and with_tables(made) == made
    assert with_tables(made.replace("96.7%", "96.6%")) == made


@pytest.fixture
def package(tmp_path):
    """A package of two folders that a benchmark of kernels measures, and one that it does not."""
    for folder in ("arms", "metric", "trainers"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "part.py").write_text('"""Words."""\n\nHALF = "0.5"  # why\n')
    return tmp_path


@pytest.mark.parametrize(
    ("folder", "text", "changed"),
    [
        ("metric", 'HALF = "0.5"\n', []),
        ("metric", '"""Other\nwords."""\n# and why\nHALF = "0.5"\n', []),
        ("metric", 'HALF = "0.6"\n', ["metric"]),
        ("metric", 'HALF = "#0.5"\n', ["metric"]),
        ("metric", 'def half():\n    """Words."""\n    return 0.5\n', ["metric"]),
        ("trainers", 'HALF = "0.6"\n', []),
    ],
)
def test_the_hash_of_a_folder_is_that_of_its_code(package, folder, text, changed):
    before = measured_code.hashes("kernel", package)
    measured_code.hash_of.cache_clear()
    (package / folder / "part.py").write_text(text)
    after = measured_code.hashes("kernel", package)
    assert list(before) == list(after) == ["arms", "metric"]
    assert [name for name in after if after[name] != before[name]] == changed


def test_a_result_of_other_code_is_named():
    path = ROOT / "benchmarks" / "results" / "hands_cpu.json"
    results = {**json.loads(path.read_text()), "code": measured_code.hashes("hands")}
    assert measured_code.changed_code({"a.json": results})[1][-1] == "nothing"
    results["code"]["arms"] = "0"
    assert measured_code.changed_code({"a.json": results})[1][-1] == "arms"
    del results["code"]
    assert measured_code.changed_code({"a.json": results})[1][-1] == "everything"


def test_folders_are_those_of_the_package():
    """A new folder is measured too, unless it has no part in numbers."""
    without = {"commands", "deploy", "runs", "viewer"}
    assert {path.parent.name for path in measured_code.PACKAGE.glob("*/__init__.py")} - without == set(
        measured_code.FOLDERS
    ) - {"xml"}
