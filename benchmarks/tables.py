"""Writes the tables of the pages that stem from results files.

    python -m benchmarks.tables            # rewrites the tables between their marks of all pages
    python -m benchmarks.tables --check    # changes nothing; exit code 1 where a page and its files differ

A table stands between two marks: `<!-- table NAME: FILE.json ... -->` and `<!-- end -->`. NAME is a
function of `arm_tables`, `policy_tables` or `speed_tables` in benchmarks/common, which makes the rows from the contents
of the files; these are in benchmarks/results, or paths from the repository's root. The page benchmarks/results/code.md
says of each results file whether the code that it measures has changed since.
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

from benchmarks.common import arm_tables, measured_code, policy_tables, speed_tables
from benchmarks.common.cells import Cells

ROOT = Path(__file__).resolve().parents[1]
FUNCTIONS = {**vars(arm_tables), **vars(policy_tables), **vars(speed_tables), **vars(measured_code)}
PAGES = [
    ROOT / "README.md",
    ROOT / "benchmarks" / "results" / "code.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
MARK = re.compile(r"<!-- table (\w+):([^>]*)-->\n.*?<!-- end -->", re.DOTALL)


def read(name: str) -> Any:
    """The content of a results file, or a mapping from path to content for a pattern."""
    if "*" in name:
        return {str(path.relative_to(ROOT)): json.loads(path.read_text()) for path in sorted(ROOT.glob(name))}
    path = ROOT / name if "/" in name else ROOT / "benchmarks" / "results" / name
    return json.loads(path.read_text())


def markdown(rows: list[Cells]) -> str:
    """A table of the header and the rows below it."""
    lines = ["|" + "".join(f" {cell} |" if cell else " |" for cell in row) for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def with_tables(text: str) -> str:
    """A page with each of its tables made again from its files."""

    def table(match: re.Match[str]) -> str:
        name, files = match[1], match[2].split()
        rows = FUNCTIONS[name](*map(read, files))
        return f"<!-- table {name}: {' '.join(files)} -->\n\n{markdown(rows)}\n\n<!-- end -->"

    return MARK.sub(table, text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="exit code 1 where a page and its files differ")
    check = parser.parse_args().check
    differing = []
    for page in PAGES:
        text = page.read_text()
        if (made := with_tables(text)) != text:
            differing.append(str(page.relative_to(ROOT)))
            if not check:
                page.write_text(made)
    print("\n".join(differing) or "all tables are those of their files")
    sys.exit(1 if check and differing else 0)


if __name__ == "__main__":
    main()
