"""Puts files that pages need into the site: results of benchmarks, and the networks of the demo page."""

import re
from pathlib import Path
from typing import Any

import demo_data  # next to this file
from mkdocs.structure.files import File, Files

REPOSITORY = Path(__file__).resolve().parent.parent
RESULTS = "benchmarks/results"


def on_files(files: Files, *, config: Any) -> Files:
    """Adds the results, which are outside of docs, where the repository has them, and the data of the demo page."""
    for path in sorted((REPOSITORY / RESULTS).glob("*.*")):
        files.append(File.generated(config, f"results/{path.name}", abs_src_path=str(path)))
    for name, script in demo_data.scripts().items():
        files.append(File.generated(config, f"demo/{name}.js", content=script))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Turns links to the results in the repository into links to those in the site, from pages in folders too."""
    return re.sub(rf"\]\(\.\./((?:\.\./)*){RESULTS}/", r"](\1results/", markdown)
