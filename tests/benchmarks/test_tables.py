"""Tables of the pages are those of their results files."""

import pytest

from benchmarks.tables import MARK, with_tables
from tests.helpers.pages import PAGES

WITH_TABLES = [page for page in PAGES if MARK.search(page.read_text())]


@pytest.mark.parametrize("page", WITH_TABLES, ids=lambda page: page.name)
def test_tables_are_those_of_their_files(page):
    text = page.read_text()
    assert with_tables(text) == text, "python -m benchmarks.tables writes them again"


def test_a_changed_number_is_noticed():
    text = "a\n\n<!-- table robot_loops: virtual_robot_loops.json -->\n| 0.1 % |\n<!-- end -->\n\nb\n"
    made = with_tables(text)
    assert made.startswith("a\n\n<!-- table") and made.endswith("<!-- end -->\n\nb\n")
    assert "0.77 %" in made and with_tables(made) == made
    assert with_tables(made.replace("0.77 %", "0.76 %")) == made
