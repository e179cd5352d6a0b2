"""`python -m benchmarks.figures.paper`: which files it writes, and what it rejects."""

import sys

import pytest

from benchmarks.figures import paper


@pytest.mark.slow
def test_figures_without_a_mapper(tmp_path, monkeypatch):
    names = ["links", "correspondence", "points", "similarity", "weights", "contours"]
    monkeypatch.setattr(sys, "argv", ["paper", "--out", str(tmp_path), "--only", *names])
    paper.main()
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}


@pytest.mark.parametrize(("arguments", "message"), [((), "--out"), (("--out", "new", "--only", "contour"), "contours")])
def test_bad_input_is_rejected(monkeypatch, capsys, arguments, message):
    monkeypatch.setattr(sys, "argv", ["paper", *arguments])
    with pytest.raises(SystemExit):
        paper.main()
    assert message in capsys.readouterr().err
