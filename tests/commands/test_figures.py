"""`python -m mimic.figures`: which files it writes, and what it rejects."""

import pytest

from mimic.commands.config import FiguresConfig
from mimic.commands.figures import prepare_figures


@pytest.mark.slow
def test_figures_without_a_mapper(tmp_path):
    names = ["links", "correspondence", "points", "similarity", "weights", "contours"]
    assert prepare_figures(FiguresConfig(out=str(tmp_path), only=names))() == 0
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}
    with pytest.raises(ValueError, match="exists; name another folder"):
        prepare_figures(FiguresConfig(out=str(tmp_path)))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (FiguresConfig(), "out: expected a folder"),
        (
            FiguresConfig(out="new", only=["contour"]),
            "expected some of links, correspondence, similarity, points, weights, contours, planar, panda",
        ),
        (FiguresConfig(out=__file__), "is a file"),
    ],
)
def test_bad_input_is_refused(config, message):
    with pytest.raises(ValueError, match=message):
        prepare_figures(config)
