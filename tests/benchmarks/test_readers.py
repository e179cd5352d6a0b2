"""Our readers of motion capture files, compared with readers of others where these are installed."""

import importlib.util
import warnings

import pytest

from benchmarks.fuzzing.captures import bvh_bytes, c3d_bytes, trc_bytes
from benchmarks.readers import LIMIT, bvh_row, c3d_row, trc_row, written_by_c3d


def needs(*names):
    """Skips a test where a reader is not installed."""
    missing = [name for name in names if importlib.util.find_spec(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"needs {', '.join(missing)}: see benchmarks/readers.py")


@pytest.fixture(autouse=True)
def quiet():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the other readers
        yield


@pytest.mark.slow
@needs("pybvh")
def test_bvh_as_pybvh(tmp_path):
    (tmp_path / "person.bvh").write_bytes(bvh_bytes())
    assert bvh_row(tmp_path / "person.bvh", 0.01)["m"] < LIMIT


@pytest.mark.slow
@needs("c3d", "ezc3d")
@pytest.mark.parametrize("scale", [None, -1.0, 0.1], ids=["of ezc3d", "floating point", "integers"])
def test_c3d_as_c3d(tmp_path, scale):
    """Also which markers are missing: zeros with a residual of -1."""
    path = tmp_path / "clip.c3d"
    if scale is None:
        path.write_bytes(c3d_bytes())
    else:
        written_by_c3d(path, scale)
    assert c3d_row(path)["m"] < LIMIT


@pytest.mark.slow
@needs("trc")
def test_trc_as_trc_data_reader(tmp_path):
    (tmp_path / "person.trc").write_bytes(trc_bytes())
    assert trc_row(tmp_path / "person.trc")["m"] < LIMIT
