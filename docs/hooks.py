"""Puts the files of results that pages link to into the site."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

REPOSITORY = Path(__file__).resolve().parent.parent
RESULTS = "benchmarks/results"


def on_files(files: Files, *, config: Any) -> Files:
    """Adds the results, which are outside of docs, where the repository has them for all to use."""
    for path in sorted((REPOSITORY / RESULTS).glob("*.json")):
        files.append(File.generated(config, f"results/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Turns links to the results in the repository into links to those in the site, from pages in folders too."""
    return re.sub(rf"\]\(\.\./((?:\.\./)*){RESULTS}/", r"](\1results/", markdown)
