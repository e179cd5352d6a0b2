"""The documentation site builds without warnings, is complete, and loads nothing from other hosts."""

import inspect
import os
import re
import subprocess
import sys

import pytest

import mimic
from tests.helpers.repository import REPOSITORY

QUIET = {"NO_MKDOCS_2_WARNING": "1"}  # the theme's advertisement for its successor


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    quiet = {**os.environ, **QUIET}
    built = subprocess.run(command, cwd=REPOSITORY, env=quiet, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return {path.relative_to(out).as_posix(): path.read_text() for path in out.rglob("*.html")}, out


def test_every_public_name_is_in_the_reference():
    pages = "".join(path.read_text() for path in (REPOSITORY / "docs" / "api").glob("*.md"))
    shown = re.findall(r"^::: mimic\.(\w+)$", pages, re.MULTILINE)
    public = [name for name in mimic.__all__ if not inspect.ismodule(getattr(mimic, name))]
    assert sorted(shown) == sorted(public)


@pytest.mark.slow
def test_every_page_is_built(site):
    pages, _ = site
    docs = REPOSITORY / "docs"
    written = {path.relative_to(docs).with_suffix(".html").as_posix() for path in docs.rglob("*.md")}
    assert set(pages) == written | {"404.html", "results/code.html"}
    assert 'title="jaxtyping.Float">Float</span>' in "".join(pages.values())  # shapes, in the reference


@pytest.mark.slow
def test_files_that_pages_use_are_in_the_site(site):
    pages, out = site
    for name, text in pages.items():
        sources = re.findall(r'<(?:img|script|link)[^>]*?(?:src|href)="([^"]+)"', text)
        assert sources, name
        for source in sources:
            if name != "404.html":  # which does not know where it is
                assert not source.startswith(("http", "//")), (name, source)
                assert ((out / name).parent / source.split("?")[0]).is_file(), (name, source)
        for result in re.findall(r'href="((?:\.\./)*results/[^"]+)"', text):
            assert ((out / name).parent / result).is_file(), (name, result)
